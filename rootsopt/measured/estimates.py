"""Estimates of an outline's scatter, centre and unit from its points alone; report of its checks.

Messages and results state the estimates. No estimate is used unless the config asks for it."""

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Complex128
from numpy.typing import NDArray

from rootsopt.measured.loop import moment, signed_area

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "inch": 25.4}
"""Length (mm) of each unit that the points of a file may have."""

# Numbers of neighbours on each side from which the scatter is estimated (see `scatter`). The
# least of the three estimates counts. The others may be larger, because the error of a polynomial
# through few points depends on its degree.
_NEIGHBOURS = 2, 3, 4

# Ratio of the estimates from neighbours twice as far apart and from next neighbours above which
# the scatter is unknown. Scatter does not depend on the distance. The error of a polynomial
# through points on a smooth curve grows at least with its square; for exact points of EE (2 to 6
# lobes) and CIC it was found to grow by 6 or more.
_GROWTH = 4.0

# Typical growth of the error of coarse points, with which it is separated from the scatter.
_GROWN = 9.0

# Ratio of the distance between neighbours to the scatter below which farther neighbours are used.
# Points that are closer together do not lie in order along the curve.
_CLEAR = 8.0

# Number of points left around the outline below which the stride between neighbours is not
# doubled again.
_FEWEST = 48

# Number of points above which estimates use only every second, third ... point.
_MOST = 20_000

# Ratio of the standard deviation to the median of the absolute values, for a normal distribution.
_MEDIAN = 1.4826

# Maximum number of harmonics of the lobes in the outline that is fitted to find the centre.
_HARMONICS = 48

# Maximum number of Gauss-Newton steps in the search for the centre, and step (fraction of the
# outline's greatest radius) below which the search ends.
_PASSES, _STILL = 12, 1e-12
SIZED = 0.06
"""Relative difference between the pitch radius and the mean of outer and root radius above which an
outline counts as the wrong size. Both are equal for conjugate rotors."""
SEEN = 1e-4
"""Scatter (mm) below which messages do not mention it."""

# Ratio of the smoothing to the scatter below which the points count as not smoothed enough.
_ENOUGH = 0.7

# Ratio of the distance between points to the scatter below which smoothing fails. Most of the
# length along the points is then scatter.
_APART = 6.0

# Factor by which a message raises a smoothing that did not suffice.
_MORE = 1.25

# Values of the smoothing (multiples of the scatter) that are tried for a message.
_FACTORS = 2.0, 1.6, 1.25, 1.0

# Values of the smoothing (mm) that are tried for points without scatter, for example ends of arcs
# or lines that are rounded, or on the wrong side of the pitch circle.
_STEPS = 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5

# Number of points per flank below which the scatter is unknown: the error of a polynomial through
# them no longer grows with their distance.
_PER_FLANK = 8

# Distances of the centre from the origin (standard errors; mm) above which a message proposes to
# move it there. Both must be exceeded.
_SURE, _LEAST = 5.0, 1e-3


