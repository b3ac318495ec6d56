"""Makes a profile from the outline file of a config, and finds the rotor's data in the file.

Unit, lobes, axis and centre distance follow from the file alone. The centre distance follows from
the mesh. Two rotors that roll on each other have a uniform gap at one distance only, whether or not
they are cut by a clearance. The number of lobes follows from the symmetry, the unit from the
size."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from rootsopt.config.plausible import USUAL
from rootsopt.config.rotor import ProfileConfig
from rootsopt.errors import InputError
from rootsopt.measured.conjugacy import Conjugacy, conjugacy
from rootsopt.measured.estimates import UNITS, Checks, Estimates, estimates, unit_of_size, written
from rootsopt.measured.fit import imported
from rootsopt.measured.loop import JOIN, Loop
from rootsopt.measured.reading import LOBES, Sought, lobes_of, read, untangled
from rootsopt.profiles import Outline

# Deviation between flanks (µm) at or above which the user gets a note.
_NOTABLE = 1.0

# Distance of the lobes' centre of symmetry from the origin (pitch radii) above which simulations
# are refused.
_ECCENTRIC = 1e-3

# Scatter (mm) of points that are not smoothed above which the user gets a note.
_ROUGH = 5e-4


def outline_of(config: ProfileConfig) -> tuple[Outline, Checks]:
    """Return (profile, deviations) of the outline file that a config names.

    Recent results are cached, so that an unchanged file is not read again. Raises `InputError` if
    the file does not contain the outline of a rotor that can be simulated."""
    path = Path(config.outline_file or "")
    try:
        status = path.stat()
        stamp = status.st_mtime_ns, status.st_size, status.st_ino
    except (OSError, ValueError):
        stamp = ()  # Ignore the error here: `read` reports it.
    smoothing, size = config.outline_smoothing_mm or 0.0, (config.lobes, config.pitch_radius_mm)
    how = config.outline_unit, Sought(*size, config.outline_center), config.outline_join_mm or JOIN
    return _kept(path, stamp, how, size, smoothing)


@functools.lru_cache(maxsize=16)
def _kept(
    path: Path,
    stamp,
    how: tuple[str | None, Sought, float],
    size: tuple[int, float],
    smoothing: float,
):
    loop = untangled(read(path, *how), *size)
    try:
        outline, checks = imported(loop, *size, smoothing, how[1].center)
    except InputError as error:
        if not loop.notes:
            raise
        raise InputError(f"{error} (how it was read: {'; '.join(loop.notes)})") from None
    return outline, dataclasses.replace(checks, notes=loop.notes)


def check_center(config: ProfileConfig) -> None:
    """Raise `InputError` if lobes lie so far from the axis that a simulation is useless.

    Do not check a config that gives `outline_center`. Such a rotor has flanks that overlap or
    differ by about this distance; its motion takes minutes and means nothing."""
    if config.outline_center is not None:
        return
    seen = outline_of(config)[1].seen
    if (there := seen.centering()) and abs(seen.center) > _ECCENTRIC * config.pitch_radius_mm:
        raise InputError(
            "`profile.outline_file` must hold an outline around the rotor's axis, the origin, but "
            f"{there}, or `profile.outline_center` = [0, 0] to keep the origin"
        )


def advice(config: ProfileConfig, checks: Checks) -> list[str]:
    """Return notes on differing flanks, on how a file was read, and on ignored data.

    `config`: the profile's config; `checks`: those of its outline. Flanks that differ by `_NOTABLE`
    or more need a note because the profile is made from one flank."""
    seen, notes = checks.seen, list(checks.notes)
    if max(checks.lobe_deviation_um, checks.flank_deviation_um) >= _NOTABLE:
        notes.insert(
            0,
            "the leading flank next to +x represents all flanks, but lobes differ by up to "
            f"{checks.lobe_deviation_um:.3g} um and the trailing flank differs from it by up to "
            f"{checks.flank_deviation_um:.3g} um",
        )
    if config.outline_center == "fit":
        notes.append(
            f"the axis is the fitted centre of symmetry, {written(checks.axis)} mm in the file, to "
            f"about {max(seen.center_error, 1e-6) * 1e3:.1g} um"
        )
    if seen.rough(smoothing := config.outline_smoothing_mm or 0.0) and seen.scatter > _ROUGH:
        unsmooth = seen.remedy(smoothing)
    elif math.isnan(seen.scatter) and seen.interpolation > _ROUGH:
        unsmooth = f"{seen.few}; add points if the forces must be more exact"
    else:
        unsmooth = ""
    notes += filter(None, (seen.centering(), unsmooth))
    return [f"outline: {text}" for text in notes]


# Usual range (mm) of a rotor's pitch radius. Outside it, the file's unit is assumed to be another
# one.
_USUAL = USUAL["profile.pitch_radius_mm"]

# Units in the order in which they are tried.
_UNITS = "mm", "inch", "m", "um", "cm"

# Distances (mm) up to which the ends of a drawing's entities are joined, in the order of trial.
_JOINS = JOIN, 0.01, 0.1

# Excesses of the pitch radius over the mean of outer and root radius (fractions of it) that are
# tried until the addendum is convex. For rotors cut by an inset, the excess is the inset.
_SCAN = 0.0, 1e-3, 2e-3, 4e-3, 7e-3, 0.011, 0.016, 0.023, 0.03

# Relative distance from that radius within which the centre distance is sought.
_REACH = 0.02

# Mean deviation of the gap over the mesh (pitch radii) above which a rotor does not roll on
# another one like it.
_UNEVEN = 2e-3
_MM = 1e-3


class MeasuredRotor(NamedTuple):
    """A rotor from a file.

    `outline`, `checks`: profile and deviations of the outline; `lobes`; `radius`: pitch radius
    (mm); `facts`: what was found or assumed, in words."""

    outline: Outline
    checks: Checks
    lobes: int
    radius: float
    facts: tuple[str, ...]


def read_rotor(
    path: Path, given: Mapping[str, Any], ask: Callable[[str, Any], Any]
) -> MeasuredRotor:
    """Return the rotor in the file at `path`.

    `given`: what the user knows, by key of the section `profile`; `ask`: called with a question and
    the assumed answer if the unit is uncertain. Raises `InputError` if the file does not contain a
    rotor that rolls on another one like it."""
    loop = _loop(path, given)
    lobes = given.get("lobes") or lobes_of(loop)
    if lobes is None:
        raise InputError(
            f"{path.name}: must hold the outline of a rotor with {min(LOBES)} to {max(LOBES)} "
            "equal lobes, but its largest closed loop has no such symmetry; give the file of the "
            "rotor alone, or its number of lobes with `--lobes`"
        )
    known = given.get("pitch_radius_mm")
    loop, seen, said = _sized(loop, lobes, given.get("outline_unit"), known, ask)
    stride = seen.stride(float(np.median(np.abs(np.diff(loop.points)))))
    if seen.rough(0.0) and stride > 1:  # Points too close together to be smoothed.
        points, joints = loop.points[::stride], loop.joints[::stride]
        notes = (*loop.notes, f"one in {stride} points is used")
        loop = dataclasses.replace(loop, points=points, joints=joints, notes=notes)
        seen = estimates(points, lobes)
    whole, loop = loop, untangled(loop, lobes, seen.middle)
    radii = [seen.middle * (1 + more) for more in _SCAN]
    if loop is not whole:  # Tails are cut off where the flank crosses the pitch circle.
        corners = float(np.median(np.abs(loop.points[loop.joints] - seen.center)))
        radii = [corners] * (radii[0] < corners < radii[-1]) + radii
    center = given.get("outline_center") or ("fit" if seen.off_center else None)
    center = tuple(center) if isinstance(center, list) else center
    steps = seen.smoothings[::-1] if seen.rough(0.0) else [0.0, *seen.smoothings[::-2]]
    steps = [given.get("outline_smoothing_mm", steps[0]), *steps[1:]]

    def at(*radii: float) -> tuple[Outline, Checks, float]:
        trials = [(one, x) for x in steps for one in (radii if x == steps[0] else radii[:2])]
        return _first(lambda r, x: (*imported(loop, lobes, r, x, center, seen), r), trials)

    outline, checks, radius = at(*([known] if known else radii))
    if not known:
        radius = _rolling(outline, radius)
        outline, checks, _ = at(radius)
    uneven = _uneven(conjugacy(outline))
    if uneven > _UNEVEN * radius * _MM:
        raise InputError(
            f"{path.name}: must hold a rotor that rolls on another one like it, but with centres "
            f"{2 * radius:.5g} mm apart the gap of the flanks varies by {uneven / _MM:.2g} mm on "
            "average; check the outline, or give the distance with `--centre-distance-mm`"
        )
    told = "given" if known else f"gap even to {uneven * 1e6:.2g} um"
    facts = [said, f"{lobes} lobes", f"centre distance {2 * radius:.7g} mm ({told})"]
    facts += [f"axis at {written(checks.axis)} mm in the file"] if center else []
    facts += [f"points scattered by {seen.scatter / _MM:.2g} um"] if seen.rough(0.0) else []
    return MeasuredRotor(outline, checks, lobes, radius, (*facts, *loop.notes))


def _first(call: Callable[..., Any], trials: Iterable[tuple[Any, ...]]) -> Any:
    """Return the first result of a `call`. Raises the first `InputError` if all trials fail."""
    errors = []
    for trial in trials:
        try:
            return call(*trial)
        except InputError as error:
            errors.append(error)
    raise errors[0]


def _loop(path: Path, given: Mapping[str, Any]) -> Loop:
    """Return the rotor's loop in a file."""
    unit, join, center = (given.get(f"outline_{key}") for key in ("unit", "join_mm", "center"))
    # The pitch radius counts only once the unit is known.
    radius = given.get("pitch_radius_mm") if unit else None
    sought = Sought(given.get("lobes"), radius, tuple(center) if isinstance(center, list) else None)
    trials = [(unit, one) for one in ((join,) if join else _JOINS)]
    trials += [] if unit else [("m", join or JOIN), ("um", join or JOIN)]
    return _first(lambda unit, join: read(path, unit, sought, join), trials)


