"""The profile a config's outline file holds, read and fitted once."""

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
"""Deviation (µm) from which on there is a note."""


def outline_of(config: "ProfileConfig") -> tuple[Outline, Checks]:
    """The profile of family outline, and what was found of it. Raises `InputError` where the file
    does not hold one."""
    path = Path(config.outline_file or "")
    try:
        found = path.stat()
        stamp = found.st_mtime_ns, found.st_size, found.st_ino
    except (OSError, ValueError):
        stamp = ()  # Reading it says what is wrong.
    smoothing = config.outline_smoothing_mm or 0.0
    return _kept(path, stamp, config.lobes, config.pitch_radius_mm, smoothing)


@functools.lru_cache(maxsize=16)
def _kept(path: Path, stamp: tuple[int, ...], lobes: int, radius: float, smoothing: float):
    del stamp
    return imported(read(path), lobes, radius, smoothing)


def note(checks: Checks) -> str | None:
    """What a user must know of the flank that stands for all of them, if there is anything."""
    worst = max(checks.lobe_deviation_um, checks.flank_deviation_um)
    if worst < _NOTABLE:
        return None
    return (
        "outline: all flanks are taken to be the leading one next to +x, but lobes differ by up to "
        f"{checks.lobe_deviation_um:.3g} um and the trailing flank from it by up to "
        f"{checks.flank_deviation_um:.3g} um"
    )
