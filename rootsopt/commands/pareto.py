"""`rootsopt pareto CONFIG`: trace the best compromises between two or three terms."""

import argparse
from collections.abc import Sequence

from rootsopt.commands import door, parallel

PURPOSE = (
    "Trace the best compromises between two or three terms, such as peak force and area "
    "efficiency (pareto.terms)."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt pareto` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("pareto", lambda: _run(argv), own=argv is None)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's own options to a `parser`."""
    parallel.add_options(parser)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt.commands import cli

    return cli.run("pareto", PURPOSE, argv, options)
