"""Derivatives of a motion across an instant at which its equation jumps.

Next to a cusp the gap of two flanks has two minima. Where the deeper of them changes, the
penetration is continuous but its levers are not, and with them the contact force. Beside
what the steps before and after contribute, the motion then changes with the instant at
which that happens (saltation; P. C. Müller, Chaos, Solitons & Fractals 5 (1995) 1671-1681):

    dy = (f₋ - f₊) dt*,        dt* = -d(δ₋ - δ₊) / (dδ₋/dτ - dδ₊/dτ),

f the equation of motion and δ the penetration, before and after. Integrals over the motion
are entries of y like any other.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.dynamics.pair import FlankForce

LONGEST = 4e-6
"""Longest step (mesh periods) that is looked into: all that are made around a change are
shorter."""
_FASTER = 20.0
"""Change of a lever per mesh period, in pitch radii, that only a jump makes: along a flank of EE it
is at most 2π, with any number of lobes."""
_ROUNDINGS = 300
"""Roundings of a lever that are no jump."""
_ALIKE = 0.05
"""Share of a jump by which the levers on one side of it may differ: of a lever that changes fast,
but all the way, some stage of the step is in between."""
MARKS = 4
"""Numbers that tell a jump, beside the slope of a motion."""


def marks(contact: FlankForce) -> Float[Array, "4"]:
    """Penetration (m), its rate (m/s), and levers (m)."""
    return jnp.stack([contact.depth, contact.closing, contact.lever1, contact.lever2])


def saltation(
    step: Float[Array, ""],
    slopes: Float[Array, "stages rows"],
    period: Float[Array, ""],
    length: Float[Array, ""] | None,
) -> Float[Array, " rows-4"]:
    """Zero, with the derivative that a jump inside a step adds to y after it.

    `step`: its length (mesh periods); `slopes`: the slope of y with the `marks` behind, at the
    stages of the step, its begin first and its end last; `period`: the time (s) by which y is
    counted; `length` (m): the size of levers. Exact but for the length of the step.

    Raises ValueError where the contact that jumps does not say the size of its levers.
    """
    if length is None:
        raise ValueError("A contact that `jumps` must have a `length_scale`, but it is None.")
    first, last = slopes[0], slopes[-1]
    depth = first[-4] - last[-4]
    frozen = lax.stop_gradient(slopes)
    fall = frozen[0, :-4] - frozen[-1, :-4]
    closing = lax.stop_gradient(period) * (frozen[0, -3] - frozen[-1, -3])
    jump = jnp.max(jnp.abs(frozen[0, -2:] - frozen[-1, -2:]))
    most = _FASTER * jnp.abs(step) + _ROUNDINGS * float(jnp.finfo(step.dtype).eps)
    most = most * lax.stop_gradient(length)
    apart = jnp.abs(frozen[:, None, -2:] - frozen[jnp.array([0, -1]), -2:])
    between = jnp.max(jnp.min(jnp.max(apart, axis=-1), axis=-1))
    jumps = (jnp.abs(step) < LONGEST) & (jump > most) & (between < _ALIKE * jump) & (closing != 0)
    moved = (lax.stop_gradient(depth) - depth) / jnp.where(jumps, closing, jnp.inf)
    return fall * moved
