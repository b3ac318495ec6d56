"""Initial mesh and motion for closing an orbit by collocation.

Both come from the steps of an integration over the orbit's period."""

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.blocks import BLOCK, in_blocks
from rootsopt.dynamics.collocation.closing import first_elements
from rootsopt.dynamics.collocation.elements import Elements, Mesh
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.collocation.known import Known
from rootsopt.dynamics.collocation.mesh import sizes
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair


def seeded(
    pair: RotorPair,
    state: Float[Array, " n"],
    period: Int[Array, ""],
    integrator: Integrator,
    used: Int[Array, ""],
    room: tuple[int, int],
) -> tuple[Elements, Bool[Array, ""]]:
    """Return the motion from a scaled `state` over `period` mesh periods, and the solver's success.

    The motion starts at φ1 = 0. `used`: number of elements; `room`: sizes of the arrays for
    elements and for times. All elements cover the same number of solver steps, so that they are
    short where the integrator's steps are short. The mesh has no events, and `Elements.roots` are
    0."""
    dtype = state.dtype
    length = period.astype(dtype)

    def slope(tau, y, pair):
        return pair.derivative(tau, y)[0]

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),
        integrator.solver(dtype),
        t0=jnp.zeros((), dtype),
        t1=length,
        dt0=None,
        y0=state,
        args=pair,
        saveat=diffrax.SaveAt(
            t0=True, steps=True, fn=lambda tau, y, pair: (tau, y, slope(tau, y, pair))
        ),
        stepsize_controller=integrator.controller(dtype, 1.0, pair),
        adjoint=diffrax.ForwardMode(),
        max_steps=integrator.max_steps,
        throw=False,
    )
    assert solution.ys is not None
    times, states, slopes = solution.ys
    steps = jnp.minimum(solution.stats["num_accepted_steps"], times.shape[0] - 1)
    found = _on_steps(pair, (times, states, slopes), steps, length, used, room)
    return found, solution.result == diffrax.RESULTS.successful


def from_steps(
    pair: RotorPair,
    state: Float[Array, " n"],
    taken: tuple[Float[Array, " steps"], Float[Array, "steps n"]],
    period: Int[Array, ""],
    longest: int,
) -> Known:
    """Return an orbit that was closed by shooting, as a start for closing it by collocation.

    `state`: scaled, at φ1 = 0; `taken`: `Flow.grid` and `Flow.corners` of the integration over the
    `period` (mesh periods); `longest`: longest period for which the arrays have room."""
    grid, corners = taken
    times = jnp.append(0.0, grid)
    states = jnp.concatenate([state[None], corners])
    steps = jnp.sum(jnp.isfinite(grid))
    slope = jax.vmap(lambda tau, y: pair.derivative(tau, y)[0])
    slopes = in_blocks(slope, steps + 1, *_padded(times, states))[: times.shape[0]]
    every, length = (times, states, slopes), period.astype(state.dtype)
    room = sizes(longest)
    return Known.unaligned(_on_steps(pair, every, steps, length, first_elements(period), room))


def _padded(times: Float[Array, " m"], states: Float[Array, "m n"]) -> tuple[Array, Array]:
    """Return `times` and `states`, padded with zeros to a multiple of `BLOCK`."""
    spare = -times.shape[0] % BLOCK
    return jnp.pad(times, (0, spare)), jnp.pad(states, ((0, spare), (0, 0)))


def _on_steps(
    pair: RotorPair,
    taken: tuple[Float[Array, " m"], Float[Array, "m n"], Float[Array, "m n"]],
    steps: Int[Array, ""],
    length: Float[Array, ""],
    used: Int[Array, ""],
    room: tuple[int, int],
) -> Elements:
    """Return the motion through the ends of solver steps, on elements without events.

    `taken`: times (mesh periods), scaled states and slopes at the start and at the ends of the
    steps; `steps`: number of them; `length`: period; for the others, see `seeded`."""
    times, states, slopes = taken
    capacity, count = room
    dtype = states.dtype
    real = jnp.arange(times.shape[0]) <= steps
    times = jnp.where(real, times, length + jnp.arange(times.shape[0]))
    share = jnp.linspace(0.0, 1.0, capacity + 1) * capacity / used
    edges = jnp.interp(share * steps, jnp.arange(times.shape[0], dtype=dtype), times)
    edges = jnp.minimum(edges, length)
    number = jnp.arange(capacity)
    real = number < used
    anchors = jnp.full(count, length, dtype).at[0].set(0.0)
    mesh = Mesh(
        times=anchors,
        which=jnp.full(count, -1),
        interval=jnp.where(real, 0, count - 2),
        left=jnp.where(real, edges[:-1] / length, 1.0),
        right=jnp.where(real, jnp.where(number == used - 1, length, edges[1:]) / length, 1.0),
        used=used,
    )

    def motion(tau):
        """Return states and slopes at the times `tau` (mesh periods).

        They come from the cubic through both ends of a solver step."""
        k = jnp.clip(jnp.searchsorted(times, tau, side="right") - 1, 0, steps - 1)
        step = (times[k + 1] - times[k])[..., None]
        x = (tau - times[k])[..., None] / step
        rise, rate, last = states[k + 1] - states[k], step * slopes[k], step * slopes[k + 1]
        bend, twist = 3 * rise - 2 * rate - last, rate + last - 2 * rise
        swing = states[k] + x * (rate + x * (bend + x * twist))
        return swing, (rate + x * (2 * bend + 3 * x * twist)) / step

    begin = mesh.ends[0]
    inside = begin[:, None] + mesh.lengths[:, None] * GAUSS.nodes
    sides = 1 + pair.two_sided
    return Elements(
        mesh=mesh,
        state=motion(begin)[0],
        slopes=motion(inside)[1],
        roots=jnp.zeros((capacity, len(GAUSS.nodes) + 1, sides, 2), dtype),
    )
