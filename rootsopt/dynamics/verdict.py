"""Checks of a closed orbit: whether it is the steady motion, and whether its forces are known.

The checks are the same for single designs and for batches.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.impact import force_rounding
from rootsopt.dynamics.linear import solved
from rootsopt.dynamics.orbit import Orbit, agreement
from rootsopt.dynamics.settle import NOISE

RESIDUAL = 1e-9
"""Residual (scaled) above which an orbit does not count as closed."""
TOO_DEEP = 0.02
"""Penetration (pitch radii) above which the forces of an orbit are not valid."""
UNRESOLVED = 1e-2
"""Relative error of the greatest force, from rounding of the gap, above which an orbit's forces
count as unresolved."""
_UNKNOWN = 0.1
"""Estimated error of an orbit (scaled) above which the orbit is rejected."""
_FREE = 1e-6
"""Distance from 1 below which a Floquet multiplier counts as 1. A multiplier above 1 also does."""
_DEFECT = 1e3
"""Residual on halved steps (tolerances) above which an orbit's derivatives are uncertain. This
limit is multiplied by the greatest entries of the state and of the monodromy matrix, where they
exceed 1."""
_DRIFT = 1e3, 1e-5
"""Change of an orbit's start since the last search for kinks above which the derivatives are
uncertain. The limit is the first number (tolerances), but at least the second (scaled). After a
greater change, some kinks may lie inside long steps."""
_STRAINED = 100.0
"""Estimated error of a repeated step (tolerances) above which an orbit is rejected."""


class Verdict(NamedTuple):
    """Results of the checks of a closed orbit.

    `idle`: whether no flank ever touches (`is_idle`); `steady`: whether the orbit is the stable
    motion that the transient led to (`judged`); `rounding`: relative error of the greatest force
    (`force_rounding`); `consistent`: whether mean ≤ RMS ≤ peak (`is_consistent`); `certain`:
    whether the derivatives are reliable (`is_certain`).
    """

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
    """Return the results of all checks of an `orbit`.

    `scales`: exponent of the contact law, pitch radius (m), unit of force (N). For the other
    arguments, see `judged`."""
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
    """Return whether an `orbit` shows that no flank touches in the steady motion.

    Forces up to `least` (N) count as rounding. An orbit without contact is idle in two cases. In
    the first, it is `steady`, because the timing gear holds the pair. In the second, no torque
    brings a displaced pair back (Floquet multiplier 1 or unknown), so that the pair can rest
    anywhere. In any other case, an orbit without contact says nothing about the motion.
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
    """Return whether an orbit is the stable motion that a transient led to.

    `rtols`: tolerances of transient and orbit; `state` (n,): end of the transient (scaled);
    `within`: scaled distance to which the transient's states repeated; `residual`: greatest
    residual (scaled) of a closed orbit. The limits grow with the state if it exceeds 1. There are
    four conditions:

    - The orbit closes to `residual`, on steps that the solver would accept.
    - Its Floquet multipliers lie inside the unit circle.
    - It does not amplify errors of the size of its tolerance too much: I - M is far from singular.
    - It lies near `state`.
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
    """Return whether mean ≤ RMS ≤ peak force, to within about 1 % and within `least` (N).

    A violation shows that the steps were too coarse for short impacts. The computed mean square can
    then even be negative.
    """
    mean, square, peak = orbit.response[:3]
    ordered = (square + least**2 >= 0.98 * mean**2) & (peak**2 + least**2 >= 0.98 * square)
    return ordered & (mean >= -least)


def is_certain(orbit: Orbit, rtol: Float[Array, ""]) -> Bool[Array, ""]:
    """Return whether the derivatives of an orbit integrated at `rtol` are reliable.

    There are three conditions. On halved steps, the orbit must close to a multiple of the
    tolerance. The derivatives on these steps must agree with the original ones. The orbit must have
    moved only a little since the last search for kinks."""
    size = jnp.maximum(1.0, jnp.max(jnp.abs(orbit.state)))
    gain = jnp.maximum(1.0, jnp.max(jnp.abs(orbit.monodromy)))
    closes = orbit.defect <= _DEFECT * rtol * size * gain
    agree = orbit.disagreement <= agreement(rtol.astype(orbit.state.dtype))
    tolerances, least = _DRIFT
    near = orbit.drift <= jnp.maximum(tolerances * rtol, least) * size
    return closes & agree & near
