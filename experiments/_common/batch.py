"""Evaluate many designs at once, with one compiled program.

A batch is for surveys. Motions without an orbit are not examined further: give such a design to an
`Evaluator`.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.closed import Start, steady_motion
from rootsopt.dynamics.integrator import Integrator, Solver
from rootsopt.runtime.programs import CachedFunction
from rootsopt.runtime.threads import on_all_cores
from rootsopt.scene import Scene
from rootsopt.status import Status


class Batch(NamedTuple):
    """Responses of n designs with d parameters.

    `response` (n, 3): mean, peak and RMS force (N); `gradient` (n, 3, d): derivatives of `response`
    (N per config unit); `state` (n, s): scaled state of the orbit at φ1 = 0, a start for
    neighbouring designs; `period` (mesh periods); `multiplier`: greatest modulus of the Floquet
    multipliers; `residual` of the closed orbit; `steps`: number of solver steps; `status`: codes of
    `Status`. `response` and `gradient` are NaN where there is no periodic orbit.
    """

    response: Float[Array, "*n 3"]
    gradient: Float[Array, "*n 3 d"]
    state: Float[Array, "*n s"]
    period: Int[Array, "*n"]
    multiplier: Float[Array, "*n"]
    residual: Float[Array, "*n"]
    steps: Int[Array, "*n"]
    status: Int[Array, "*n"]

    @property
    def usable(self) -> Bool[Array, "*n"]:
        """Whether the pair settled on a stable periodic orbit, for each design."""
        return self.status == Status.PERIODIC.code


def coarse(
    scene: Scene,
    transient: Integrator,
    orbit: Integrator,
    max_periods: int = 64,
    max_orbit: int = 8,
) -> Solver:
    """Return the settings with which a batch finds the steady motions of a `scene`.

    `transient`, `orbit`: integrators of the transient and of the orbit; `max_periods`: maximum
    length of the transient (mesh periods); `max_orbit`: longest period of an orbit to find (mesh
    periods)."""
    return dataclasses.replace(
        scene.solver,
        transient=transient,
        orbit=orbit,
        max_periods=jnp.asarray(float(max_periods)),
        max_orbit=max_orbit,
    )


def respond(
    scene: Scene,
    design: Float[Array, " d"],
    state: Float[Array, " s"],
    solver: Solver,
    gradient: bool = True,
) -> Batch:
    """Return the steady response of one design, started from a scaled state.

    `design` (d,): in config units; `state` (s,): scaled state at φ1 = 0; `solver`: settings, such
    as those of `coarse`; `gradient`: whether to compute derivatives. This is a pure function: JAX
    can map it over `design`, `state` or the leaves of `scene`.
    """
    if gradient:
        pair, tangents, _ = scene.pair_and_tangents(design)
    else:
        pair, tangents, _ = scene.pair_and_tangents(design, ())
    start = Start.at(pair, pair.in_si(state), solver.max_orbit)
    found = steady_motion(pair, tangents, start, scene.pitch_radius, solver)
    orbit = found.orbit
    mean, square, peak = found.forces[:3]
    rms = jnp.sqrt(jnp.maximum(square, 0.0))
    by_mean, by_square, by_peak = found.sensitivity[:3]
    rows = jnp.stack([by_mean, by_peak, by_square / (2 * jnp.maximum(rms, 1e-30))])
    usable = found.status == Status.PERIODIC.code
    return Batch(
        response=jnp.where(usable, jnp.stack([mean, peak, rms]), jnp.nan),
        gradient=jnp.where(usable, rows, jnp.nan),
        state=orbit.state,
        period=found.period,
        multiplier=orbit.multiplier,
        residual=orbit.residual,
        steps=found.steps,
        status=found.status,
    )


def respond_many(
    scene: Scene,
    designs: Float[Array, "n d"],
    states: Float[Array, "n s"],
    solver: Solver,
    gradient: bool = True,
) -> Batch:
    """Return the responses of n designs, each started from its own scaled state.

    `designs` (n, d): in config units; `states` (n, s): scaled states at φ1 = 0; `solver`: see
    `coarse`; `gradient`: whether to compute derivatives. One thread per core evaluates one design
    at a time, so that no design waits for a slower one.
    """
    return on_all_cores(
        lambda designs, states: _in_turn(scene, designs, states, solver, gradient), designs, states
    )


@CachedFunction
def _in_turn(scene, designs, states, *settings) -> Batch:
    return lax.map(lambda at: respond(scene, *at, *settings), (designs, states))
