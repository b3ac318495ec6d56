"""The steady motion that a state leads to, with its orbit closed by collocation."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.closing import Closed, close, first_elements, sizes
from rootsopt.dynamics.collocation.equation import Equation
from rootsopt.dynamics.collocation.forces import Found
from rootsopt.dynamics.collocation.seed import seeded
from rootsopt.dynamics.flow import Flow, flow
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.linear import spectral_radius
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair

_STEPS = 1024
"""Maximum number of steps per mesh period of the motion from which an orbit is started."""
_ACCURACY = 10.0
"""Error of the forces that is accepted, in tolerances of the orbit's integration."""
_UNREFINED = 10.0
"""Factor by which the error estimate may exceed that where no finer mesh can be had."""
_REPEATS = 1e-6
"""Scaled difference of states below which an orbit repeats sooner than after its period."""
_MISS = 1e3
"""Distance (scaled) by which an integration from the orbit's own state may miss its start, in
tolerances times the greatest entry of the monodromy matrix."""
_APART = 1e4, 1e-4
"""Relative difference between the forces of the orbit and of that integration, in tolerances, and
its least limit."""


class Collocated(NamedTuple):
    """An orbit closed by collocation, and what is known about it.

    `orbit`: its `flow` is an integration from its own state over its period, and its residual the
    last correction; `closed`: result of collocation; `verified`: whether the integration closes and
    has the same forces.
    """

    orbit: Orbit
    closed: Closed
    verified: Bool[Array, ""]


def collocated(
    pair: RotorPair,
    tangents: Any,
    start: tuple[Float[Array, " n"], Int[Array, ""]],
    integrators: tuple[Integrator, Integrator],
    measures: Measures,
    sizes_of: tuple[int, int],
) -> Collocated:
    """Close the orbit that the motion from a state repeats nearly, and integrate it once.

    `start`: scaled state at φ1 = 0 and period (mesh periods); `integrators`: those of the transient
    and of the orbit, whose tolerance is the orbit's; `sizes_of`: number of samples of the
    integration, and the longest period (mesh periods)."""
    state, period = start
    samples, longest = sizes_of
    transient, integrator = integrators
    elements, _ = seeded(
        jax.lax.stop_gradient(pair),
        state,
        period,
        dataclasses.replace(transient, max_steps=min(integrator.max_steps, _STEPS * longest)),
        first_elements(period),
        sizes(longest),
    )
    tolerance = integrator.tolerance(state.dtype)
    equation = Equation(pair, measures, pair.force_scale)
    closed = close(equation, tangents, elements, _ACCURACY * tolerance)
    found = closed.found
    length, peak = period.astype(state.dtype), found.response[2]
    top = jnp.where(peak > 0, peak, pair.force_scale)
    out = flow(pair, found.state, length, integrator, samples, measures=measures, top=top)
    miss = jnp.max(jnp.abs(out.end - found.state))
    size = jnp.maximum(1.0, jnp.max(jnp.abs(found.state)))
    gain = jnp.maximum(1.0, jnp.max(jnp.abs(found.monodromy)))
    factor, least = _APART
    scale = jnp.maximum(jnp.abs(found.response[:3]), 1e-30)
    apart = jnp.max(jnp.abs(out.response[:3] - found.response[:3]) / scale)
    verified = closed.sound & (miss <= _MISS * tolerance * size * gain)
    verified &= apart <= jnp.maximum(factor * tolerance, least)
    verified &= closed.error <= _UNREFINED * _ACCURACY * tolerance
    # The transient may have taken a whole number of periods for one.
    shorter = jnp.arange(1, max(longest // 2, 1) + 1)
    states = jax.vmap(found.elements.motion)(shorter.astype(state.dtype))
    repeats = jnp.max(jnp.abs(states - found.state), axis=1) < _REPEATS
    verified &= ~jnp.any(repeats & (shorter < period) & (period % shorter == 0))
    orbit = Orbit(
        state=found.state,
        flow=_as_flow(out, found),
        residual=jnp.where(closed.sound, found.correction, jnp.inf),
        monodromy=found.monodromy,
        multiplier=spectral_radius(found.monodromy),
        response=found.response,
        sensitivity=found.sensitivity,
        moved=found.moved,
        newton_steps=closed.steps,
        drift=jnp.zeros_like(peak),
        defect=jnp.zeros_like(peak),
        disagreement=closed.drift,
    )
    return Collocated(orbit, closed, verified)


def _as_flow(out: Flow, found: Found) -> Flow:
    """Return the integration `out` with the forces of the orbit, and their derivatives with respect
    to the first state unknown."""
    response = found.response
    rows = found.state.shape[0] + response.shape[0]
    columns = found.state.shape[0] + found.moved.shape[1]
    return out._replace(
        mean=response[0],
        mean_square=response[1],
        peak=response[2],
        others=response[3:],
        depth=jnp.maximum(out.depth, found.depth),
        slope=jnp.zeros((rows, columns), response.dtype),
    )
