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

from rootsopt.dynamics.pair import FlankForce, RotorPair

LONGEST = 4e-6
"""Longest step (mesh periods) that is looked into: all that are made around a change are
shorter."""
_FASTER = 20.0
"""Change of a lever per mesh period, in pitch radii, that only a jump makes: along a flank of EE it
is at most 2π, with any number of lobes."""
_ROUNDINGS = 300
"""Roundings of a lever that are no jump."""
MARKS = 3
"""Numbers that tell a jump, beside the slope of a motion."""


def marks(contact: FlankForce) -> Float[Array, "3"]:
    """Penetration and levers (m)."""
    return jnp.stack([contact.depth, contact.lever1, contact.lever2])


def saltation(
    pair: RotorPair,
    tau: Float[Array, ""],
    step: Float[Array, ""],
    state: Float[Array, " n"],
    first: Float[Array, " rows"],
    last: Float[Array, " rows"],
) -> Float[Array, " rows-3"]:
    """Zero, with the derivative that a jump inside a step adds to y after it.

    `tau`, `state`: where the step begins, `step` its length (mesh periods); `first`, `last`: the
    slope of y with the `marks` behind, at its begin and at its end. Exact but for the length of
    the step.
    """
    depth = first[-3] - last[-3]
    fall = lax.stop_gradient(first[:-3] - last[:-3])
    jump = lax.stop_gradient(first[-2:] - last[-2:])
    _, relative, rate = lax.stop_gradient(pair.physical(tau, state))
    speed = lax.stop_gradient(pair.speed(state))
    side = jnp.where(relative < 0, 1.0, -1.0)
    period = lax.stop_gradient(pair.mesh_period)
    if pair.drive.free:
        period = period * lax.stop_gradient(pair.pace(state))
    closing = period * side * (jump[0] * speed - jump[1] * (speed + rate))
    most = _FASTER * jnp.abs(step) + _ROUNDINGS * float(jnp.finfo(step.dtype).eps)
    most = most * pair.contact.pair.profile.pitch_radius
    jumps = (jnp.abs(step) < LONGEST) & (jnp.max(jnp.abs(jump)) > most) & (closing != 0)
    moved = (lax.stop_gradient(depth) - depth) / jnp.where(jumps, closing, jnp.inf)
    return fall * moved