@dataclasses.dataclass(frozen=True)
class Estimates:
    """What the points of an outline reveal about its file.

    `scatter`: standard deviation (mm) of the points across the outline. `center`: centre of the
    lobes' rotational symmetry, as x + iy (mm). `center_error`: standard error (mm) of each of its
    coordinates. `middle`: mean (mm) of greatest and least radius about the centre, which is the
    pitch radius of conjugate rotors. `interpolation`: error (mm) of a polynomial between the
    points; both it and the scatter if the latter is unknown. Numbers that cannot be estimated are
    NaN. `reads`: whether the outline is read with a smoothing (mm)."""

    scatter: float
    center: complex
    center_error: float
    middle: float
    interpolation: float = math.nan
    reads: Callable[[float], bool] = lambda _: False

    @property
    def off_center(self) -> bool:
        """Whether the centre is significantly away from the origin."""
        away = abs(self.center)
        return away > _LEAST and away > _SURE * self.center_error

    @property
    def excess(self) -> str:
        """Advice for points whose scatter is too large for smoothing."""
        return (
            f"the points are scattered by about {_two(self.scatter)} um (RMS), too much to be "
            "smoothed: thin them out, or measure again"
        )

    def thinning(self, spacing: float) -> str:
        """Return advice if the scatter is large compared with the spacing; otherwise "".

        `spacing`: distance (mm) between successive points."""
        if (kept := self.stride(spacing)) == 1:
            return ""
        return (
            f"the points are scattered by about {_two(self.scatter)} um (RMS), but only "
            f"{_two(spacing)} um apart: keep one in {kept}"
        )

    def stride(self, spacing: float) -> int:
        """Return k if only every k-th point can be smoothed; `spacing`: as in `thinning`."""
        dense = spacing < _APART * self.scatter
        return math.ceil(_APART * self.scatter / spacing) if dense else 1

    def rough(self, smoothing: float) -> bool:
        """Return whether the points scatter by more than a `smoothing` (mm) can remove."""
        return self.scatter > SEEN and smoothing < _ENOUGH * self.scatter

    def remedy(self, smoothing: float) -> str:
        """Return what to change in the config if the outline is not smooth.

        `smoothing`: smoothing (mm) of the config. Any other value that the text states has been
        tried, unless none of those tried can be read."""
        known, key = self.scatter > SEEN, "`profile.outline_smoothing_mm`"
        # From the greatest down, so that an outline that smoothing does not help costs one trial.
        fitting = itertools.takewhile(lambda x: x > smoothing and self.reads(x), self.smoothings)
        value = min(fitting, default=None)
        offer = f"set {key} = {value:g}, with which it is read" if value else ""
        seen = f"the points are scattered by about {_two(self.scatter)} um (RMS): "
        if self.rough(smoothing):
            return seen + (offer or f"set {key} = {self.scatter:.2g}")
        if known and smoothing > 0:
            value = value or _MORE * max(smoothing, self.scatter)
            return seen + f"raise {key} from {smoothing:.3g} to {value:.2g}, or correct the outline"
        if math.isnan(self.scatter):
            return f"{self.few}: add points" + (f", or {offer}" if offer else "")
        hardly = f"the points are hardly scattered (by about {self.scatter * 1e3:.1g} um): "
        return hardly + (offer or "correct the outline")

    @property
    def smoothings(self) -> list[float]:
        """Values of the smoothing (mm) that are worth a trial, from the greatest down."""
        steps = [self.scatter * x for x in _FACTORS] if self.scatter > SEEN else _STEPS
        return [float(f"{step:.2g}") for step in steps]

    @property
    def few(self) -> str:
        """Clause for messages: the scatter is unknown."""
        return (
            "the points are too few to tell scatter from shape (between them, the curve is known "
            f"to about {_two(self.interpolation)} um)"
        )

    def centering(self) -> str:
        """Return advice to move the centre to the origin; "" if it is there already."""
        if not self.off_center:
            return ""
        return (
            f"the lobes' centre of symmetry is at {written(self.center)} mm, to about "
            f"{max(self.center_error, 1e-6) * 1e3:.1g} um: set `profile.outline_center` = fit to "
            "move it to the origin"
        )

    def sizing(self, pitch_radius: float, unit: float) -> str:
        """Return advice on units or pitch radius; "" if the size fits the `pitch_radius` (mm).

        `unit`: length (mm) of the unit in which the file was read."""
        if not math.isfinite(self.middle) or abs(self.middle / pitch_radius - 1) < SIZED:
            return ""
        if fitting := unit_of_size(self.middle / unit, pitch_radius):
            read = next((name for name, mm in UNITS.items() if mm == unit), f"{unit:.4g} mm")
            return (
                f"read in {fitting} instead of {read}, it would fit (the mean of its outer and "
                f"root radius would be the pitch radius): set `profile.outline_unit` = {fitting}"
            )
        return (
            f"half the sum of its outer and root radius is {self.middle:.5g} mm, which should be "
            "the pitch radius"
        )


def _two(length: float) -> str:
    """Format a length (mm) as text in micrometres, with two significant digits."""
    return f"{float(f'{length * 1e3:.2g}'):g}"


