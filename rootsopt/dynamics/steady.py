"""Steady state: let the transient pass, check that it has, close the orbit.

The pair is forced with the mesh period. After a transient the states at the end of each
mesh period (the stroboscopic map) settle on a cycle of k points; Newton's method on the
k-fold map closes it, and the monodromy matrix tells whether it is stable. Where it does
not settle, the largest Lyapunov exponent tells chaos from a long transient.
"""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.flow import Flow, Integrator, flow, strobe
from rootsopt.dynamics.pair import RotorPair

BLOCK = 16
"""Mesh periods integrated between two looks at the transient."""
SAMPLES = 2520
"""Uniform samples of an orbit; divisible by every period up to ten, so that a shorter
period inside an orbit shows at a sample."""
_NEWTON_STEPS = 12


class Transient(NamedTuple):
    """End of a transient.

    `state`: last stroboscopic state; `period`: its cycle length k in mesh periods, 0 if
    it has not settled; `periods`: mesh periods simulated; `lost`: lobes passed through
    each other; `solved`: whether the solver got through; `steps`: solver steps.
    """

    state: Float[Array, "2"]
    period: Int[Array, ""]
    periods: Int[Array, ""]
    lost: Bool[Array, ""]
    solved: Bool[Array, ""]
    steps: Int[Array, ""]


class Orbit(NamedTuple):
    """A closed orbit of k mesh periods with first derivatives.

    `state` at φ1 = 0; `flow` over the orbit; `residual` |Φ(z) - z| in scaled units;
    `monodromy` dΦ/dz; `response`: (mean, mean square, peak); `sensitivity` (3, d): their
    derivatives along the orbit family with respect to the design; `newton_steps`.
    """

    state: Float[Array, "2"]
    flow: Flow
    residual: Float[Array, ""]
    monodromy: Float[Array, "2 2"]
    response: Float[Array, "3"]
    sensitivity: Float[Array, "3 d"]
    newton_steps: Int[Array, ""]


class _Shot(NamedTuple):
    """One evaluation of the shooting map: where, how far from closed, value, slope."""

    state: Float[Array, "2"]
    residual: Float[Array, ""]
    value: Float[Array, "5"]
    slope: Float[Array, "5 n"]
    flow: Flow


def settle(
    pair: RotorPair,
    state: Float[Array, "2"],
    how: Integrator,
    tolerance: Float[Array, ""],
    max_periods: Int[Array, ""],
    max_orbit: int,
) -> Transient:
    """Integrate block by block until the last states repeat with some period k.

    Settled means: over the last half block, states k periods apart differ by less than
    `tolerance` (scaled units), for the smallest such k ≤ `max_orbit`.
    """
    half = BLOCK // 2

    def cycle(states):
        def spread(k):
            earlier = lax.dynamic_slice(states, (half - k, 0), (half, 2))
            return jnp.max(jnp.abs(states[half:] - earlier))

        orders = jnp.arange(1, max_orbit + 1)
        settled = jax.vmap(spread)(orders) < tolerance
        return jnp.where(jnp.any(settled), orders[jnp.argmax(settled)], 0)

    def go_on(carry):
        state, period, periods, lost, solved, _ = carry
        alive = ~lost & solved & jnp.all(jnp.isfinite(state))
        return (period == 0) & alive & (periods < max_periods)

    def advance(carry):
        state, _, periods, _, _, steps = carry
        part = strobe(pair, state, BLOCK, how)
        end = part.states[-1]
        relative = pair.angle_scale * end[0]
        lost = jnp.abs(relative) >= pair.angle_limit
        sound = part.solved & ~lost & jnp.all(jnp.isfinite(end))
        period = jnp.where(sound, cycle(part.states), 0)
        return Transient(end, period, periods + BLOCK, lost, part.solved, steps + part.steps)

    zero = jnp.zeros((), int)
    no, yes = jnp.zeros((), bool), jnp.ones((), bool)
    return lax.while_loop(go_on, advance, Transient(state, zero, zero, no, yes, zero))


