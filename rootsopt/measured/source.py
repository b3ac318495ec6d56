"""Makes a profile from the outline file that a config names, and keeps recent results."""

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from rootsopt.measured.checks import Checks
from rootsopt.measured.fit import imported
from rootsopt.measured.reading import read
from rootsopt.profiles.outline import Outline

if TYPE_CHECKING:
    from rootsopt.config.scene import ProfileConfig

_NOTABLE = 1.0
"""Deviation between flanks (µm) at or above which the user gets a note."""


def outline_of(config: "ProfileConfig") -> tuple[Outline, Checks]:
    """Return (profile, deviations) of the outline file that a config names.

    Recent results are cached, so that an unchanged file is not read again. Raises `InputError` if
    the file does not contain the outline of a rotor that can be simulated."""
    path = Path(config.outline_file or "")
    try:
        found = path.stat()
        stamp = found.st_mtime_ns, found.st_size, found.st_ino
    except (OSError, ValueError):
        stamp = ()  # `read` reports what is wrong.
    smoothing = config.outline_smoothing_mm or 0.0
    return _kept(path, stamp, config.lobes, config.pitch_radius_mm, smoothing)


@functools.lru_cache(maxsize=16)
def _kept(path: Path, stamp: tuple[int, ...], lobes: int, radius: float, smoothing: float):
    del stamp
    return imported(read(path), lobes, radius, smoothing)


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
