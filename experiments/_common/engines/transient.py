"""Steady state by plain integration, for comparison with closed orbits.

The motion is integrated until the transient has passed, then averaged over one mesh period.
Derivatives are carried along throughout.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from rootsopt.dynamics.flow import flow
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.orbit import SAMPLES
from rootsopt.scene import Scene

_FEW = 64
"""Number of samples per mesh period of the transient, whose peak force is not needed."""


@eqx.filter_jit
def averaged(model: Scene, design: Any, settle: Any, how: Integrator) -> tuple[Any, Any]:
    """Average the contact force over one mesh period, after a transient of `settle` mesh periods.

    The motion starts from rest. Returns (mean, peak) in N, and their derivatives (2, d) in N per
    config unit. `how`: integrator.
    """
    pair, tangents, _ = model.pair_and_tangents(design)
    one = jnp.asarray(1.0)

    def chained(out: Any, before: Any) -> Any:
        moved = out.slope[:, :2] @ before
        return moved + out.slope[:, 2:]

    def pass_by(_: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        state, before = carry
        out = flow(pair, state, one, how, _FEW, tangents)
        return out.end, chained(out, before)[:2]

    start = jnp.zeros(2), jnp.zeros((2, design.shape[0]))
    state, before = lax.fori_loop(0, settle, pass_by, start)
    out = flow(pair, state, one, how, SAMPLES, tangents)
    slopes = chained(out, before)
    return jnp.stack([out.mean, out.peak]), jnp.stack([slopes[2], slopes[4]])
