"""An orbit closed by collocation, near a known one or near the end of a transient."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.closing import USUAL, Closer, Loop
from rootsopt.dynamics.collocation.equation import CollocatedEquation
from rootsopt.dynamics.collocation.mesh import KnownOrbit
from rootsopt.dynamics.flow import Pieces
from rootsopt.dynamics.integrator import Solver
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair

ACCURACY = 10.0
"""Requested relative error of the forces, in tolerances of the orbit's integrator."""
# Estimated error of the forces above which an orbit is rejected, in multiples of the requested one.
_UNREFINED = 10.0
# Scaled difference between the states at φ1 = 0 and after a fraction of the period, below which
# this fraction is the orbit's true period. The limit is the first number (tolerances), but at least
# the second.
_REPEATS = 1e3, 1e-5
# Number of instants per mesh period at which an orbit is compared with the transient.
_ALONG = 8


def greatest_error(tolerance: ArrayLike) -> Float[Array, ""]:
    """Return the estimated relative error of the forces above which an orbit is rejected.

    `tolerance`: that of the orbit's integrator. A tightened one must not reject what the usual one
    accepts: the mesh may lack room for refinement, or rounding of the gap may hide its effect."""
    return _UNREFINED * jnp.maximum(ACCURACY * jnp.asarray(tolerance), USUAL)


class Collocated(NamedTuple):
    """An orbit closed by collocation, with the results of its checks.

    `orbit`: as the last Newton step leaves it; `sound`: whether Newton's method has converged on a
    mesh that ends at the orbit's events; otherwise the orbit has no meaning. `shorter`: true period
    (mesh periods) if the orbit repeats after a fraction of its period, otherwise 0. `verified`:
    whether the orbit is sound and accurate, and does not repeat. `known`: the orbit in the form
    from which orbits of similar pairs can be closed.
    """

    orbit: Orbit
    sound: Bool[Array, ""]
    shorter: Int[Array, ""]
    verified: Bool[Array, ""]
    known: KnownOrbit


def closed_orbit(
    pair: RotorPair,
    tangents: Any,
    start: tuple[KnownOrbit, Float[Array, " m"]],
    settings: Solver,
) -> Collocated:
    """Close the orbit near a known motion.

    `tangents`: directions of the pair's parameters, stacked along a leading axis; `start`: the
    motion, and the `numbers` of its pair; `settings`: `orbit` (whose tolerance sets the accuracy),
    `measures`, `max_orbit`, `variation`."""
    known, neighbour = start
    integrator, measures = settings.orbit, settings.measures
    tolerance = integrator.tolerance
    top = lax.stop_gradient(pair.force_scale)
    equation = CollocatedEquation(pair, measures, top, settings.variation)
    frozen, accuracy = lax.stop_gradient(pair), ACCURACY * tolerance
    closed = Closer(equation, frozen, tangents, known, neighbour, accuracy).run()
    orbit, found, sound = closed.orbit, closed.known, closed.known.sound & known.sound
    verified = sound & (found.error <= greatest_error(tolerance))
    # The transient may have mistaken several periods of the orbit for one.
    shorter = _repeats(pair, closed, settings.max_orbit, tolerance) * sound
    verified &= shorter == 0
    orbit = orbit._replace(
        residual=jnp.where(sound, orbit.residual, jnp.inf),
        newton_steps=closed.steps,
        disagreement=found.drift,
    )
    if not pair.smooth:  # The force may jump where no element ends.
        unknown = jnp.nan * orbit.sensitivity, jnp.nan * orbit.moved
        orbit = orbit._replace(sensitivity=unknown[0], moved=unknown[1])
    return Collocated(orbit, sound, shorter, verified, found._replace(sound=verified))


def _repeats(
    pair: RotorPair, closed: Loop, longest: int, tolerance: Float[Array, ""]
) -> Int[Array, ""]:
    """Return the true period (mesh periods) of an orbit `closed` over several, or 0.

    It is the least fraction of the period after which the orbit repeats. Fractions after which the
    equation of `pair` does not repeat are ignored. `longest`: longest period of an orbit (mesh
    periods); `tolerance`: that of the orbit's integrator."""
    motion, state = closed.known.elements, closed.orbit.state
    shorter, period = pair.orders(max(longest // 2, 1)), jnp.round(motion.mesh.period).astype(int)
    states = motion.motion(shorter.astype(state.dtype))
    limit = jnp.maximum(_REPEATS[0] * tolerance, _REPEATS[1])
    same = jnp.max(jnp.abs(states - state), axis=1) < limit
    same &= (shorter < period) & (period % shorter == 0)
    return jnp.where(jnp.any(same), shorter[jnp.argmax(same)], 0)


def apart(known: KnownOrbit, pieces: Pieces) -> Float[Array, ""]:
    """Return the greatest scaled difference between a closed orbit and the end of a transient.

    `pieces`: the last mesh periods of the transient, which ends at φ1 = 0."""
    motion = known.elements
    number, every = pieces.ends.shape[0], pieces.ends.shape[1] // _ALONG
    begins = jnp.pad(pieces.ends[:, :-1], ((0, 0), (1, 0)))[:, ::every]
    times = motion.mesh.period + (begins + jnp.arange(-number, 0)[:, None])
    miss = jnp.abs(motion.motion(times) - pieces.states[:, ::every])
    within = (times > -1e-9)[..., None]
    return jnp.max(jnp.where(within, miss, 0.0))
