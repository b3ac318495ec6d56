"""Estimates of an outline's scatter, centre and unit from its points alone.

Messages and results state the estimates. No estimate is used unless the config asks for it."""

import dataclasses
import math

import numpy as np
from jaxtyping import Complex128
from numpy.typing import NDArray

from rootsopt.measured.loop import signed_area

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "inch": 25.4}
"""Length (mm) of each unit that the points of a file may have."""
_NEIGHBOURS = 2, 3, 4
"""Numbers of neighbours on each side from which the scatter is estimated (see `scatter`). The least
of the three estimates counts. The others may be larger, because the error of a polynomial through
few points depends on its degree."""
_AGREED = 1.5
"""Ratio of the greatest to the least of these estimates above which the scatter is unknown."""
_CLEAR = 8.0
"""Ratio of the distance between neighbours to the scatter below which farther neighbours are used.
Points that are closer together do not lie in order along the curve."""
_FEWEST = 48
"""Number of points left around the outline below which the stride between neighbours is not doubled
again."""
_MOST = 20_000
"""Number of points above which estimates use only every second, third ... point."""
_MEDIAN = 1.4826
"""Ratio of the standard deviation to the median of the absolute values, for a normal
distribution."""
_HARMONICS = 48
"""Maximum number of harmonics of the lobes in the outline that is fitted to find the centre."""
_PASSES, _STILL = 12, 1e-12
"""Maximum number of Gauss-Newton steps in the search for the centre, and step (fraction of the
outline's greatest radius) below which the search ends."""
_SUM = 0.06
"""Relative difference between the pitch radius and the mean of outer and root radius above which an
outline counts as the wrong size. Both are equal for conjugate rotors."""
_SEEN = 1e-4
"""Scatter (mm) below which messages do not mention it."""
_ENOUGH = 0.7
"""Ratio of the smoothing to the scatter below which the points count as not smoothed enough."""
_APART = 6.0
"""Ratio of the distance between points to the scatter below which smoothing fails. Most of the
length along the points is then scatter."""
_MORE = 1.25
"""Factor by which a message raises a smoothing that did not suffice."""
_SURE, _LEAST = 5.0, 1e-3
"""Distances of the centre from the origin (standard errors; mm) above which a message proposes to
move it there. Both must be exceeded."""


