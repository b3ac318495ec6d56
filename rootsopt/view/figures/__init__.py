"""Figures of profiles, forces, searches, speeds and basins; drawings, solids and animations.

Drawings and solids of a design are made from one outline of arcs and splines. This module holds the
option `--export` of the commands."""

import argparse
import importlib.util

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
    names = FORMATS if names == ("all",) else () if names == ("none",) else names
    if unknown := [name for name in names if name not in FORMATS]:
        raise InputError(
            f"`--export` must be formats out of {', '.join(FORMATS)}, or all, or none, but "
            f"has {unknown[0]!r}; remove it"
        )
    if set(names) & set(SOLID) and importlib.util.find_spec("build123d") is None:
        raise InputError(
            "`--export` step and stl need the CAD kernel build123d, which is not installed; "
            "run: pip install 'rootsopt[cad]'"
        )
    return tuple(name for name in FORMATS if name in names)
