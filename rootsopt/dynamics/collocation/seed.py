"""Initial mesh and motion for closing an orbit by collocation.

Both come from an integration over the orbit's period, from the end of the transient."""

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.elements import Elements, Mesh
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair


def seeded(
    pair: RotorPair,
    state: Float[Array, " n"],
    period: Int[Array, ""],
    integrator: Integrator,
    used: Int[Array, ""],
    sizes: tuple[int, int],
) -> tuple[Elements, Bool[Array, ""]]:
    """Return the motion from a scaled `state` over `period` mesh periods, and the solver's success.

    The motion starts at φ1 = 0. `used`: number of elements; `sizes`: sizes of the arrays for
    elements and for times. All elements cover the same number of solver steps, so that they are
    short where the integrator's steps are short. The mesh has no events, and `Elements.roots` are
    0."""
    dtype = state.dtype
    length = period.astype(dtype)
    capacity, room = sizes

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
    steps = solution.stats["num_accepted_steps"]
    steps = jnp.minimum(steps, times.shape[0] - 1)
    real = jnp.arange(times.shape[0]) <= steps
    times = jnp.where(real, times, length + jnp.arange(times.shape[0]))
    share = jnp.linspace(0.0, 1.0, capacity + 1) * capacity / used
    edges = jnp.interp(share * steps, jnp.arange(times.shape[0], dtype=dtype), times)
    edges = jnp.minimum(edges, length)
    number = jnp.arange(capacity)
    real = number < used
    anchors = jnp.full(room, length, dtype).at[0].set(0.0)
    mesh = Mesh(
        times=anchors,
        which=jnp.full(room, -1),
        interval=jnp.where(real, 0, room - 2),
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
    elements = Elements(
        mesh=mesh,
        state=motion(begin)[0],
        slopes=motion(inside)[1],
        roots=jnp.zeros((capacity, len(GAUSS.nodes) + 1, sides, 2), dtype),
    )
    return elements, solution.result == diffrax.RESULTS.successful
