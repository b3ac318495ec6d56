"""What the commands say of an imported outline."""

from typing import TYPE_CHECKING, Any

from rootsopt.config import Config
from rootsopt.measured.conjugacy import conjugacy

if TYPE_CHECKING:
    from rich.console import Console


def record(config: Config) -> dict[str, Any]:
    """`outline` of the result file: checks and conjugacy; nothing for other families."""
    if not config.profile.from_file:
        return {}
    from rootsopt.measured.source import outline_of

    profile, checks = outline_of(config.profile)
    return {"outline": checks.record() | conjugacy(profile).record()}


def say(config: Config, out: "Console") -> None:
    """Print what must be known of the flank that stands for all, if there is anything."""
    if not config.profile.from_file:
        return
    from rootsopt.measured.source import note, outline_of

    message = note(outline_of(config.profile)[1])
    if message:
        out.print(message, soft_wrap=True)
