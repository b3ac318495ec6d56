"""The greatest contact force of a motion: where it is, and how it changes with the design."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.pair import RotorPair

_RIVALS, _CLOSER, _ROUNDS = 4, 16, 10
"""Maxima of samples and of ends of steps whose neighbourhoods are looked at, places in each, and
how many times ever more closely."""
_INNER = 2 * _RIVALS * _CLOSER - 2
"""Samples or ends looked at together: as many places, less one beside them to either side."""
_WIDE = 64
BESIDE = (0.0, -1.0, -2.0, 1.0, 2.0, -_WIDE, _WIDE)
"""Times just before and after a peak, in units of `BESIDE_UNIT`."""
BESIDE_UNIT = {8: 2e-8, 4: 1e-3}
"""Mesh periods, by bytes of a number."""
_FARTHEST = {8: 32.0, 4: 1 / 16}
"""Distance of the vertex from the located peak that is believed, in units of `_WIDE`: where the
states between the samples bend, the peak is located no better than to some 1e-5."""
_ROUNDINGS = 1e5
"""Bend of the force over `_WIDE` that is more than rounding, in roundings of the force."""
_NOISES = 10.0
"""The same in times the noise of the force, and scatter of the forces beside a smooth peak."""
_LEAST = 1e-9
"""Fall of the force beside a corner, relative to it; what is less may be rounding."""


def motion(
    pair: RotorPair,
    states: Float[Array, "samples n"],
    place: Float[Array, ""],
    width: Float[Array, ""],
) -> Float[Array, " n"]:
    """State at a `place` counted in samples, a `width` apart (mesh periods): ε by the quintic
    through the three nearest and their rates, others by the quartic through the five nearest."""
    middle = jnp.clip(jnp.round(place).astype(int), 2, states.shape[0] - 3)
    near = lax.dynamic_slice_in_dim(states, middle - 2, 5)
    three = near[1:4]
    rates = width * _slope(pair, three)

    def quintic(x):
        right, left = (x * (1 + x) / 2) ** 2, (x * (1 - x) / 2) ** 2
        values = jnp.stack([left * (4 + 3 * x), (1 - x * x) ** 2, right * (4 - 3 * x)])
        slopes = jnp.stack([left * (1 + x), x * (1 - x * x) ** 2, right * (x - 1)])
        return jnp.dot(values, three[:, 0]) + jnp.dot(slopes, rates)

    x = place - middle
    swing, rise = jax.jvp(quintic, (x,), (jnp.ones_like(x),))
    nodes = x - jnp.arange(-2, 3, dtype=place.dtype)
    others = jnp.where(jnp.eye(5, dtype=bool), 1.0, nodes)
    factors = jnp.asarray([24.0, -6.0, 4.0, -6.0, 24.0], place.dtype)
    rest = jnp.sum((jnp.prod(others, axis=1) / factors)[:, None] * near[:, 2:], axis=0)
    return _state(pair, swing, rise / width, rest)


def _slope(pair: RotorPair, states: Float[Array, "*k n"]) -> Float[Array, "*k"]:
    """dε/dτ (scaled) at scaled states."""
    return states[..., 1] * pair.lapse(states) if pair.free else states[..., 1]


def _state(
    pair: RotorPair,
    swing: Float[Array, ""],
    slope: Float[Array, ""],
    others: Float[Array, " m"],
) -> Float[Array, " n"]:
    """The scaled state with this ε and dε/dτ."""
    state = jnp.concatenate([jnp.stack([swing, slope]), others])
    return state.at[1].divide(pair.lapse(state)) if pair.free else state


class Steps(NamedTuple):
    """Steps of a solver: where they begin and end (mesh periods; inf beyond the last), the states
    there, and how many there are."""

    begins: Float[Array, " steps"]
    ends: Float[Array, " steps"]
    before: Float[Array, "steps n"]
    after: Float[Array, "steps n"]
    count: Int[Array, ""]

    def motion(self, pair: RotorPair, tau: Float[Array, ""]) -> Float[Array, " n"]:
        """State (scaled) at time `tau` (mesh periods): ε and dε/dτ by the cubic through both at
        the ends of the step, others in proportion."""
        k, step, x = self._place(tau)
        before, after = self.before[k], self.after[k]
        rate, last = step * _slope(pair, jnp.stack([before, after]))
        rise = after[0] - before[0]
        bend, twist = 3 * rise - 2 * rate - last, rate + last - 2 * rise
        swing = before[0] + x * (rate + x * (bend + x * twist))
        slope = (rate + x * (2 * bend + 3 * x * twist)) / step
        return _state(pair, swing, slope, (1 - x) * before[2:] + x * after[2:])

    def reaches(self, tau: Float[Array, ""], width: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether that cubic is at `tau` as good as a polynomial through samples a `width` apart:
        close enough to an end of the step."""
        _, step, x = self._place(tau)
        return x * (1 - x) * step**2 < width**2

    def _place(self, tau):
        """The step at `tau`, its length, and the share of it that has passed."""
        k = jnp.clip(jnp.searchsorted(self.ends, tau), 0, self.count - 1)
        step = self.ends[k] - self.begins[k]
        return k, step, (tau - self.begins[k]) / step


