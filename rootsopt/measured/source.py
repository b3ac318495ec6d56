"""Makes a profile from the outline file that a config names, and says what the file holds."""

import dataclasses
import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING

from rootsopt.errors import InputError
from rootsopt.measured.estimates import written
from rootsopt.measured.fit import Checks, imported
from rootsopt.measured.reading import JOIN, Sought, read, untangled
from rootsopt.profiles.outline import Outline

if TYPE_CHECKING:
    from rootsopt.config.rotor import ProfileConfig

_NOTABLE = 1.0
"""Deviation between flanks (µm) at or above which the user gets a note."""
_ECCENTRIC = 1e-3
"""Distance of the lobes' centre of symmetry from the origin (pitch radii) above which simulations
are refused."""
_ROUGH = 5e-4
"""Scatter (mm) of points that are not smoothed above which the user gets a note."""


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
    assert sought.lobes is not None
    assert sought.pitch_radius_mm is not None
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
    seen = outline_of(config)[1].seen
    if (there := seen.centering()) and abs(seen.center) > _ECCENTRIC * config.pitch_radius_mm:
        raise InputError(
            "`profile.outline_file` must hold an outline around the rotor's axis, the origin, but "
            f"{there}, or `profile.outline_center` = [0, 0] to keep the origin"
        )


def advice(config: "ProfileConfig", checks: Checks) -> list[str]:
    """Return notes on flanks that differ, how a file was read, and what the config ignores.

    `config`: the profile's config; `checks`: those of its outline. Flanks that differ by `_NOTABLE`
    or more need a note because the profile is made from one flank."""
    seen, found = checks.seen, list(checks.notes)
    if max(checks.lobe_deviation_um, checks.flank_deviation_um) >= _NOTABLE:
        found.insert(
            0,
            "the leading flank next to +x represents all flanks, but lobes differ by up to "
            f"{checks.lobe_deviation_um:.3g} um and the trailing flank differs from it by up to "
            f"{checks.flank_deviation_um:.3g} um",
        )
    if config.outline_center == "fit":
        found.append(
            f"the axis is the fitted centre of symmetry, {written(checks.axis)} mm in the file, to "
            f"about {max(seen.center_error, 1e-6) * 1e3:.1g} um"
        )
    if seen.rough(smoothing := config.outline_smoothing_mm or 0.0) and seen.scatter > _ROUGH:
        unsmooth = seen.remedy(smoothing)
    elif math.isnan(seen.scatter) and seen.interpolation > _ROUGH:
        unsmooth = f"{seen.few}; add points if the forces must be more exact"
    else:
        unsmooth = ""
    found += filter(None, (seen.centering(), unsmooth))
    return [f"outline: {text}" for text in found]