def written(center: complex) -> str:
    """Format a `center` = x + iy (mm) as text for a message, to 0.01 µm."""
    return f"({round(center.real, 5) + 0.0:.10g}, {round(center.imag, 5) + 0.0:.10g})"


def unit_of_size(middle: float, pitch_radius: float) -> str | None:
    """Return the unit in which the number `middle` is about the `pitch_radius` (mm).

    `middle`: mean of an outline's outer and root radius, in the file's unknown unit. Return `None`
    if there is no such unit."""
    return next((u for u, mm in UNITS.items() if abs(middle * mm / pitch_radius - 1) < SIZED), None)


@dataclasses.dataclass(frozen=True)
class Checks:
    """Deviations and margins of an imported outline.

    `points`: number of points of the outline as read, without repeated points.
    `turned_deg`: angle (°) by which the outline was turned to put a lobe's axis on +x.
    `reversed`: whether the points ran clockwise as read.
    `axis_offset_um`: distance (µm) of the outline's centroid from the rotor's axis.
    `lobe_deviation_um`: greatest normal distance between a flank and the mean of the same flank of
    all lobes (µm).
    `flank_deviation_um`: greatest normal distance between the mean leading flank and the mirrored
    mean trailing flank (µm).
    `fit_deviation_um`: RMS distance of the leading flank's points from the fitted curve (µm); 0 if
    the curve passes through them.
    `star_margin_mm`: least distance (mm) between a tangent of the flank and the rotor's axis,
    negative if a tangent passes the axis on the wrong side.
    `convexity_margin_mm`: least radius of curvature of the addendum (mm).
    `axis`: rotor's axis in the file, as x + iy (mm). `seen`: estimates of scatter and of the centre
    about this axis.
    `notes`: what the reader converted, chose or changed.
    """

    points: int
    turned_deg: float
    axis_offset_um: float
    lobe_deviation_um: float
    flank_deviation_um: float
    fit_deviation_um: float
    star_margin_mm: float
    convexity_margin_mm: float
    seen: Estimates
    axis: complex = 0j
    reversed: bool = False
    notes: tuple[str, ...] = ()

    def record(self) -> dict[str, Any]:
        """Return the fields and the estimates for the result file; the axis is the config's.

        `scatter_um`, `interpolation_um`: see `Estimates` (µm), NaN if unknown. `center_x_mm`,
        `center_y_mm`: centre (mm) of the lobes' symmetry in the file; `center_error_um`: its
        standard error (µm)."""
        center = self.seen.center + self.axis
        own = {key: value for key, value in vars(self).items() if key not in ("seen", "axis")}
        return own | {
            "scatter_um": self.seen.scatter / UNITS["um"],
            "interpolation_um": self.seen.interpolation / UNITS["um"],
            "center_x_mm": center.real,
            "center_y_mm": center.imag,
            "center_error_um": self.seen.center_error / UNITS["um"],
        }


def estimates(points: Complex128[np.ndarray, " n"], lobes: int) -> Estimates:
    """Return estimates from the `points` (mm) of a closed outline with this number of `lobes`."""
    spread = between = error = math.nan
    middle = complex(math.nan)
    with np.errstate(all="ignore"):
        with contextlib.suppress(np.linalg.LinAlgError):
            spread, between = scatter(points)
            middle, error = center(points, lobes)
        if len(points) < _PER_FLANK * 2 * lobes:
            spread = math.nan
        radius = np.abs(points - middle)
        size = float(np.max(radius) + np.min(radius)) / 2
    return Estimates(spread, middle, error, size, between)


