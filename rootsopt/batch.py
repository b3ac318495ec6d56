"""Many designs at once: one compiled program over a batch.

The same steps as `evaluate.Evaluator` (settle, close the orbit, differentiate), without
its second attempts and without the check of the derivatives on halved steps, and with orbits closed
to a tenth of the tolerance: a design that needs more is reported as not settled or inaccurate, and
can be given to an `Evaluator`.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.flow import Integrator
from rootsopt.dynamics.steady import (
    close_orbit,
    settle,
    settled_within,
)
from rootsopt.dynamics.verdict import RESIDUAL, TOO_DEEP, UNRESOLVED, verdict
from rootsopt.model import Model
from rootsopt.programs import Program
from rootsopt.status import Status

_SHOTS = 8
"""Integrations that closing an orbit may take."""
SAMPLES = 840
"""Uniform samples of an orbit, among which the peak is looked for; divisible by all
periods up to eight."""
STATUSES = (
    Status.PERIODIC,
    Status.SOLVER_FAILED,
    Status.PASSED_THROUGH,
    Status.NON_FINITE,
    Status.NOT_SETTLED,
    Status.STALLED,
    Status.TOO_DEEP,
    Status.IDLE,
    Status.UNRESOLVED,
    Status.INACCURATE,
)


class Batch(NamedTuple):
    """Outcome of n designs with d parameters; NaN where there is no periodic orbit.

    `response` (n, 3): mean, peak and RMS force (N); `gradient` (n, 3, d) per config unit;
    `state` (n, s): scaled state of the orbit at φ1 = 0, a start for neighbouring designs;
    `period` (mesh periods), largest Floquet `multiplier`, `residual` of the closed orbit;
    `deepest`: least ε (rad) on the orbit; `steps` of the solver; `status`: index into
    `STATUSES`.
    """

    response: Float[Array, "*n 3"]
    gradient: Float[Array, "*n 3 d"]
    state: Float[Array, "*n s"]
    period: Int[Array, "*n"]
    multiplier: Float[Array, "*n"]
    residual: Float[Array, "*n"]
    deepest: Float[Array, "*n"]
    steps: Int[Array, "*n"]
    status: Int[Array, "*n"]

    @property
    def usable(self) -> Bool[Array, "*n"]:
        """Where the pair settled on a stable periodic orbit."""
        return self.status == 0


def respond(
    model: Model,
    design: Float[Array, " d"],
    state: Float[Array, " s"],
    transient: Integrator,
    orbit: Integrator,
    max_periods: int = 64,
    max_orbit: int = 8,
    gradient: bool = True,
) -> Batch:
    """Steady response of one design from the scaled `state`, as a pure function.

    Traceable: map it over `design`, `state` or the leaves of `model`.
    """

    if gradient:
        pair, tangents, _ = model.pair_and_tangents(design)
    else:
        pair = model.pair(design)
        dynamic = eqx.filter(pair, eqx.is_inexact_array)
        tangents = jax.tree.map(lambda x: jnp.zeros((0, *x.shape), x.dtype), dynamic)
    state = state.astype(pair.angle_scale.dtype)
    limit = jnp.asarray(max_periods)
    tolerance = settled_within(transient.rtol).astype(state.dtype)
    settled = settle(pair, state, transient, tolerance, limit, max_orbit)
    period = jnp.maximum(settled.period, 1)
    enough = 0.1 * orbit.rtol
    # Nothing is there to be closed where the transient has not settled.
    shots = jnp.where(settled.period > 0, _SHOTS, 0)
    settings = orbit, None, SAMPLES, shots, enough, False
    closed = close_orbit(pair, tangents, settled.state, period, *settings)
    ran = settled.period > 0
    forces, slopes = (jnp.all(jnp.isfinite(x)) for x in (closed.response, closed.sensitivity))
    rtols = transient.tolerance(state.dtype), orbit.tolerance(state.dtype)
    open_by = jnp.maximum(enough, RESIDUAL[model.precision])
    scales = model.law.exponent, model.pitch_radius, pair.force_scale
    found = verdict(closed, settled.state, tolerance, rtols, open_by, scales)
    outcomes = (
        (~settled.solved, Status.SOLVER_FAILED),
        (pair.stalled(settled.state), Status.STALLED),
        (settled.lost, Status.PASSED_THROUGH),
        (~jnp.all(jnp.isfinite(settled.state)), Status.NON_FINITE),
        (~ran, Status.NOT_SETTLED),
        (~closed.flow.solved, Status.SOLVER_FAILED),
        (found.idle, Status.IDLE),
        (~forces, Status.NON_FINITE),
        (~found.steady, Status.NOT_SETTLED),
        (~slopes, Status.NON_FINITE),
        (closed.flow.depth > TOO_DEEP * model.pitch_radius, Status.TOO_DEEP),
        ((found.rounding > UNRESOLVED) | ~found.consistent, Status.UNRESOLVED),
        (~found.certain, Status.INACCURATE),
    )
    conditions, names = zip(*outcomes, strict=True)
    status = jnp.select(conditions, [STATUSES.index(name) for name in names], 0)
    usable = status == 0
    mean, square, peak = closed.response
    rms = jnp.sqrt(jnp.maximum(square, 0.0))
    by_mean, by_square, by_peak = closed.sensitivity
    rows = jnp.stack([by_mean, by_peak, by_square / (2 * jnp.maximum(rms, 1e-30))])
    return Batch(
        response=jnp.where(usable, jnp.stack([mean, peak, rms]), jnp.nan),
        gradient=jnp.where(usable, rows, jnp.nan),
        state=closed.state,
        period=period,
        multiplier=closed.multiplier,
        residual=closed.residual,
        deepest=pair.angle_scale * jnp.min(closed.flow.states[:, 0]),
        steps=settled.steps + closed.flow.steps,
        status=status,
    )


def respond_many(
    model: Model,
    designs: Float[Array, "n d"],
    states: Float[Array, "n s"],
    transient: Integrator,
    orbit: Integrator,
    max_periods: int = 64,
    max_orbit: int = 8,
    gradient: bool = True,
) -> Batch:
    """`respond` over designs (n, d) in config units, each from its own scaled state.

    On CPUs a thread for each core takes the designs one by one: stepping many together, each
    would wait for the slowest at every turn. On other devices all are stepped together.
    """
    settings = transient, orbit, max_periods, max_orbit, gradient
    if jax.default_backend() != "cpu":
        return _together(model, designs, states, *settings)
    return on_all_cores(
        lambda designs, states: _in_turn(model, designs, states, *settings), designs, states
    )


def on_all_cores(work: Callable[..., Any], *arrays: Any) -> Any:
    """`work(*arrays)` with the leading axis (n,) of all arrays, and of its result, divided among
    threads, one for each core.

    The parts have one size, so that they share a compiled program.
    """
    count = arrays[0].shape[0]
    workers = max(1, min(os.cpu_count() or 1, count))
    size = -(-count // workers)
    # The last entry fills the last part up.
    index = np.minimum(np.arange(workers * size), count - 1).reshape(workers, size)
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(lambda rows: work(*(x[rows] for x in arrays)), index))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:count], *parts)


@Program
def _together(model, designs, states, *settings) -> Batch:
    return jax.vmap(lambda design, state: respond(model, design, state, *settings))(designs, states)


@Program
def _in_turn(model, designs, states, *settings) -> Batch:
    return lax.map(lambda at: respond(model, *at, *settings), (designs, states))
