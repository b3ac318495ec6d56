"""What there is to say of a closed orbit: whether it is a motion, and whether its forces are known.

The same for one design at a time and for batches.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.impact import force_rounding
from rootsopt.dynamics.linear import solved
from rootsopt.dynamics.orbit import Orbit, agreement
from rootsopt.dynamics.settle import NOISE

RESIDUAL = {"float64": 1e-9, "float32": 1e-3}
"""Largest residual (scaled) of an orbit that counts as closed, by precision."""
TOO_DEEP = 0.02
"""Penetration in pitch radii beyond which no contact law holds."""
UNRESOLVED = 1e-2
"""Relative error of the greatest force by rounding of the gap, beyond which it is no result."""
_UNKNOWN = 0.1
"""Error of an orbit (scaled) beyond which nothing is known of it."""
_FREE = 1e-6
"""Distance of a Floquet multiplier from 1 that is none."""
_DEFECT = 1e3
"""Residual of an orbit on halved steps, in tolerances and relative to the greatest entry of its
monodromy matrix, with which it is no result."""
_DRIFT = 1e3, 1e-5
"""Distance (scaled) from where kinks were looked for, in tolerances but at least the second, beyond
which the derivatives of an orbit are not known: some kinks lie inside long steps."""
_STRAINED = 100.0
"""Error of a repeated step, in tolerances, with which an orbit on these steps is none."""


class Verdict(NamedTuple):
    """What there is to say of a closed orbit: `is_idle`, `judged` steady, relative error
    by `force_rounding` of the greatest force, `is_consistent`, `is_certain`."""

    idle: Bool[Array, ""]
    steady: Bool[Array, ""]
    rounding: Float[Array, ""]
    consistent: Bool[Array, ""]
    certain: Bool[Array, ""]


def verdict(
    orbit: Orbit,
    state: Float[Array, " n"],
    within: Float[Array, ""] | float,
    rtols: tuple[Float[Array, ""] | float, Float[Array, ""] | float],
    residual: Float[Array, ""] | float,
    scales: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]],
) -> Verdict:
    """The verdict on an orbit; arguments as of `judged`, and the `scales` exponent of the contact
    law, pitch radius (m), force unit (N)."""
    exponent, radius, force = scales
    rounding = force_rounding(orbit.flow.depth, exponent, radius)
    steady = judged(orbit, state, within, rtols, residual)
    return Verdict(
        idle=is_idle(orbit, float(jnp.finfo(orbit.state.dtype).eps) * force, steady),
        steady=steady,
        rounding=jnp.where(orbit.flow.peak > 0, rounding, 0.0),
        consistent=is_consistent(orbit, 10 * rtols[1] * force),
        certain=is_certain(orbit, jnp.asarray(rtols[1])),
    )


def is_idle(
    orbit: Orbit, least: Float[Array, ""] | float = 0.0, steady: Bool[Array, ""] | bool = False
) -> Bool[Array, ""]:
    """Whether no flank ever touches, but for forces up to the `least` (N) of rounding.

    Either the orbit is `steady`: the timing gear holds the pair. Or nothing brings the pair back
    when it is moved: it can rest anywhere, and neither Newton's method nor a derivative has an
    answer. Without contact, an orbit that is neither says nothing of the motion.
    """
    free = jnp.isnan(orbit.multiplier) | (orbit.multiplier > 1 - _FREE)
    return (orbit.flow.mean <= least) & (orbit.flow.peak <= least) & (free | steady)


def judged(
    orbit: Orbit,
    state: Float[Array, " n"],
    within: Float[Array, ""] | float,
    rtols: tuple[Float[Array, ""] | float, Float[Array, ""] | float],
    residual: Float[Array, ""] | float,
) -> Bool[Array, ""]:
    """Whether an orbit is the stable motion that a transient led to, both integrated at `rtols`
    (transient, orbit).

    It is closed to a `residual` on steps that a solver would have taken, its Floquet multipliers
    lie inside the unit circle, errors of the size of its tolerance do not add up to anything in it
    (I - M is far enough from singular), and it is beside the `state` that repeated `within` some
    distance (all scaled, and relative to states beyond 1).
    """
    size = jnp.maximum(1.0, jnp.max(jnp.abs(orbit.state)))
    multiplier = orbit.multiplier
    unit = jnp.eye(orbit.state.shape[0], dtype=orbit.state.dtype)
    gain = jnp.max(jnp.sum(jnp.abs(solved(unit - orbit.monodromy, unit)), axis=1))
    noise = NOISE * jnp.maximum(*rtols) * size
    near = 10 * within / jnp.maximum(1 - multiplier, 1e-3) + noise
    moved = jnp.max(jnp.abs(orbit.state - state))
    closed = (orbit.residual <= residual * size) & (orbit.flow.strain <= _STRAINED)
    return closed & (multiplier < 1) & (gain * rtols[1] < _UNKNOWN) & (moved <= near)


def is_consistent(orbit: Orbit, least: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether the mean force is no greater than the root of the mean square, and that no greater
    than the peak, but for 1 % and forces of the size `least` (N).

    This holds for every force. Steps too coarse for short impacts break it: the mean square they
    add up to may even be negative.
    """
    mean, square, peak = orbit.response[:3]
    ordered = (square + least**2 >= 0.98 * mean**2) & (peak**2 + least**2 >= 0.98 * square)
    return ordered & (mean >= -least)


def is_certain(orbit: Orbit, rtol: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether the derivatives of an orbit integrated at `rtol` hold what they promise: on halved
    steps the orbit closes as the tolerance says and the derivatives agree, and its kinks lie where
    they were looked for."""
    size = jnp.maximum(1.0, jnp.max(jnp.abs(orbit.state)))
    gain = jnp.maximum(1.0, jnp.max(jnp.abs(orbit.monodromy)))
    closes = orbit.defect <= _DEFECT * rtol * size * gain
    agree = orbit.disagreement <= agreement(rtol.astype(orbit.state.dtype))
    tolerances, least = _DRIFT
    near = orbit.drift <= jnp.maximum(tolerances * rtol, least) * size
    return closes & agree & near
