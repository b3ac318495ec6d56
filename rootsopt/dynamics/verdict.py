"""Checks of a closed orbit: whether it is the steady motion, and whether its forces are known.

The checks are the same for single designs and for batches.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.impact import force_rounding
from rootsopt.dynamics.linear import solved
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.settle import NOISE

TOO_DEEP = 0.02
"""Penetration (pitch radii) above which the forces of an orbit are not valid."""
UNRESOLVED = 1e-2
"""Relative error of the greatest force, from rounding of the gap, above which an orbit's forces
count as unresolved."""
# Estimated error of an orbit (scaled) above which the orbit is rejected.
_UNKNOWN = 0.1
# Distance from 1 below which a Floquet multiplier counts as 1. A multiplier above 1 also does.
_FREE = 1e-6
# Estimated relative error of the derivatives above which they are uncertain. The limit is the first
# number times the square root of the tolerance, at least the second number and at most the third.
_AGREE = 10.0, 1e-3, 3e-2


class Verdict(NamedTuple):
    """Results of the checks of a closed orbit.

    `idle`: whether no flank ever touches (`is_idle`); `steady`: whether the orbit is the stable
    motion that the transient led to (`judged`); `rounding`: relative error of the greatest force
    (`force_rounding`); `consistent`: whether mean ≤ RMS ≤ peak (`is_consistent`); `certain`:
    whether the derivatives are reliable (`agreement`).
    """

    idle: Bool[Array, ""]
    steady: Bool[Array, ""]
    rounding: Float[Array, ""]
    consistent: Bool[Array, ""]
    certain: Bool[Array, ""]


def verdict(
    orbit: Orbit,
    state: Float[Array, " n"],
    limits: tuple[Float[Array, ""] | float, Float[Array, ""] | float],
    rtols: tuple[Float[Array, ""] | float, Float[Array, ""] | float],
    scales: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]],
) -> Verdict:
    """Return the results of all checks of an `orbit`.

    `scales`: exponent of the contact law, pitch radius (m), unit of force (N). For the other
    arguments, see `judged`."""
    exponent, radius, force = scales
    rounding = force_rounding(orbit.depth, exponent, radius)
    steady = judged(orbit, state, limits, rtols)
    return Verdict(
        idle=is_idle(orbit, float(jnp.finfo(orbit.state.dtype).eps) * force, steady),
        steady=steady,
        rounding=jnp.where(orbit.response[2] > 0, rounding, 0.0),
        consistent=is_consistent(orbit, 10 * rtols[1] * force),
        certain=orbit.disagreement <= agreement(jnp.asarray(rtols[1])),
    )


def is_idle(
    orbit: Orbit, least: Float[Array, ""] | float = 0.0, steady: Bool[Array, ""] | bool = False
) -> Bool[Array, ""]:
    """Return whether an `orbit` shows that no flank touches in the steady motion.

    Forces up to `least` (N) count as rounding. An orbit without contact is idle in two cases. In
    the first, it is `steady`, because the timing gear holds the pair. In the second, no torque
    brings a displaced pair back (Floquet multiplier 1 or unknown), so that the pair can rest
    anywhere. In any other case, an orbit without contact says nothing about the motion.
    """
    free = jnp.isnan(orbit.multiplier) | (orbit.multiplier > 1 - _FREE)
    return (orbit.response[0] <= least) & (orbit.response[2] <= least) & (free | steady)


def judged(
    orbit: Orbit,
    state: Float[Array, " n"],
    limits: tuple[Float[Array, ""] | float, Float[Array, ""] | float],
    rtols: tuple[Float[Array, ""] | float, Float[Array, ""] | float],
) -> Bool[Array, ""]:
    """Return whether an orbit is the stable motion that a transient led to.

    `state` (n,): end of the transient (scaled); `limits`: scaled distance to which the transient's
    states repeated, and greatest residual (scaled) of a closed orbit; `rtols`: tolerances of
    transient and orbit. The limits grow with the state if it exceeds 1. There are four conditions:

    - The orbit closes to the residual.
    - Its Floquet multipliers lie inside the unit circle.
    - It does not amplify errors of the size of its tolerance too much: I - M is far from singular.
    - It lies near `state`.
    """
    within, residual = limits
    size = jnp.maximum(1.0, jnp.max(jnp.abs(orbit.state)))
    multiplier = orbit.multiplier
    unit = jnp.eye(orbit.state.shape[0], dtype=orbit.state.dtype)
    gain = jnp.max(jnp.sum(jnp.abs(solved(unit - orbit.monodromy, unit)), axis=1))
    noise = NOISE * jnp.maximum(*rtols) * size
    near = 10 * within / jnp.maximum(1 - multiplier, 1e-3) + noise
    moved = jnp.max(jnp.abs(orbit.state - state))
    closed = orbit.residual <= residual * size
    return closed & (multiplier < 1) & (gain * rtols[1] < _UNKNOWN) & (moved <= near)


def is_consistent(orbit: Orbit, least: Float[Array, ""]) -> Bool[Array, ""]:
    """Return whether mean ≤ RMS ≤ peak force, to within about 1 % and within `least` (N).

    A violation shows that the steps were too coarse for short impacts. The computed mean square can
    then even be negative.
    """
    mean, square, peak = orbit.response[:3]
    ordered = (square + least**2 >= 0.98 * mean**2) & (peak**2 + least**2 >= 0.98 * square)
    return ordered & (mean >= -least)


def agreement(tolerance: Float[Array, ""]) -> Float[Array, ""]:
    """Return the `Orbit.disagreement` above which an orbit's derivatives are uncertain.

    `tolerance`: relative tolerance of the orbit."""
    scale, least, most = _AGREE
    return jnp.clip(scale * jnp.sqrt(tolerance), least, most)
