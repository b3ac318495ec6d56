"""Steady state by plain integration, for comparison with closed orbits.

The motion is integrated until the transient has passed, then averaged over one mesh period.
Derivatives are carried along throughout.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.scene import Scene


@eqx.filter_jit
def averaged(model: Scene, design: Any, settle: Any, how: Integrator) -> tuple[Any, Any]:
    """Average the contact force over one mesh period, after a transient of `settle` mesh periods.

    The motion starts from rest. Returns (mean, peak) in N, and their derivatives (2, d) in N per
    config unit. `how`: integrator.
    """

    def forces(design: Any) -> tuple[Any, Any]:
        pair = model.pair(design)

        def pass_by(_: Any, state: Any) -> Any:
            return strobe(pair, state, 1, how).states[-1]

        state = lax.fori_loop(0, settle, pass_by, jnp.zeros(2))
        found = one_period(pair, state, how).response[::2]
        return found, found

    slopes, found = jax.jacfwd(forces, has_aux=True)(design)
    return found, slopes
