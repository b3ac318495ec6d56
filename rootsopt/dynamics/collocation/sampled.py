"""A motion on elements, sampled like an integrated one."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.collocation.forces import OrbitForces, origin
from rootsopt.dynamics.flow import Flow

_CUTS = (1e-6, 0.25, 0.5, 0.75, 1 - 1e-6, 1.0)
"""Ends of the steps into which an element is divided, as fractions of its length.

A step of an explicit method of the order of the elements is then at least as accurate as the
element. An element may end at an event, where the derivatives of the equation jump. The steps
beside the ends are short, since one of their stages lies exactly there and gets the derivatives of
the other side."""
PARTS = len(_CUTS)
"""Number of steps into which an element is divided."""


def as_flow(found: OrbitForces) -> Flow:
    """Return the orbit `found` as a `Flow` over its period, with zeros for the derivatives.

    It has neither samples of the state nor steps: see `sampled`."""
    response, count = found.response, found.state.shape[0]
    mesh, dtype = found.elements.mesh, found.state.dtype
    begin, length = mesh.ends[0][found.peak.element], mesh.lengths[found.peak.element]
    rows, columns = count + response.shape[0], count + found.moved.shape[1]
    return Flow(
        end=found.state,
        mean=response[0],
        mean_square=response[1],
        peak=response[2],
        peak_time=jnp.mod(begin + found.peak.share * length, mesh.period),
        depth=found.depth,
        states=jnp.zeros((0, count), dtype),
        grid=jnp.zeros(0, dtype),
        corners=jnp.zeros((0, count), dtype),
        steps=jnp.zeros((), int),
        solved=jnp.ones((), bool),
        strain=jnp.zeros((), dtype),
        others=response[3:],
        slope=jnp.zeros((rows, columns), dtype),
    )


def sampled(flow: Flow, elements: Elements, samples: int) -> Flow:
    """Return `flow` with uniform samples of the state, and with steps.

    `elements`: the orbit; `samples`: number of samples. Each element is divided into `PARTS` steps.
    """
    grid, corners = _steps(elements, PARTS * elements.state.shape[0])
    uniform = elements.mesh.period * jnp.arange(samples) / samples
    return flow._replace(states=elements.motion(uniform), grid=grid, corners=corners)


def _steps(elements: Elements, room: int) -> tuple[Float[Array, " steps"], Float[Array, "steps n"]]:
    """Return the ends of steps from φ1 = 0 over one period (mesh periods), and the states there.

    `room`: size of the returned arrays; unused ends are inf."""
    mesh = elements.mesh
    number = jnp.arange(room)
    place, part = number // PARTS, jnp.asarray(_CUTS, mesh.left.dtype)[number % PARTS]
    first = origin(elements)
    used = jnp.maximum(mesh.used, 1)
    k = jnp.mod(first + place, used)
    begin, length = mesh.ends[0], mesh.lengths
    tau = begin[k] + length[k] * part
    # Elements before φ1 = 0 come last. The last step ends after exactly one period.
    turns = jnp.where(first + place >= used, mesh.period, 0.0)
    last = PARTS * mesh.used - 1
    ends = jnp.where(number == last, mesh.period, tau + turns - begin[first])
    ends = jnp.where(number <= last, ends, jnp.inf)
    states = jnp.where((number <= last)[:, None], elements.inside(k, tau), 0.0)
    return ends, states


__all__ = ["PARTS", "as_flow", "sampled"]