def scatter(points: Complex128[np.ndarray, " n"]) -> tuple[float, float]:
    """Return (standard deviation across the curve, error of interpolation) of a closed outline.

    The unit is that of the points. Each point is predicted by the polynomial through some
    neighbours on both sides. Its deviation across the curve is divided by the standard deviation
    that unit scatter of all these points would cause. Corners and joints of the curve disturb few
    deviations, so the median is used. If the scatter is large compared with the distance between
    neighbours, neighbours farther apart are used.

    The deviations hold both scatter and the error of the polynomial. Only the latter grows with the
    distance of the neighbours. The scatter is NaN if the deviations grow by `_GROWTH`; all of the
    deviation is then error of interpolation. Otherwise, the growth determines this error."""
    spacing = float(np.median(np.abs(np.diff(points))))
    stride, deviation = 1, _across(points, 1)
    while deviation > stride * spacing / _CLEAR and len(points) / (2 * stride) >= _FEWEST:
        stride *= 2
        deviation = _across(points, stride)
    wider = _across(points, 2 * stride)
    if deviation < SEEN:
        return deviation, deviation
    if not wider < _GROWTH * deviation:
        return math.nan, deviation
    error = math.sqrt(max(wider**2 - deviation**2, 0.0) / (_GROWN**2 - 1))
    return math.sqrt(deviation**2 - error**2), error


def _across(points: NDArray[np.complex128], stride: int) -> float:
    """Return the scatter of `points` as in `scatter`, with neighbours `stride` points apart.

    It includes the error of the polynomial. NaN if there are too few points."""
    scatters = []
    for half in _NEIGHBOURS:
        if len(points) <= 2 * half * stride:
            break
        steps = np.array([k for k in range(-half, half + 1) if k]) * stride
        chosen = np.arange(0, len(points), 1 + len(points) // _MOST)
        around = points[(chosen[:, None] + steps) % len(points)]
        along = around[:, -1] - around[:, 0]
        local = (around - points[chosen, None]) * np.conj(along / np.abs(along))[:, None]
        x, y = local.real, local.imag
        # Lagrange's weights of the neighbours for the value at x = 0.
        apart = x[:, None, :] - x[:, :, None]
        ratio = x[:, None, :] / np.where(apart == 0, 1.0, apart)
        ratio[:, range(len(steps)), range(len(steps))] = 1.0
        weight = np.prod(ratio, axis=2)
        deviation = np.sum(weight * y, axis=1) / np.sqrt(1 + np.sum(weight**2, axis=1))
        scatters.append(float(_MEDIAN * np.median(np.abs(deviation))))
    return min(scatters, default=math.nan)


def center(points: Complex128[np.ndarray, " n"], lobes: int) -> tuple[complex, float]:
    """Return (centre of the symmetry of `lobes` lobes, standard error of its coordinates).

    Both have the unit of the points. The radius about the centre is a Fourier series of harmonics
    of the lobes. Its coefficients and the centre minimise the sum of squared distances of the
    points from this outline (Gauss-Newton steps, from the centroid of the area)."""
    chosen = points[:: 1 + len(points) // _MOST]
    place, error = moment(points, 1) / signed_area(points), math.nan
    orders = lobes * np.arange(1, 1 + min(_HARMONICS, len(chosen) // (4 * lobes)))
    for _ in range(_PASSES):
        away = chosen - place
        radius, angle = np.abs(away), np.angle(away)
        cos, sin = np.cos(angle[:, None] * orders), np.sin(angle[:, None] * orders)
        series = np.concatenate([np.ones((len(angle), 1)), cos, sin], axis=1)
        a, b = np.split(np.linalg.solve(series.T @ series, series.T @ radius)[1:], 2)
        slope = (cos * b - sin * a) @ orders
        across = radius / np.hypot(radius, slope)
        # A move of the centre changes radius and angle of every point.
        by_move = away / radius * (1 - 1j * slope / radius)
        rows = np.column_stack([series, by_move.real, by_move.imag]) * across[:, None]
        inverse = np.linalg.pinv(rows.T @ rows, rcond=1e-12, hermitian=True)
        solution = inverse @ (rows.T @ (radius * across))
        move = complex(*solution[-2:])
        place += move
        off = radius * across - rows @ solution
        variance = np.sum(off**2) / max(1, len(chosen) - rows.shape[1])
        error = float(np.sqrt(variance * (inverse[-1, -1] + inverse[-2, -2]) / 2))
        if not abs(move) > _STILL * np.max(radius):
            break
    return complex(place), error
