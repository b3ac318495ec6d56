"""The option `--export` of the commands: choose formats and write the files."""

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rootsopt.errors import InputError

if TYPE_CHECKING:
    from rootsopt.config import Config
    from rootsopt.output.files import ResultFolder
    from rootsopt.response.evaluation import Evaluation, Series

FORMATS = {
    "dxf": "rotor.dxf, true arcs and splines on layers",
    "svg": "rotor.svg, true size",
    "step": "rotor.step and pair.step, solids (needs the [cad] extra)",
    "stl": "rotor.stl and pair.stl, triangles (needs the [cad] extra)",
    "gif": "figures/meshing.gif, the pair in motion with contact and force",
}
"""Help text of each format: the files that are written and their content. Lengths are in mm."""
_SOLID = ("step", "stl")


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
    if set(names) & set(_SOLID):
        from rootsopt.export.solid import require_kernel

        require_kernel()
    return tuple(name for name in FORMATS if name in names)


def write(
    folder: "ResultFolder",
    config: "Config",
    formats: Sequence[str],
    design: dict[str, float],
    series: "Series | None" = None,
    periods: int = 1,
) -> list[str]:
    """Write drawings of a `design` into `folder`; return the names of the files.

    `config`: config of the rotor; `formats`: keys of `FORMATS`; `design`: values of the design
    parameters (config units), keyed by config key. If `series` holds a simulated motion, the GIF
    shows `periods` mesh periods of it. Otherwise the GIF shows perfect rolling.
    """
    if not formats:
        return []
    import jax.numpy as jnp
    import numpy as np

    from rootsopt.export.drawing import Drawing
    from rootsopt.scene import Scene

    values = jnp.asarray(np.array(list(design.values()), dtype=float))
    profile = Scene.from_config(config).profile(values)
    drawing = Drawing.of(config, profile, design)
    files: dict[str, bytes] = {}
    if "dxf" in formats:
        from rootsopt.export.dxf import dxf_bytes

        files["rotor.dxf"] = dxf_bytes(drawing)
    if "svg" in formats:
        from rootsopt.export.svg import svg_text

        files["rotor.svg"] = svg_text(drawing).encode()
    if set(formats) & set(_SOLID):
        files |= _solids(drawing, formats, folder.place)
    if "gif" in formats:
        from rootsopt.export.animation import rolling_gif, simulation_gif

        if series is None:
            files["figures/meshing.gif"] = rolling_gif(drawing, profile)
        else:
            files["figures/meshing.gif"] = simulation_gif(drawing, profile, series, periods)
    for name, data in files.items():
        folder.write_bytes(name, data)
    return list(files)


def write_simulated(
    folder: "ResultFolder", config: "Config", formats: Sequence[str], evaluation: "Evaluation"
) -> list[str]:
    """Write drawings of a simulated design and return the names of the files.

    `folder`, `config`, `formats`: as in `write`; `evaluation`: result of the simulation. The GIF
    shows the simulated motion. If `evaluation` has no motion, no GIF is written."""
    series = evaluation.series
    if series is None:
        formats = tuple(name for name in formats if name != "gif")
    periods = evaluation.steady_state.get("period") or config.profile.lobes
    return write(folder, config, formats, evaluation.design, series, periods)


def _solids(drawing, formats, place) -> dict[str, bytes]:
    """Return the contents of the STEP and STL files, keyed by file name.

    `place`: folder for temporary files. The solid of each shape is made only once."""
    from rootsopt.export import solid

    body = drawing.length, drawing.bore, math.radians(drawing.helix_deg)
    shapes = {
        "rotor": solid.rotor(drawing.pieces, *body),
        "pair": solid.pair(drawing.pieces, drawing.lobes, 2 * drawing.pitch_radius, *body),
    }
    make = {
        "step": solid.step_bytes,
        "stl": lambda shape: solid.stl_bytes(shape, place),
    }
    return {
        f"{name}.{suffix}": make[suffix](shape)
        for suffix in _SOLID
        if suffix in formats
        for name, shape in shapes.items()
    }
