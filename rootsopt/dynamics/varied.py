"""A closed orbit together with its variation: how the whole motion changes with parameters.

Quantities that the closing of an orbit does not compute follow from it with their derivatives:
local maxima of the force, and loads on bearings."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rootsopt.dynamics.collocation.blocks import in_blocks, whole_blocks
from rootsopt.dynamics.collocation.elements import Elements, Mesh
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.collocation.system import Step, moved_at
from rootsopt.dynamics.flow import Equation
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import Solver, Steady
from rootsopt.dynamics.tangent import linearized
from rootsopt.runtime.programs import Program

_PARTS = 2
"""Number of elements that replace a step of the integration. The polynomials of an element are of
lower order than a step."""


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


def varied(pair: RotorPair, tangents: RotorPair, found: Steady, solver: Solver) -> VariedOrbit:
    """Return the closed orbit of a motion, with its variation.

    `tangents`: directions of the pair's parameters along which `found` has derivatives; `solver`:
    settings with which it was found. An orbit closed by shooting is linearised once more."""
    if found.known is not None:
        assert found.orbit.variation is not None
        return VariedOrbit(found.known.elements, found.orbit.variation)
    integrator = dataclasses.replace(solver.orbit, rtol=jnp.asarray(found.rtol))
    return _varied_flow(pair, tangents, found.orbit, jnp.asarray(int(found.period)), integrator)


@Program
def _varied_flow(
    pair: RotorPair,
    tangents: RotorPair,
    orbit: Orbit,
    period: Int[Array, ""],
    integrator: Integrator,
) -> VariedOrbit:
    """Return an orbit that was closed by shooting, with its variation.

    `tangents`: directions of the pair's parameters, as for `close_orbit`; `period` of the orbit
    (mesh periods); `integrator`: that of the orbit. The steps of the integration end where flags
    change. They are linearised."""
    count, dtype = orbit.state.shape[0], orbit.state.dtype
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)
    moved = eqx.filter(tangents, eqx.is_inexact_array)
    unit, solver = pair.force_scale, integrator.solver()
    equation = Equation(static, Measures(), unit, jnp.ones_like(unit), count, solver)
    taken, length = jnp.sum(orbit.flow.grid < jnp.inf), period.astype(dtype)
    ends = jnp.minimum(orbit.flow.grid, length)
    before = jnp.concatenate([orbit.state[None], orbit.flow.corners[:-1]])
    steps = whole_blocks(jnp.append(jnp.zeros_like(ends[:1]), ends[:-1]), ends, before)
    # At the Gauss points of the elements of a step, then at the elements' ends.
    first = np.arange(_PARTS) / _PARTS
    nodes = np.append(first[:, None] + GAUSS.nodes / _PARTS, first + 1 / _PARTS)

    def linear(begin, end, state, share):
        def run(y, dynamic):
            after, slope = equation.advanced(begin, begin + share * (end - begin), y, dynamic)
            return jnp.append(after[:count], slope[:count])

        return linearized(run, equation.start(state, pair.free), dynamic, moved, count)

    each = jax.vmap(jax.vmap(linear, (None, None, None, 0)), (0, 0, 0, None))
    at = jnp.asarray(nodes, dtype)
    found = in_blocks(lambda begin, end, state: each(begin, end, state, at), taken, *steps)

    def advance(now, step):
        by_state, by_parameters = step
        changed = jnp.einsum("qrn,nd->qrd", by_state, now) + by_parameters
        return changed[-1, :count], (now, changed)

    _, (starts, changes) = lax.scan(advance, orbit.moved, (found.by_state, found.by_parameters))
    inner = (*changes.shape[:1], _PARTS, len(GAUSS.nodes))
    rows = inner[0] * _PARTS

    def of_elements(nodes, start):
        """Split values at the nodes of steps into those at the start and inside of elements."""
        last = nodes[:, -_PARTS:-1, :count]
        state = jnp.concatenate([start[:, None], last], axis=1)
        slopes = nodes[:, :-_PARTS, count:].reshape(*inner, count, *nodes.shape[3:])
        return state.reshape(rows, *state.shape[2:]), slopes.reshape(rows, *slopes.shape[2:])

    begins, ends, before = steps
    edges = jnp.append(begins[:, None] + (ends - begins)[:, None] * first, length)
    used, number = _PARTS * taken, jnp.arange(rows + 1)
    edges = jnp.where(number < used, edges, length)
    mesh = Mesh(
        times=jnp.stack([jnp.zeros_like(length), length]),
        which=jnp.full(2, -1),
        interval=jnp.zeros_like(number[1:]),
        left=edges[:-1] / length,
        right=edges[1:] / length,
        used=used,
    )
    state, slopes = of_elements(found.value, before)
    roots: Any = jnp.zeros((rows, len(GAUSS.nodes) + 1, 0, 2), dtype)
    still = jnp.zeros((2, orbit.moved.shape[1]), dtype)
    by_state, by_slopes = of_elements(changes, starts)
    variation = Step(by_state, by_slopes, still, orbit.monodromy)
    return VariedOrbit(Elements(mesh, state, slopes, roots), variation)


__all__ = ["VariedOrbit", "varied"]
