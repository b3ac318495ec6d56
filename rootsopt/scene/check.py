"""Checks a config's geometry, and computes its outline."""

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.config.reading import Config
from rootsopt.config.units import MM
from rootsopt.errors import InputError
from rootsopt.profiles import Geometry, geometry, outline
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import families
from rootsopt.scene.build import Scene
from rootsopt.scene.reading import design_vector

# Excess (mm) of the bore over the root circle above which a design is rejected. A search may end at
# less.
_TOUCHING = 1e-6


def check_geometry(config: Config, design: ArrayLike | None = None, simulated: bool = True) -> None:
    """Raise `InputError` unless the config's profile is sound and leaves room for the bore.

    `design` (d,): in config units, by default the config's own; `simulated`: whether the rotor is
    to be simulated. An outline from a file must then lie around its axis, which is checked before
    anything is compiled."""
    if design is not None:
        config = config.with_design(np.asarray(design, float))
    if simulated:
        families.check_axis(config.profile)
    families.check(config.profile)
    bore = config.rotor.bore_mm
    if bore is None:
        return
    root = float(shape_of(config).root_radius) / MM
    if bore >= 2 * root + (0.0 if design is None else 2 * _TOUCHING):
        raise InputError(
            f"`rotor.bore_mm` must be less than {2 * root:.6g} (the root circle), but is "
            f"{bore:g}; make it smaller"
        )


def shape_of(config: Config) -> Geometry:
    """Return the geometry of a config's own design."""
    return _shape(Scene.from_config(config), design_vector(config))


@CachedFunction
def _shape(scene: Scene, design):
    return geometry(scene.profile(design))


def outline_mm(config: Config, design: ArrayLike | None = None) -> NDArray[np.float64]:
    """Return the closed counter-clockwise outline (n, 2), in mm, of a design.

    `design`: in config units, by default the config's own."""
    design = design_vector(config) if design is None else jnp.asarray(design)
    profile = _profile(Scene.from_config(config), design)
    return np.asarray(outline(profile, points=240)) / MM


_profile = CachedFunction(Scene.profile)
