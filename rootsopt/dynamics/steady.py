"""A steady motion: its status and its orbit.

Checks whether an orbit is the steady motion, and whether its forces are accurate. The checks are
the same for single designs and for batches.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rootsopt.contact.law import force_rounding
from rootsopt.dynamics.collocation.elements import GAUSS, Elements
from rootsopt.dynamics.collocation.mesh import KnownOrbit
from rootsopt.dynamics.collocation.system import Step, moved_at
from rootsopt.dynamics.integrator import Solver
from rootsopt.dynamics.linear import solved
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.window import NOISE, Transient, Window
from rootsopt.status import Status

TOO_DEEP = 0.02
"""Penetration (pitch radii) above which the forces of an orbit are invalid."""
UNRESOLVED = 1e-2
"""Relative error of the greatest force, from rounding of the gap, above which an orbit's forces
count as unresolved."""
# Estimated error of an orbit (scaled) above which the orbit is rejected.
_UNKNOWN = 0.1
# Distance from 1 below which a Floquet multiplier counts as 1. So does a multiplier above 1.
_FREE = 1e-6
# Estimated relative error of the derivatives above which they are uncertain. The limit is the first
# number times the square root of the tolerance, at least the second number and at most the third.
_AGREE = 10.0, 1e-3, 3e-2


class Verdict(NamedTuple):
    """Results of the checks of a closed orbit.

    `idle`: whether no flank ever touches (`is_idle`); `steady`: whether the orbit is the stable
    motion that the transient led to (`is_steady`); `rounding`: relative error of the greatest force
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
    arguments, see `is_steady`."""
    exponent, radius, force = scales
    rounding = force_rounding(orbit.depth, exponent, radius)
    steady = is_steady(orbit, state, limits, rtols)
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


def is_steady(
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


SAMPLES = 2520
"""Number of uniform samples of an orbit. It is divisible by every period up to ten, so that a
sample falls on the end of each mesh period."""


class Steady(NamedTuple):
    """The steady motion to which a state leads.

    `status`: code of a `Status`; `orbit`: the orbit found, or the last one tried; `period` (mesh
    periods) and `verdict`: length of this orbit, and the results of its checks; `window` of a
    motion without an orbit, `None` if it was not examined; `settled`: end of the transient; `used`:
    mesh periods of all transients; `steps`: number of their solver steps; `known`: the orbit, in
    the form from which those of similar pairs can be closed.
    """

    status: Int[Array, ""]
    orbit: Orbit
    period: Int[Array, ""]
    verdict: Verdict
    window: Window | None
    settled: Transient
    used: Int[Array, ""]
    steps: Int[Array, ""]
    known: KnownOrbit

    @property
    def forces(self) -> Float[Array, " r"]:
        """Mean (N), mean square (N²), peak (N) and the further measures of the contact force.

        For a closed orbit, all of them are known. For a complete window of a motion without an
        orbit, the further measures are NaN. Without contact, all of them are 0. Otherwise, they are
        NaN."""
        closed = self.orbit.response
        unknown = jnp.full_like(closed, jnp.nan)
        forces = jnp.where(among(self.status, CLOSED), closed, unknown)
        if self.window is not None:
            whole = self.window.done == self.window.growth.shape[0]
            window = among(self.status, OPEN) & whole
            forces = jnp.where(window, unknown.at[:3].set(self.window.forces), forces)
        return jnp.where(self.status == Status.IDLE.code, jnp.zeros_like(closed), forces)

    @property
    def sensitivity(self) -> Float[Array, "r d"]:
        """Derivatives of `forces` along the requested directions.

        They are 0 if the timing gear keeps the flanks apart, and NaN without a periodic orbit."""
        sensitivity = self.orbit.sensitivity
        sensitivity = jnp.where(self.status == Status.PERIODIC.code, sensitivity, jnp.nan)
        return jnp.where(self.held, jnp.zeros_like(sensitivity), sensitivity)

    @property
    def held(self) -> Bool[Array, ""] | np.bool_:
        """Whether the timing gear keeps the flanks apart, on a stable orbit.

        Without a torque that brings it back, a pair without contact can rest anywhere."""
        return (self.status == Status.IDLE.code) & self.verdict.idle & self.verdict.steady


CLOSED = (Status.PERIODIC, Status.INACCURATE, Status.TOO_DEEP, Status.UNRESOLVED)
"""Statuses of a closed orbit with contact."""
OPEN = (Status.CHAOTIC, Status.NOT_SETTLED, Status.NOT_CLOSED)
"""Statuses of a motion without an orbit, whose forces are those of a window."""


def among(code: Int[Array, "*n"], statuses: tuple[Status, ...]) -> Bool[Array, "*n"]:
    """Return whether a status code belongs to one of the `statuses`."""
    return jnp.any(jnp.stack([code == status.code for status in statuses]), axis=0)


def judged(
    pair: RotorPair,
    solver: Solver,
    radius: Float[Array, ""],
    orbit: Orbit,
    start: Float[Array, " n"],
    limits: tuple[Float[Array, ""], Float[Array, ""]],
) -> tuple[Verdict, Int[Array, ""]]:
    """Return the `Verdict` on an orbit of `pair`, and a status code.

    `radius`: pitch radius (m); `start`: scaled state near which the orbit must lie; `limits`:
    scaled distance to which the transient's states repeated, and residual (scaled) above which the
    orbit does not count as closed. The accuracy of the forces is checked later, by `final`."""
    rtols = solver.transient.tolerance, solver.orbit.tolerance
    scales = pair.law.exponent, radius, pair.force_scale
    checks = verdict(orbit, start, limits, rtols, scales)
    numbers = jnp.concatenate([orbit.response, orbit.state])
    # A pair that is not smooth never has derivatives. Their absence is not a failure.
    unknown = ~jnp.all(jnp.isfinite(orbit.sensitivity)) & pair.contact.smooth
    status = _first(
        (checks.idle, Status.IDLE),
        (~jnp.all(jnp.isfinite(numbers)), Status.NON_FINITE),
        # Checked before the derivatives, which are unknown if the orbit amplifies errors.
        (~checks.steady, Status.NOT_SETTLED),
        (unknown, Status.NON_FINITE),
        (~checks.certain, Status.INACCURATE),
        default=Status.PERIODIC.code,
    )
    return checks, status


def final(pair: RotorPair, motion: Steady, radius: Float[Array, ""]) -> Steady:
    """Return `motion`, with a different status if the forces of its orbit are not valid.

    The status is then UNSOUND (no such rotors), TOO_DEEP (the flanks penetrate too deep) or
    UNRESOLVED (the numerical errors of the forces are too large). `radius`: pitch radius (m)."""
    orbit, checks = motion.orbit, motion.verdict
    closed = among(motion.status, (Status.PERIODIC, Status.INACCURATE))
    deep = orbit.depth > TOO_DEEP * radius
    vague = (checks.rounding > UNRESOLVED) | ~checks.consistent
    status = jnp.where(closed & vague, Status.UNRESOLVED.code, motion.status)
    status = jnp.where(closed & deep, Status.TOO_DEEP.code, status)
    return motion._replace(status=jnp.where(pair.sound, status, Status.UNSOUND.code))


def transient_status(pair: RotorPair, settled: Transient) -> Int[Array, ""]:
    """Return the status code of a transient that has not settled, or -1 if it has settled."""
    return _first(
        (~pair.sound, Status.UNSOUND),
        (~settled.solved, Status.SOLVER_FAILED),
        (~jnp.all(jnp.isfinite(settled.state)), Status.NON_FINITE),
        (settled.lost & pair.stalled(settled.state), Status.STALLED),
        (settled.lost, Status.PASSED_THROUGH),
        (settled.period == 0, Status.NOT_SETTLED),
        default=-1,
    )


def window_status(pair: RotorPair, window: Window) -> Int[Array, ""]:
    """Return the status code of a motion that has not settled, judged by a `window` of it."""
    finite = jnp.all(jnp.isfinite(window.response)) & jnp.isfinite(window.exponent)
    lost = pair.lost(window.end)
    least = float(jnp.finfo(window.end.dtype).eps) * pair.force_scale
    return _first(
        (lost & pair.stalled(window.end), Status.STALLED),
        (lost, Status.PASSED_THROUGH),
        (~finite, Status.NON_FINITE),
        (~window.solved, Status.SOLVER_FAILED),
        (jnp.max(window.response[:, 2]) <= least, Status.IDLE),
        (window.chaotic, Status.CHAOTIC),
        default=Status.NOT_SETTLED.code,
    )


def _first(*cases: tuple[Bool[Array, ""], Status], default: int) -> Int[Array, ""]:
    """Return the status code of the first of `cases` whose condition is true, or `default`."""
    conditions, statuses = zip(*cases, strict=True)
    return jnp.select(conditions, [jnp.asarray(s.code) for s in statuses], jnp.asarray(default))


class VariedOrbit(NamedTuple):
    """A closed orbit, and its changes along d directions of the parameters.

    `elements`: the orbit; `variation`: its changes, one column for each direction."""

    elements: Elements
    variation: Step

    def at(
        self, tau: Float[Array, "*m"]
    ) -> tuple[Float[Array, "*m n"], Float[Array, "*m n"], Float[Array, "*m n d"]]:
        """Return the scaled states at the times `tau` (mesh periods), and their derivatives with
        respect to time and along the directions.

        The orbit continues periodically. Derivatives along the directions are those at constant
        time."""
        elements = self.elements
        k, tau = elements.holding(tau)
        share = elements.share(k, tau)
        rate = jnp.sum(GAUSS.lagrange(share)[..., None] * elements.slopes[k], axis=-2)
        times, moved = moved_at(elements, self.variation, k, share)
        return elements.inside(k, tau), rate, moved - rate[..., None] * times[..., None, :]

    def pushed(
        self, quantity: Callable[..., Any], tau: Float[Array, ""], model: Any, tangents: Any
    ) -> tuple[Float[Array, "*q"], Float[Array, "*q d"]]:
        """Return `quantity(model, tau, state)`, and its derivatives along the directions.

        Time is held constant. `tau`: in mesh periods; `model`: a pair, or another object that
        depends on the directions; `tangents`: its derivatives along them, with a leading axis."""
        dynamic, static = eqx.partition(model, eqx.is_inexact_array)
        state, _, changes = self.at(tau)

        def push(change, along):
            def value(state, dynamic):
                return quantity(eqx.combine(dynamic, static), tau, state)

            return jax.jvp(value, (state, dynamic), (change, along))

        moved = eqx.filter(tangents, eqx.is_inexact_array)
        return jax.vmap(push, (1, 0), (None, -1))(changes, moved)


def varied(motion: Steady) -> VariedOrbit:
    """Return the closed orbit of a motion, with its variation.

    The motion must have been found with `Solver.variation`."""
    assert motion.orbit.variation is not None
    return VariedOrbit(motion.known.elements, motion.orbit.variation)
