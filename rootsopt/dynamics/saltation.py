"""Derivatives of a motion across an instant at which its equation jumps.

Next to a cusp the gap of two flanks has two minima. Where the other minimum becomes the deeper one,
the penetration is continuous, but the levers jump, and with them the contact force. The instant t*
of the jump moves, which adds a term to the derivatives from the steps before and after (saltation;
P. C. Müller, Chaos, Solitons & Fractals 5 (1995) 1671-1681):

    dy = (f₋ - f₊) dt*,        dt* = -d(δ₋ - δ₊) / (dδ₋/dτ - dδ₊/dτ).

f is the right-hand side of the equation of motion and δ the penetration, before (₋) and after (₊)
the jump. Besides the states, y also contains the integrals over the motion.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.dynamics.flanks import FlankForce

LONGEST = 4e-6
"""Length of a step (mesh periods) above which the step is not checked for a jump. All short steps
around switches (`rootsopt.dynamics.switches`) are shorter."""
_FASTER = 20.0
"""Rate of change of a lever (pitch radii per mesh period) above which the change counts as a jump.
Along a flank of the EE family the rate is at most 2π, for any number of lobes."""
_ROUNDINGS = 300
"""Change of a lever (rounding errors) below which the change does not count as a jump."""
_ALIKE = 0.05
"""Distance from the levers at a stage to those at the nearer end of the step, as a fraction of the
change over the step. Above it, the change does not count as a jump: if a lever changes fast but
continuously, some stages lie in between."""
MARKS = 4
"""Number of `marks`: further numbers stored with the time derivative of a motion (penetration, its
rate, both levers). A jump of the levers shows in them."""


def marks(contact: FlankForce) -> Float[Array, "4"]:
    """Return penetration (m), its rate (m/s) and both levers (m), which together reveal a jump.

    For twisted rotors, the first two are means of the slices."""
    event = (contact.depth, contact.closing) if contact.means is None else tuple(contact.means)
    return jnp.stack([*event, contact.lever1, contact.lever2])


def saltation(
    step: Float[Array, ""],
    slopes: Float[Array, "stages rows"],
    period: Float[Array, ""],
    length: Float[Array, ""] | None,
) -> Float[Array, " rows-4"]:
    """Return zeros whose derivatives are those that a jump inside a step adds to y after the step.

    `step`: length of the step (mesh periods); `slopes`: slope of y followed by the `marks`, at the
    stages of the step, from its start to its end; `period` (s): duration of a mesh period at this
    state; `length` (m): typical size of the levers. The derivatives have an error of the order of
    the step length.

    Raises ValueError if `length` is None: a contact that jumps must state the size of its levers.
    """
    if length is None:
        raise ValueError("A contact that `jumps` must have a `lever_scale`, but it is None.")
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
