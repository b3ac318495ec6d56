"""`rootsopt optimize CONFIG`: optimise a design and compare it with the baseline."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rootsopt.commands import door, parallel

if TYPE_CHECKING:
    import argparse

PURPOSE = "Optimise the design parameters for low contact force and compare with the baseline."


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt optimize` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("optimize", lambda: _run(argv), own=argv is None)


def options(parser: "argparse.ArgumentParser") -> None:
    """Add the command's own options to a `parser`."""
    from rootsopt import export

    export.add_option(parser, "none")
    parallel.add_options(parser)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt.commands import cli

    return cli.run("optimize", PURPOSE, argv, options)
