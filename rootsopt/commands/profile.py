"""`rootsopt profile CONFIG`: compute the geometry of one design."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rootsopt.commands import door

if TYPE_CHECKING:
    import argparse

PURPOSE = (
    "Compute the geometry of one design (radii, area, inertia, margins) and export drawings, "
    "solids or an animation."
)
EXPORT = "dxf,svg"
"""Default value of `--export` for this command. Drawings take less than 1 s, a solid takes 10 s."""


def options(parser: "argparse.ArgumentParser") -> None:
    """Add the command's own options to a `parser`."""
    from rootsopt import export

    export.add_option(parser, EXPORT)
    parser.add_argument(
        "--project",
        metavar="N",
        help="write free_form.yaml: the profile as a free form of N coefficients",
    )
    parser.add_argument(
        "--resembles",
        action="store_true",
        help="find the nearest member of every profile family (takes half a minute)",
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt profile` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("profile", lambda: _run(argv), own=argv is None)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt.commands import cli

    return cli.run("profile", PURPOSE, argv, options)
