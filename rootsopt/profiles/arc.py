"""Arc: one circular arc and its conjugate envelope."""

import jax.numpy as jnp

from rootsopt.profiles.arcs import Arcs


def arc(lobes: int, pitch_radius, arc_center) -> Arcs:
    """The rotor whose lobe is one circular arc, its centre on the lobe's axis at `arc_center` b
    (m), through both pitch crossings: its radius is √(r² + b² - 2 r b cos π/2N)."""
    return Arcs.chain(lobes, jnp.asarray(pitch_radius), jnp.asarray(arc_center), (), (), ("arc",))
