"""Makes a profile from the outline file that a config names, and keeps recent results."""

import dataclasses
import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING

from rootsopt.errors import InputError
from rootsopt.measured.checks import Checks
from rootsopt.measured.estimates import Estimates, written
from rootsopt.measured.fit import imported
from rootsopt.measured.reading import JOIN, Sought, read, untangled
from rootsopt.profiles.outline import Outline

if TYPE_CHECKING:
    from rootsopt.config.scene import ProfileConfig

_NOTABLE = 1.0
"""Deviation between flanks (µm) at or above which the user gets a note."""
_ECCENTRIC = 1e-3
"""Distance of the lobes' centre of symmetry from the origin (pitch radii) above which simulations
are refused."""
_ROUGH = 0.5
"""Scatter (µm) of points that are not smoothed above which the user gets a note."""


def outline_of(config: "ProfileConfig") -> tuple[Outline, Checks]:
    """Return (profile, deviations) of the outline file that a config names.

    Recent results are cached, so that an unchanged file is not read again. Raises `InputError` if
    the file does not contain the outline of a rotor that can be simulated."""
    path = Path(config.outline_file or "")
    try:
        found = path.stat()
        stamp = found.st_mtime_ns, found.st_size, found.st_ino
    except (OSError, ValueError):
        stamp = ()  # Ignore the error here: `read` reports it.
    smoothing = config.outline_smoothing_mm or 0.0
    sought = Sought(config.lobes, config.pitch_radius_mm, config.outline_center)
    how = config.outline_unit, sought, config.outline_join_mm or JOIN
    return _kept(path, stamp, how, smoothing)


@functools.lru_cache(maxsize=16)
def _kept(path: Path, stamp, how: tuple[str | None, Sought, float], smoothing: float):
    del stamp
    loop, sought = read(path, *how), how[1]
    loop = untangled(loop, sought.lobes, sought.pitch_radius_mm)
    try:
        outline, checks = imported(
            loop, sought.lobes, sought.pitch_radius_mm, smoothing, sought.center
        )
    except InputError as error:
        if not loop.notes:
            raise
        raise InputError(f"{error} (how it was read: {'; '.join(loop.notes)})") from None
    return outline, dataclasses.replace(checks, notes=loop.notes)


def check_center(config: "ProfileConfig") -> None:
    """Raise `InputError` if lobes lie so far from the axis that no simulation is worth its time.

    A config that gives `outline_center` is taken at its word. Such a rotor has flanks that overlap
    or differ by about this distance; its motion takes minutes and means nothing."""
    if not config.from_file or config.outline_center is not None:
        return
    checks = outline_of(config)[1]
    seen = estimates_of(config, checks)
    if (there := seen.centering()) and abs(seen.center) > _ECCENTRIC * config.pitch_radius_mm:
        raise InputError(
            "`profile.outline_file` must hold an outline around the rotor's axis, the origin, but "
            f"{there}, or `profile.outline_center` = [0, 0] to keep the origin"
        )


def estimates_of(config: "ProfileConfig", checks: Checks) -> Estimates:
    """Return the estimates of an outline about the axis of its `config`."""
    center = complex(checks.center_x_mm, checks.center_y_mm)
    given = config.outline_center
    axis = center if given == "fit" else complex(*(given or (0.0, 0.0)))
    scatter, error = checks.scatter_um * 1e-3, checks.center_error_um * 1e-3
    between = checks.interpolation_um * 1e-3
    return Estimates(scatter, center - axis, error, config.pitch_radius_mm, between)


def advice(config: "ProfileConfig", checks: Checks) -> list[str]:
    """Return notes on how a file was read, and on scatter and centre that the config ignores.

    `config`: the profile's config; `checks`: those of its outline."""
    found = [f"outline: {text}" for text in checks.notes]
    if config.outline_center == "fit":
        center = complex(checks.center_x_mm, checks.center_y_mm)
        found.append(
            f"outline: the axis is the fitted centre of symmetry, {written(center)} mm in the "
            f"file, to about {max(checks.center_error_um, 1e-3):.1g} um"
        )
    seen = estimates_of(config, checks)
    if seen.centering():
        found.append(f"outline: {seen.centering()}")
    smoothing = config.outline_smoothing_mm or 0.0
    if seen.rough(smoothing) and checks.scatter_um > _ROUGH:
        found.append(f"outline: {seen.remedy(smoothing)}")
    elif math.isnan(checks.scatter_um) and checks.interpolation_um > _ROUGH:
        found.append(f"outline: {seen.few}; add points if the forces must be more exact")
    return found


def note(checks: Checks) -> str | None:
    """Return a note for the user if the flanks differ by `_NOTABLE` or more, otherwise `None`.

    The note is needed because the profile is made from one flank and ignores such differences."""
    worst = max(checks.lobe_deviation_um, checks.flank_deviation_um)
    if worst < _NOTABLE:
        return None
    return (
        "outline: the leading flank next to +x represents all flanks, but lobes differ by up to "
        f"{checks.lobe_deviation_um:.3g} um and the trailing flank differs from it by up to "
        f"{checks.flank_deviation_um:.3g} um"
    )