@dataclasses.dataclass(frozen=True)
class Estimates:
    """What the points of an outline reveal about its file.

    `scatter`: standard deviation (mm) of the points across the outline. `center`: centre of the
    lobes' rotational symmetry, as x + iy (mm). `center_error`: standard error (mm) of each of its
    coordinates. `middle`: mean (mm) of greatest and least radius about the centre, which is the
    pitch radius of conjugate rotors. Numbers that cannot be estimated are NaN."""

    scatter: float
    center: complex
    center_error: float
    middle: float

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
        if not spacing < _APART * self.scatter:
            return ""
        return (
            f"the points are scattered by about {_two(self.scatter)} um (RMS), but only "
            f"{_two(spacing)} um apart: keep one in {math.ceil(_APART * self.scatter / spacing)}"
        )

    def rough(self, smoothing: float) -> bool:
        """Return whether the points scatter by more than a `smoothing` (mm) can remove."""
        return self.scatter > _SEEN and smoothing < _ENOUGH * self.scatter

    def remedy(self, smoothing: float) -> str:
        """Return what to change in the config if the outline is not smooth.

        `smoothing`: smoothing (mm) of the config."""
        seen = f"{_two(self.scatter)} um"
        if self.rough(smoothing):
            return (
                f"the points are scattered by about {seen} (RMS): set "
                f"`profile.outline_smoothing_mm` = {self.scatter:.2g}"
            )
        if smoothing > 0 and self.scatter > _SEEN:
            return (
                f"the points are scattered by about {seen} (RMS): raise "
                f"`profile.outline_smoothing_mm` from {smoothing:.3g} to "
                f"{_MORE * max(smoothing, self.scatter):.2g}, or correct the outline"
            )
        if math.isnan(self.scatter):
            return "the points are too few to tell scatter from shape: add points"
        return (
            f"the points are hardly scattered (by about {self.scatter * 1e3:.1g} um): correct the "
            "outline"
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
        if not math.isfinite(self.middle) or abs(self.middle / pitch_radius - 1) < _SUM:
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
    return next((u for u, mm in UNITS.items() if abs(middle * mm / pitch_radius - 1) < _SUM), None)


def estimates(points: Complex128[np.ndarray, " n"], lobes: int) -> Estimates:
    """Return estimates from the `points` (mm) of a closed outline with this number of `lobes`."""
    with np.errstate(all="ignore"):
        try:
            spread = scatter(points)
            middle, error = center(points, lobes)
        except np.linalg.LinAlgError:
            spread, middle, error = math.nan, complex(math.nan), math.nan
        radius = np.abs(points - middle)
        return Estimates(spread, middle, error, float(np.max(radius) + np.min(radius)) / 2)


def scatter(points: Complex128[np.ndarray, " n"]) -> float:
    """Return the standard deviation of the `points` of a closed outline across its curve.

    The unit is that of the points. Each point is predicted by the polynomial through some
    neighbours on both sides. Its deviation across the curve is divided by the standard deviation
    that unit scatter of all these points would cause. Corners and joints of the curve disturb few
    deviations, so the median is used. If the scatter is large compared with the distance between
    neighbours, neighbours farther apart are used."""
    spacing = float(np.median(np.abs(np.diff(points))))
    stride, found = 1, _least(points, 1)
    while found > stride * spacing / _CLEAR and len(points) / (2 * stride) >= _FEWEST:
        stride *= 2
        found = _least(points, stride)
    return found


def _least(points: NDArray[np.complex128], stride: int) -> float:
    """Return the scatter of `points` as in `scatter`, with neighbours `stride` points apart.

    The result is NaN if it depends on the number of neighbours: the points are then too few."""
    found = [_across(points, half, stride) for half in _NEIGHBOURS]
    least, most = min(found), max(found)
    return math.nan if most > _AGREED * least and least > _SEEN else least


def _across(points: NDArray[np.complex128], half: int, stride: int) -> float:
    """Return the scatter of `points` as in `scatter`, from one number of neighbours.

    `half`: number of neighbours on each side; `stride`: their distance, in points."""
    if len(points) <= 2 * half * stride:
        return math.nan
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
    return float(_MEDIAN * np.median(np.abs(deviation)))


def center(points: Complex128[np.ndarray, " n"], lobes: int) -> tuple[complex, float]:
    """Return (centre of the symmetry of `lobes` lobes, standard error of its coordinates).

    Both have the unit of the points. The radius about the centre is a Fourier series of harmonics
    of the lobes. Its coefficients and the centre minimise the sum of squared distances of the
    points from this outline (Gauss-Newton steps, from the centroid of the area)."""
    chosen = points[:: 1 + len(points) // _MOST]
    step = np.roll(points, -1) - points
    nodes, weights = np.polynomial.legendre.leggauss(2)
    z = points[:, None] + step[:, None] * (1 + nodes) / 2
    first = np.sum(np.conj(z) * z * step[:, None] * weights / 2) / 2j
    place = complex(first / signed_area(points))
    orders = lobes * np.arange(1, 1 + min(_HARMONICS, len(chosen) // (4 * lobes)))
    error = math.nan
    for _ in range(_PASSES):
        away = chosen - place
        radius, angle = np.abs(away), np.angle(away)
        cos, sin = np.cos(angle[:, None] * orders), np.sin(angle[:, None] * orders)
        series = np.concatenate([np.ones((len(angle), 1)), cos, sin], axis=1)
        shape = np.linalg.solve(series.T @ series, series.T @ radius)
        a, b = np.split(shape[1:], 2)
        slope = (cos * b - sin * a) @ orders
        across = radius / np.hypot(radius, slope)
        # The derivatives include the change of radius and angle of every point.
        east, north = np.cos(angle), np.sin(angle)
        by_x = -east - slope * north / radius
        by_y = -north + slope * east / radius
        rows = np.concatenate([series, -by_x[:, None], -by_y[:, None]], axis=1)
        rows *= across[:, None]
        inverse = np.linalg.pinv(rows.T @ rows, rcond=1e-12, hermitian=True)
        found = inverse @ (rows.T @ (radius * across))
        move = complex(found[-2], found[-1])
        place += move
        off = radius * across - rows @ found
        free = max(1, len(chosen) - rows.shape[1])
        error = float(np.sqrt(np.sum(off**2) / free * (inverse[-1, -1] + inverse[-2, -2]) / 2))
        if not abs(move) > _STILL * np.max(radius):
            break
    return place, error


__all__ = ["UNITS", "Estimates", "center", "estimates", "scatter", "unit_of_size"]
