"""The steady motion near the end of a transient, as an orbit closed by collocation."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.closing import Closed, close, first_elements
from rootsopt.dynamics.collocation.equation import CollocatedEquation
from rootsopt.dynamics.collocation.forces import OrbitForces
from rootsopt.dynamics.collocation.known import Known
from rootsopt.dynamics.collocation.mesh import sizes
from rootsopt.dynamics.collocation.sampled import as_flow
from rootsopt.dynamics.collocation.seed import seeded
from rootsopt.dynamics.flow import Flow, flow
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.linear import spectral_radius
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair

_STEPS = 1024
"""Maximum number of solver steps, per mesh period of the longest orbit, of the integration that
provides the first elements."""
ACCURACY = 10.0
"""Requested relative error of the forces, in tolerances of the orbit's integrator."""
UNREFINED = 10.0
"""Estimated error of the forces above which an orbit is rejected, in multiples of the requested
error. The estimate exceeds the request if the mesh has no room for refinement."""
_REPEATS = 1e3, 1e-5
"""Scaled difference between the states at φ1 = 0 and after a fraction of the period, below which
this fraction is the orbit's true period. The limit is the first number (tolerances), but at least
the second."""
_MISS = 1e4, 1e-4
"""Scaled difference between the start and the end of an integration from the orbit's state, above
which the orbit is rejected. The limit is the first number (tolerances), but at least the second.
It is multiplied by the greatest entries of the state and of the monodromy matrix, where they exceed
1."""
_APART = 1e4, 1e-4
"""Relative difference between the forces of the orbit and of an integration from its state, above
which the orbit is rejected. The limit is the first number (tolerances), but at least the second.
Forces that differ by less than `_FAINT` agree."""
_FAINT = 10.0
"""Difference between forces that is not an error, in tolerances of the unit of force. So small a
force cannot be integrated to its own digits."""


class Collocated(NamedTuple):
    """An orbit closed by collocation, with the results of its checks.

    `orbit`: its `flow` is an integration over one period, with the forces from collocation; its
    `residual` is the last correction, inf if the orbit is not sound. `sound`: whether Newton's
    method has converged on a mesh that ends at the orbit's events; otherwise the orbit has no
    meaning. `shorter`: true period (mesh periods) if the orbit repeats after a fraction of its
    period, otherwise 0. `verified`: whether the orbit is sound and accurate, does not repeat, and
    the integration confirms it. `known`: the orbit in the form from which orbits of similar pairs
    can be closed.
    """

    orbit: Orbit
    sound: Bool[Array, ""]
    shorter: Int[Array, ""]
    verified: Bool[Array, ""]
    known: Known


def collocated(
    pair: RotorPair,
    tangents: Any,
    start: tuple[Float[Array, " n"], Int[Array, ""]],
    integrators: tuple[Integrator, Integrator],
    measures: Measures,
    sizes_of: tuple[int, int],
) -> Collocated:
    """Close the orbit near the motion from a given state, and confirm it by one integration.

    `tangents`: directions of the pair's parameters, stacked along a leading axis; `start`: scaled
    state at φ1 = 0, and period (mesh periods); `integrators`: those of the transient and of the
    orbit, whose tolerance sets the accuracy; `measures`: averages of the force; `sizes_of`: number
    of samples of the integration, and longest period (mesh periods)."""
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
    equation = CollocatedEquation(pair, measures, pair.force_scale)
    begun = Known.unaligned(elements)
    closed = close(equation, tangents, begun, pair, ACCURACY * tolerance)
    found = closed.found
    length, peak = period.astype(state.dtype), found.response[2]
    top = jnp.where(peak > 0, peak, pair.force_scale)
    out = flow(pair, found.state, length, integrator, samples, measures=measures, top=top)
    miss = jnp.max(jnp.abs(out.end - found.state))
    size = jnp.maximum(1.0, jnp.max(jnp.abs(found.state)))
    gain = jnp.maximum(1.0, jnp.max(jnp.abs(found.monodromy)))
    far = jnp.maximum(_MISS[0] * tolerance, _MISS[1])
    equal = _equal(out.response[:3], found.response[:3], tolerance, pair.force_scale)
    verified = closed.sound & out.solved & (miss <= far * size * gain) & equal
    verified &= closed.error <= UNREFINED * ACCURACY * tolerance
    # The transient may have mistaken several periods of the orbit for one.
    shorter = _repeats(found, period, longest, tolerance) * closed.sound
    verified &= shorter == 0
    residual = jnp.where(closed.sound, found.correction, jnp.inf)
    orbit = _as_orbit(found, _with_forces(out, found), residual, closed.drift, closed.steps)
    return Collocated(orbit, closed.sound, shorter, verified, _known(closed, verified))


