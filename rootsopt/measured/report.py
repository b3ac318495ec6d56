"""Entries and notes about an imported outline that the commands report."""

from typing import TYPE_CHECKING, Any

from rootsopt.config import Config
from rootsopt.measured.conjugacy import conjugacy, inset_note

if TYPE_CHECKING:
    from rich.console import Console


def record(config: Config) -> dict[str, Any]:
    """Return {"outline": {...}} for the result file: the records of `Checks` and `Conjugacy`.

    Return {} if the config names no outline file."""
    if not config.profile.from_file:
        return {}
    from rootsopt.measured.source import outline_of  # For outlines only: it takes 0.5 s.

    profile, checks = outline_of(config.profile)
    return {"outline": checks.record() | conjugacy(profile).record()}


def say(config: Config, out: "Console") -> None:
    """Print notes to `out` on an imported outline.

    They say whether its flanks differ by 1 µm or more, whether its points scatter, and whether its
    centre is not the rotor's axis. They also say whether a clearance was drawn into it."""
    if not config.profile.from_file:
        return
    from rootsopt.measured.source import advice, outline_of  # As in `record`.

    profile, checks = outline_of(config.profile)
    found = advice(config.profile, checks)
    if not checks.seen.off_center:
        found += filter(None, [inset_note(conjugacy(profile).inset, config.contact.clearance_mm)])
    for message in found:
        out.print(message, soft_wrap=True, markup=False, highlight=False)
