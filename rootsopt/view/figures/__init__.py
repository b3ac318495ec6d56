"""Figures of profiles, forces, searches, speeds and basins; drawings, solids and animations.

Drawings and solids of a design are made from one outline of arcs and splines. This module holds the
option `--export` of the commands."""

import argparse

from rootsopt.errors import InputError

FORMATS = "dxf", "svg", "step", "stl", "gif"
"""Formats of drawings, solids and the animation; see docs/drawings.md."""
SOLID = ("step", "stl")
"""Formats of solids, made by the CAD kernel."""


def add_option(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the option `--export` to the `parser` of a command.

    `default`: value of the option if the user does not give it."""
    parser.add_argument(
        "--export",
        default=default,
        metavar="LIST",
        help=f"draw the rotors: {', '.join(FORMATS)}, all or none (default: {default})",
    )


def chosen(text: str) -> tuple[str, ...]:
    """Return the formats named in `text`, the value of `--export`.

    Raises `InputError` if a format is unknown, or if it needs the CAD kernel and the kernel is not
    installed.
    """
    names = tuple(name.strip() for name in text.lower().split(",") if name.strip())
    if names == ("none",):
        return ()
    if names == ("all",):
        names = FORMATS
    for name in names:
        if name not in FORMATS:
            raise InputError(
                f"`--export` must be formats out of {', '.join(FORMATS)}, or all, or none, but "
                f"has {name!r}; remove it"
            )
    if set(names) & set(SOLID):
        from rootsopt.view.figures.cad import require_kernel

        require_kernel()
    return tuple(name for name in FORMATS if name in names)