def _sized(
    loop: Loop, lobes: int, stated: str | None, radius: float | None, ask: Callable[[str, Any], Any]
) -> tuple[Loop, Estimates, str]:
    """Return (loop in mm, estimates from its points, words on the unit of its file).

    `stated`: the unit, `radius`: the pitch radius (mm), if they are known."""
    own = next((name for name, mm in UNITS.items() if mm == loop.unit), f"{loop.unit:.4g} mm")
    seen, low, high = estimates(loop.points, lobes), _USUAL.low, _USUAL.high
    number = seen.middle / loop.unit
    if stated or (radius is None and low <= seen.middle <= high):
        told = "" if stated or own == "mm" else " (from the file, or from its size)"
        return loop, seen, f"unit {own}{told}"
    fits = (u for u in _UNITS if low <= number * UNITS[u] <= high)
    unit = unit_of_size(number, radius) if radius else ask("unit of the file", next(fits, own))
    if unit not in UNITS:
        raise InputError(
            f"`--unit` must be one of {', '.join(UNITS)}, but is {unit}"
            if radius is None
            else f"`--centre-distance-mm` must be about twice {seen.middle:.5g} mm, the mean of "
            f"the outline's outer and root radius in {own}, but is {2 * radius:g}; correct it, or "
            "give the unit of the file with `--unit`"
        )
    points = loop.points * (UNITS[unit] / loop.unit)
    loop = dataclasses.replace(loop, points=points, unit=UNITS[unit])
    return loop, estimates(points, lobes), f"unit {unit} ({'fits' if radius else 'assumed'})"


def _rolling(outline: Outline, radius: float) -> float:
    """Return the pitch radius (mm) at which the gap of two rotors is most even over the mesh.

    `radius`: pitch radius (mm) of the `outline`, near it. It is rounded to 0.5 um."""
    low, high = 2 * radius * (1 - _REACH), 2 * radius * (1 + _REACH)

    def uneven(distance: float) -> float:
        return _uneven(conjugacy(outline, distance * _MM))

    minimum = minimize_scalar(uneven, bounds=(low, high), options={"xatol": 1e-8 * radius})
    return round(float(minimum.x), 3) / 2


def _uneven(mesh: Conjugacy) -> float:
    """Return the mean deviation (m) of the gap from its median."""
    return float(np.nanmean(np.abs(mesh.gap - np.nanmedian(mesh.gap))))
