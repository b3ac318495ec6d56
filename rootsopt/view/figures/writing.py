"""Writes the files of the option `--export`."""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from rootsopt.config.reading import Config
from rootsopt.response.result import Evaluation, Series
from rootsopt.scene.build import Scene
from rootsopt.view.figures import SOLID, cad
from rootsopt.view.figures.cad import dxf_bytes
from rootsopt.view.figures.drawing import Drawing, coordinates, svg_text
from rootsopt.view.files import ResultFolder

# Number of points over one lobe in the table of coordinates, in addition to the ends of all pieces.
_COUNT = 361


def write(
    folder: ResultFolder,
    config: Config,
    formats: Sequence[str],
    design: dict[str, float],
    series: Series | None = None,
    periods: int = 1,
) -> None:
    """Write drawings of a `design` into `folder`.

    `config`: config of the rotor; `formats`: keys of `FORMATS`; `design`: values of the design
    parameters (config units), keyed by config key. If `series` holds a simulated motion, the GIF
    shows `periods` mesh periods of it. Otherwise the GIF shows perfect rolling.
    """
    if not formats:
        return
    values = np.array(list(design.values()), dtype=float)
    config = config.with_design(values)  # The twist may be a design parameter.
    profile = Scene.from_config(config).profile(jnp.asarray(values))
    drawing = Drawing.of(config, profile, design)
    if "dxf" in formats:
        folder.write_bytes("rotor.dxf", dxf_bytes(drawing))
        points = coordinates(drawing.pieces, drawing.lobes, _COUNT)
        folder.write_csv("rotor_points.csv", points.columns())
    if "svg" in formats:
        folder.write_text("rotor.svg", svg_text(drawing))
    if set(formats) & set(SOLID):
        for name, data in _solids(drawing, formats, folder.place).items():
            folder.write_bytes(name, data)
    if "gif" in formats:
        from rootsopt.view.figures.animation import meshing_gif

        folder.write_bytes("figures/meshing.gif", meshing_gif(drawing, profile, series, periods))


def write_simulated(
    folder: ResultFolder, config: Config, formats: Sequence[str], evaluation: Evaluation
) -> None:
    """Write drawings of a simulated design.

    `folder`, `config`, `formats`: as in `write`; `evaluation`: result of the simulation. The GIF
    shows the simulated motion. If `evaluation` has no motion, no GIF is written."""
    series = evaluation.series
    if series is None:
        formats = tuple(name for name in formats if name != "gif")
    periods = evaluation.steady_state.get("period") or config.profile.lobes
    write(folder, config, formats, evaluation.design, series, periods)


def _solids(drawing, formats, place) -> dict[str, bytes]:
    """Return the contents of the STEP and STL files, keyed by file name.

    `place`: folder for temporary files. The solid of each shape is made only once."""
    body = drawing.length, drawing.bore, math.radians(drawing.helix_deg)
    shapes = {
        "rotor": cad.rotor(drawing.pieces, *body),
        "pair": cad.pair(drawing.pieces, drawing.lobes, 2 * drawing.pitch_radius, *body),
    }
    make = {
        "step": cad.step_bytes,
        "stl": lambda shape: cad.stl_bytes(shape, place),
    }
    return {
        f"{name}.{suffix}": make[suffix](shape)
        for suffix in SOLID
        if suffix in formats
        for name, shape in shapes.items()
    }
