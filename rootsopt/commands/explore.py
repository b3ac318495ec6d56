"""`rootsopt explore CONFIG`: move design and scene with sliders on a local page."""

import argparse
from collections.abc import Sequence

from rootsopt.commands import door

PURPOSE = (
    "Serve a page for this machine alone, with a slider per design and scene parameter: profile, "
    "meshing pair, contact force and gradient follow. Needs the [explore] extra."
)
WRITES = False
"""Whether the command writes a result folder."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt explore` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("explore", lambda: _run(argv), own=argv is None)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's own options to a `parser`."""
    parser.add_argument(
        "--port",
        type=_port,
        default=0,
        metavar="N",
        help="port of the page on 127.0.0.1 (default: any free one)",
    )
    parser.add_argument(
        "--no-browser", action="store_true", help="print the page's address without opening it"
    )


def _port(text: str) -> int:
    number = int(text)
    if not 0 <= number <= 65535:
        raise argparse.ArgumentTypeError(f"must be a number from 0 to 65535, but is {text}")
    return number


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt.commands import cli

    return cli.run("explore", PURPOSE, argv, options, WRITES)