def _equal(
    one: Float[Array, " 3"],
    other: Float[Array, " 3"],
    tolerance: Float[Array, ""],
    unit: Float[Array, ""],
) -> Bool[Array, ""]:
    """Return whether two results for mean (N), mean square (N²) and peak force (N) agree.

    `tolerance`: that of the orbit's integrator; `unit` of force (N)."""
    least = _FAINT * tolerance * unit
    share = jnp.maximum(_APART[0] * tolerance, _APART[1])
    allowed = share * jnp.abs(other) + jnp.stack([least, least**2, least])
    return jnp.all(jnp.abs(one - other) <= allowed)


def _repeats(
    found: OrbitForces, period: Int[Array, ""], longest: int, tolerance: Float[Array, ""]
) -> Int[Array, ""]:
    """Return the least fraction of the orbit's `period` (mesh periods) after which it repeats, or
    0.

    `longest`: longest period of an orbit (mesh periods); `tolerance`: that of the orbit's
    integrator."""
    shorter = jnp.arange(1, max(longest // 2, 1) + 1)
    states = found.elements.motion(shorter.astype(found.state.dtype))
    limit = jnp.maximum(_REPEATS[0] * tolerance, _REPEATS[1])
    same = jnp.max(jnp.abs(states - found.state), axis=1) < limit
    same &= (shorter < period) & (period % shorter == 0)
    return jnp.where(jnp.any(same), shorter[jnp.argmax(same)], 0)


def near_orbit(
    pair: RotorPair,
    tangents: Any,
    start: tuple[Known, RotorPair],
    integrator: Integrator,
    measures: Measures,
    longest: int,
) -> Collocated:
    """Close the orbit near that of a similar pair, without a transient or integration.

    `start`: the known orbit, and its pair; `integrator`: sets the accuracy; `longest`: longest
    period (mesh periods); for the other arguments, see `collocated`. The result's `flow` has no
    samples."""
    known, neighbour = start
    tolerance = integrator.tolerance(pair.angle_scale.dtype)
    equation = CollocatedEquation(pair, measures, lax.stop_gradient(pair.force_scale))
    closed = close(equation, tangents, known, neighbour, ACCURACY * tolerance)
    found, sound = closed.found, closed.sound & known.sound
    verified = sound & (closed.error <= UNREFINED * ACCURACY * tolerance)
    period = jnp.round(found.elements.mesh.period).astype(int)
    shorter = _repeats(found, period, longest, tolerance)
    verified &= shorter == 0
    residual = jnp.where(sound, found.correction, jnp.inf)
    orbit = _as_orbit(found, as_flow(found), residual, closed.drift, closed.steps)
    return Collocated(orbit, sound, shorter, verified, _known(closed, verified))


def _known(closed: Closed, verified: Bool[Array, ""]) -> Known:
    """Return the orbit `closed` in the form from which orbits of similar pairs can be closed."""
    yes = jnp.ones((), bool)
    errors = closed.roughness, closed.error, closed.drift
    return Known(closed.found.elements, *errors, verified, yes)


def _as_orbit(found: OrbitForces, out: Flow, residual, drift, steps) -> Orbit:
    """Return an orbit found by collocation.

    `out`: its flow over one period; `residual`: its residual; `drift`: estimated error of its
    derivatives; `steps`: number of Newton steps."""
    nothing = jnp.zeros_like(found.depth)
    return Orbit(
        state=found.state,
        flow=out,
        residual=residual,
        monodromy=found.monodromy,
        multiplier=spectral_radius(found.monodromy),
        response=found.response,
        sensitivity=found.sensitivity,
        moved=found.moved,
        newton_steps=steps,
        drift=nothing,
        defect=nothing,
        disagreement=drift,
    )


def _with_forces(out: Flow, found: OrbitForces) -> Flow:
    """Return the flow `out` with the forces of the orbit `found`.

    The derivatives of the flow are replaced with zeros."""
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
