"""`rootsopt simulate CONFIG`: simulate one design in one scene."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rootsopt.commands import door

if TYPE_CHECKING:
    import argparse

PURPOSE = "Simulate one design in one scene: steady state, contact force, its gradient."


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt simulate` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("simulate", lambda: _run(argv), own=argv is None)


def options(parser: "argparse.ArgumentParser") -> None:
    """Add the command's own options to a `parser`."""
    from rootsopt import export

    export.add_option(parser, "none")


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt.commands import cli

    return cli.run("simulate", PURPOSE, argv, options)