def blended(
    pair: RotorPair,
    states: Float[Array, "samples n"],
    steps: Steps,
    tau: Float[Array, ""],
    width: Float[Array, ""],
) -> Float[Array, " n"]:
    """State at `tau` (mesh periods) from the `states` at times a `width` apart and the `steps`.

    A polynomial through samples to both sides of a corner does not know of it; the steps are short
    there, and their cubics count where they are as good."""
    sampled = motion(pair, states, tau / width, width)
    return jnp.where(steps.reaches(tau, width), steps.motion(pair, tau), sampled)


def locate_peak(
    pair: RotorPair, states: Float[Array, "samples n"], length: Float[Array, ""], steps: Steps
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Time (mesh periods) of the greatest force, and the greatest penetration (m) that was seen,
    from the `states` at uniform times over `length` mesh periods and the `steps` of the solver.

    An impact's peak can be narrower than the sampling, with a corner where the damping
    saturates: the greatest of the samples' maxima are enclosed by looking ever more closely around
    each, as the greatest sample need not lie by the greatest peak. An impact can also fall between
    two samples: the same is done around the maxima at the ends of the steps. Inside a step the
    state is known less well where that is long; it is looked at there only if the steps are about
    as close as the samples, or the motion can swing between samples.
    """
    last = jnp.stack([jnp.asarray(states.shape[0]), steps.count]) - 1  # of samples, of steps
    width = length / states.shape[0]
    scans, by_ends = -(-(last + 1) // _INNER)
    inside = 2 * last[1] > last[0]
    if pair.timescales is not None:
        inside |= width * pair.mesh_period > pair.timescales.swing
    spread = jnp.linspace(-1, 1, _CLOSER, dtype=width.dtype)
    by_steps = jnp.repeat(jnp.arange(2), _RIVALS * _CLOSER)

    def contact(place, by_steps):
        tau = place * width
        at_step = steps.motion(pair, tau)
        state = jnp.where(by_steps, at_step, blended(pair, states, steps, tau, width))
        found = pair.contact_at(tau, state)
        known = ~by_steps | inside | steps.reaches(tau, width)
        return jnp.where(known, found.total, -jnp.inf), found.depth

    # One loop for all, so that the contact is compiled once: the samples, the ends of the steps,
    # and rounds about the rivals. Of each: its force, place (in samples), and the ends of the
    # interval that it is in; of the samples, and of the ends.
    def look(i, carry):
        rivals, depth = carry
        scanning = i < scans + by_ends
        way = ((i >= scans) & scanning).astype(int)
        k = (i - way * scans) * _INNER + jnp.arange(-1, _INNER + 1)
        sides = jnp.clip(k + jnp.arange(-1, 2)[:, None], 0, last[way])
        at_step = jnp.minimum(sides, last[1])
        ends = jnp.stack([steps.begins[at_step[1]], *steps.ends[at_step[1:]]]) / width
        low, place, high = jnp.where(way == 1, ends, sides.astype(width.dtype))
        reach = (2.0 / (_CLOSER - 1)) ** jnp.maximum(i - scans - by_ends, 0).astype(width.dtype)
        _, best, left, right = rivals[..., None]
        closer = jnp.clip(best + reach * (right - left) * spread, left, right)
        place = jnp.where(scanning, place, closer.ravel())
        force, deep = jax.vmap(contact)(place, jnp.where(scanning, way, by_steps) == 1)

        beside = jnp.maximum(jnp.roll(force, 1), jnp.roll(force, -1))
        maximum = (force >= beside) & (k <= last[way])
        maximum = maximum.at[jnp.array([0, -1])].set(False)  # Those are of the next blocks.
        found = jnp.stack([jnp.where(maximum, force, -jnp.inf), place, low, high])
        listed = jnp.concatenate([rivals[:, way], found], axis=1)
        scanned = rivals.at[:, way].set(listed[:, lax.top_k(listed[0], _RIVALS)[1]])

        forces = force.reshape(closer.shape)
        top = jnp.argmax(forces, axis=-1, keepdims=True)
        tops = [jnp.take_along_axis(x, top, -1)[..., 0] for x in (forces, closer)]
        refined = rivals.at[:2].set(jnp.where(tops[0] > rivals[0], jnp.stack(tops), rivals[:2]))
        rivals = jnp.where(scanning, scanned, refined)
        return rivals, jnp.maximum(depth, jnp.max(deep))

    nothing = jnp.zeros((4, 2, _RIVALS), width.dtype).at[0].set(-jnp.inf)
    start = nothing, jnp.full_like(width, -jnp.inf)
    (force, place, *_), depth = lax.fori_loop(0, scans + by_ends + _ROUNDS, look, start)
    return place.ravel()[jnp.argmax(force)] * width, depth


def one_sided(
    forces: Float[Array, "7"], noise: Float[Array, ""] | float = 0.0
) -> tuple[Float[Array, ""], Float[Array, "7"]]:
    """The peak from the forces at the times `BESIDE` it, known but for a relative `noise` and
    rounding, and with which weights their derivatives make up that of the peak.

    Where the force is smooth at its peak, it is the derivative at the fixed instant (envelope
    theorem), at the vertex of the parabola through the forces: rounding hides where exactly the
    greatest is. Where the force has a corner, the peak stays on the corner as that moves, and of
    the derivatives on both sides the mean counts for which the force is stationary in time. Where
    it jumps (contact by `linear`, say), rounding decides on which side of the jump the instant
    lies: the higher side counts.
    """
    here, before, earlier, after, later, left, right = forces
    none, one = jnp.zeros_like(here), jnp.ones_like(here)
    # Each slope from its own side: the corner is not known as well as that.
    rise, fall = before - earlier, after - later
    drop = rise + fall
    # Next to a corner the force falls as fast as farther away, on a parabola a third as fast.
    sharp = (2 * here - before - after > 0.6 * drop) & (drop > _LEAST * here)
    continuous = jnp.abs(before - after) <= 2 * drop
    corner = (rise > 0) & (fall > 0) & sharp & continuous
    share = rise / jnp.where(corner, drop, 1.0)
    at_corner = jnp.stack([none, 1 - share, none, share, none, none, none])
    bend = 2 * here - left - right
    rounding = float(jnp.finfo(forces.dtype).eps) * here
    noise = _NOISES * noise * here
    # A jump stands out from the slope that it makes over the wide distance.
    line = here + (right - left) / (2 * _WIDE) * jnp.asarray(BESIDE[:5], forces.dtype)
    smooth = jnp.max(jnp.abs(forces[:5] - line)) < bend / (8 * _WIDE) + 100 * rounding + noise
    bent = bend > jnp.maximum(_ROUNDINGS * rounding, noise)
    vertex = (right - left) / (2 * jnp.where(bent, bend, jnp.inf))
    near = jnp.abs(vertex) < _FARTHEST[forces.dtype.itemsize]
    vertex = jnp.where(smooth & near, vertex, 0.0)
    at_vertex = jnp.stack([one, none, none, none, none, -vertex / 2, vertex / 2])
    highest = jnp.where(corner | smooth, 0, jnp.argmax(forces[:5]))
    single = (jnp.arange(len(BESIDE)) == highest).astype(forces.dtype)
    weights = jnp.where(corner, at_corner, jnp.where(highest == 0, at_vertex, single))
    above = jnp.where(corner, 0.0, bend / 2 * vertex**2)
    return forces[highest] + above, weights
