"""The option `--export` of the commands: choose formats."""

import argparse

from rootsopt.errors import InputError

FORMATS = {
    "dxf": "rotor.dxf, true arcs and splines on layers, dimensions and title block; "
    "rotor_points.csv, coordinates of a lobe",
    "svg": "rotor.svg, true size",
    "step": "rotor.step and pair.step, solids (needs the [cad] extra)",
    "stl": "rotor.stl and pair.stl, triangles (needs the [cad] extra)",
    "gif": "figures/meshing.gif, the pair in motion with contact and force",
}
"""Help text of each format: the files that are written and their content. Lengths are in mm."""
SOLID = ("step", "stl")
"""Formats of solids, made by the CAD kernel."""


def add_option(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the option `--export` to the `parser` of a command.

    `default`: value of the option if the user does not give it."""
    formats = "; ".join(f"{name}: {files}" for name, files in FORMATS.items())
    parser.add_argument(
        "--export",
        default=default,
        metavar="LIST",
        help=f"formats to draw the rotors in (mm), for example --export dxf,step; all; none. "
        f"{formats} (default: {default})",
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
        names = tuple(FORMATS)
    for name in names:
        if name not in FORMATS:
            raise InputError(
                f"`--export` must be formats out of {', '.join(FORMATS)}, or all, or none, but "
                f"has {name!r}; remove it"
            )
    if set(names) & set(SOLID):
        from rootsopt.export.solid import require_kernel

        require_kernel()
    return tuple(name for name in FORMATS if name in names)