def close_orbit(
    pair: RotorPair,
    tangents: RotorPair,
    directions: int,
    state: Float[Array, "2"],
    period: Int[Array, ""],
    how: Integrator,
    tolerance: float,
) -> Orbit:
    """Newton shooting on Φ(z) = z, then the implicit function theorem for gradients.

    `tangents` holds d pair / d design, stacked along a leading axis of `directions`.
    Forward mode: state and design directions are carried together through diffrax.
    """
    length = period.astype(state.dtype)
    adjoint = diffrax.ForwardMode()
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)

    def run(state, dynamic):
        out = flow(eqx.combine(dynamic, static), state, length, how, SAMPLES, adjoint)
        return jnp.concatenate([out.end, response_vector(out)]), out

    def jacobian(state):
        """Value and derivatives with respect to (state, design): (5, 2 + d)."""
        along_state = (jnp.eye(2), jax.tree.map(lambda x: jnp.zeros((2, *x.shape)), dynamic))
        along_design = (jnp.zeros((directions, 2)), tangents)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), along_state, along_design)

        def push(tangent):
            value, slope, out = jax.jvp(run, (state, dynamic), tangent, has_aux=True)
            return value, slope, out

        value, slope, out = jax.vmap(push, out_axes=(None, 1, None))(both)
        return value, slope, out

    def go_on(carry):
        # Stop when closed, when the count is out, or when it no longer improves: the
        # steps the adaptive solver takes depend on the state, which leaves a floor.
        found, _, count, best = carry
        improving = (count < 3) | (found.residual < 0.5 * best)
        return (found.residual > tolerance) & (count < _NEWTON_STEPS) & improving

    def step(carry):
        found, state, count, best = carry
        value, slope, out = jacobian(state)
        residual = jnp.max(jnp.abs(value[:2] - state))
        correction = jnp.linalg.solve(slope[:2, :2] - jnp.eye(2), state - value[:2])
        # Keep the first steps inside the neighbourhood the transient pointed to.
        size = jnp.max(jnp.abs(correction))
        new = state + correction * jnp.minimum(1.0, 0.5 / jnp.maximum(size, 1e-300))
        shot = _Shot(state, residual, value, slope, out)
        return shot, new, count + 1, jnp.minimum(best, found.residual)

    # The loop holds the only copy of the integration: one shot is compiled, not two.
    shapes = jax.eval_shape(jacobian, state)
    value, slope, out = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    first = _Shot(state, jnp.asarray(jnp.inf), value, slope, out)
    start = (first, state, jnp.zeros((), int), jnp.asarray(jnp.inf))
    (state, residual, value, slope, out), _, count, _ = lax.while_loop(go_on, step, start)
    monodromy = slope[:2, :2]
    moved = jnp.linalg.solve(jnp.eye(2) - monodromy, slope[:2, 2:])
    return Orbit(
        state=state,
        flow=out,
        residual=residual,
        monodromy=monodromy,
        response=value[2:],
        sensitivity=slope[2:, 2:] + slope[2:, :2] @ moved,
        newton_steps=count,
    )


def response_vector(out: Flow) -> Float[Array, "3"]:
    """(mean, mean square, peak) of the contact force."""
    return jnp.stack([out.mean, out.mean_square, out.peak])


def reverse_sensitivity(
    build,
    design: Float[Array, " d"],
    state: Float[Array, "2"],
    period: Int[Array, ""],
    how: Integrator,
) -> Float[Array, "3 d"]:
    """The same sensitivity by reverse mode, through diffrax's checkpointed adjoint.

    With cotangents v of a response and w of the end state, the implicit function
    theorem asks for (I - M)ᵀ w = R_zᵀ v and gives dR/dp = R_pᵀ v + Φ_pᵀ w.
    """
    length = period.astype(state.dtype)

    def run(state, design):
        out = flow(build(design), state, length, how, SAMPLES, diffrax.RecursiveCheckpointAdjoint())
        return jnp.concatenate([out.end, response_vector(out)])

    _, pull = jax.vjp(run, state, design)
    by_state, by_design = jax.vmap(pull)(jnp.eye(5))
    monodromy, response = by_state[:2], by_state[2:]
    weight = jnp.linalg.solve((jnp.eye(2) - monodromy).T, response.T)
    return by_design[2:] + weight.T @ by_design[:2]


class Lyapunov(NamedTuple):
    """Largest Lyapunov exponent per mesh period, its standard error, and statistics of
    the force over the window it was measured on."""

    exponent: Float[Array, ""]
    error: Float[Array, ""]
    flows: Flow
    state: Float[Array, "2"]


def lyapunov(pair: RotorPair, state: Float[Array, "2"], periods: int, how: Integrator) -> Lyapunov:
    """Growth of a tangent vector over `periods` mesh periods, renormalised each period.

    The standard error comes from 16 batch means.
    """
    one = jnp.ones(())
    adjoint = diffrax.ForwardMode()

    def step(carry, _):
        state, tangent = carry

        def run(state):
            out = flow(pair, state, one, how, SAMPLES // 4, adjoint)
            return out.end, out

        end, moved, out = jax.jvp(run, (state,), (tangent,), has_aux=True)
        size = jnp.linalg.norm(moved)
        safe = jnp.where(size > 0, size, 1.0)
        return (end, moved / safe), (jnp.log(safe), out)

    direction = jnp.array([1.0, 0.0])
    (end, _), (growth, flows) = lax.scan(step, (state, direction), length=periods)
    batches = jnp.mean(growth.reshape(16, -1), axis=1)
    error = jnp.std(batches, ddof=1) / 4
    return Lyapunov(jnp.mean(growth), error, flows, end)


def floquet(monodromy: Float[Array, "2 2"]) -> Float[Array, "2"]:
    """Moduli of the Floquet multipliers, from trace and determinant (real arithmetic)."""
    half = jnp.trace(monodromy) / 2
    determinant = jnp.linalg.det(monodromy)
    square = half**2 - determinant
    root = jnp.sqrt(jnp.abs(square))
    real = jnp.stack([jnp.abs(half + root), jnp.abs(half - root)])
    pair = jnp.sqrt(jnp.abs(determinant)) * jnp.ones(2)
    return jnp.where(square >= 0, real, pair)
