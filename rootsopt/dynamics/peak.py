"""The greatest contact force of a motion: when it occurs, and its derivatives."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.pair import RotorPair

_RIVALS, _CLOSER, _ROUNDS = 4, 16, 10
"""Settings for refining the peak. `_RIVALS`: number of refined maxima among the samples, and as
many among the ends of steps; `_CLOSER`: number of evaluations around each maximum in a round;
`_ROUNDS`: number of rounds."""
_INNER = 2 * _RIVALS * _CLOSER - 2
"""Number of samples, or of ends of steps, that one iteration of the search scans. It also evaluates
one neighbour at either end."""
_WIDE = 64
"""Distance of the outermost times in `BESIDE` from the peak, in units of `BESIDE_UNIT`."""
BESIDE = (0.0, -1.0, -2.0, 1.0, 2.0, -_WIDE, _WIDE)
"""Times relative to a located peak at which the force is evaluated, in units of `BESIDE_UNIT`."""
BESIDE_UNIT = 2e-8
"""Unit of `BESIDE` (mesh periods)."""
_FARTHEST = 32.0
"""Distance (units of `_WIDE`) from a located peak to the instant at which the force stops rising,
above which this instant is rejected. It is large, because peaks are located only to about 1e-5 mesh
periods where the states bend between samples."""
_NOISES = 10.0
"""Step of the force above which it counts as a jump, in multiples of the force's noise."""
_NEAREST, _NEAR, _FAR = (1, 3), (2, 4), (5, 6)
"""Indices in `BESIDE` of three pairs of times, one time on each side of the peak."""
_SHARP = 0.75
"""Fall of the force's rate between the times `_NEAREST`, as a fraction of that between the times
`_NEAR`, above which the peak is a corner. At a smooth peak it is a half."""
_KINK = 1e-3
"""Relative change of a mark's rate at a jump below which the mark does not show the jump."""


def motion(
    pair: RotorPair,
    states: Float[Array, "samples n"],
    place: Float[Array, ""],
    width: Float[Array, ""],
) -> Float[Array, " n"]:
    """Interpolate the scaled state between uniform samples.

    `states` (samples, n): scaled samples; `place`: position at which to interpolate, counted in
    samples; `width`: spacing of the samples (mesh periods). ε is a quintic through the three
    nearest samples and their rates; dε/dt is the derivative of the quintic. The other states are
    quartics through the five nearest samples.
    """
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
    """Return dε/dτ (scaled) at scaled states."""
    return states[..., 1] * pair.lapse(states) if pair.free else states[..., 1]


def _state(
    pair: RotorPair,
    swing: Float[Array, ""],
    slope: Float[Array, ""],
    others: Float[Array, " m"],
) -> Float[Array, " n"]:
    """Return the scaled state with ε = `swing`, dε/dτ = `slope` and the other states `others`."""
    state = jnp.concatenate([jnp.stack([swing, slope]), others])
    return state.at[1].divide(pair.lapse(state)) if pair.free else state


class Steps(NamedTuple):
    """Steps that a solver has taken.

    `begins`, `ends`: start and end of each step (mesh periods; inf beyond the last); `before`,
    `after`: scaled states at the start and end of each step; `count`: number of steps.
    """

    begins: Float[Array, " steps"]
    ends: Float[Array, " steps"]
    before: Float[Array, "steps n"]
    after: Float[Array, "steps n"]
    count: Int[Array, ""]

    def motion(self, pair: RotorPair, tau: Float[Array, ""]) -> Float[Array, " n"]:
        """Return the scaled state at time `tau` (mesh periods), interpolated within its step.

        ε and dε/dτ come from the cubic through their values at both ends of the step. The other
        states are interpolated linearly."""
        k, step, x = self._place(tau)
        before, after = self.before[k], self.after[k]
        rate, last = step * _slope(pair, jnp.stack([before, after]))
        rise = after[0] - before[0]
        bend, twist = 3 * rise - 2 * rate - last, rate + last - 2 * rise
        swing = before[0] + x * (rate + x * (bend + x * twist))
        slope = (rate + x * (2 * bend + 3 * x * twist)) / step
        return _state(pair, swing, slope, (1 - x) * before[2:] + x * after[2:])

    def reaches(self, tau: Float[Array, ""], width: Float[Array, ""]) -> Bool[Array, ""]:
        """Return whether `motion` at `tau` (mesh periods) is as accurate as interpolated samples.

        That is so if `tau` is close enough to an end of its step; `width`: spacing of the samples
        (mesh periods)."""
        _, step, x = self._place(tau)
        return x * (1 - x) * step**2 < width**2

    def _place(self, tau):
        """Return (index of the step that contains `tau`, its length, fraction of it before `tau`).

        `tau` and the length are in mesh periods."""
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
    """Return the scaled state at `tau` (mesh periods), from samples or from solver steps.

    `states`: samples with the spacing `width` (mesh periods). A polynomial through samples on both
    sides of a corner would smooth the corner away. Solver steps are short there. Therefore the
    cubic within a step is used wherever it is as accurate as the samples."""
    sampled = motion(pair, states, tau / width, width)
    return jnp.where(steps.reaches(tau, width), steps.motion(pair, tau), sampled)


def locate_peak(
    pair: RotorPair, states: Float[Array, "samples n"], length: Float[Array, ""], steps: Steps
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the time (mesh periods) of the greatest force, and the greatest penetration (m) found.

    `states`: samples at uniform times over `length` mesh periods; `steps`: solver steps.

    An impact's peak can be narrower than the sampling, and has a corner where the damping
    saturates. The greatest sample need not be next to the greatest peak. Therefore several maxima
    of the samples are refined, by ever closer scans around each. An impact can also fall between
    two samples, so the maxima at the ends of steps are refined as well. The state inside a long
    step is less accurate. Forces there count only if steps are about as dense as samples, or if the
    motion can oscillate between samples.
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

    # One loop does everything, so that the contact is compiled once. It scans the samples, then the
    # ends of steps, then refines the rivals in rounds. `rivals`: force, place (in samples) and ends
    # of the enclosing interval of each rival, for the samples and for the ends of steps.
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
        maximum = maximum.at[jnp.array([0, -1])].set(False)  # These belong to the next blocks.
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
    found: Float[Array, "7 values"], noise: Float[Array, ""] | float = 0.0
) -> tuple[Float[Array, ""], Float[Array, "7 weighted"]]:
    """Return the peak force, and the weights (7, values - 1) of its derivative.

    The derivative of the peak is the weighted sum of the derivatives of `found`, without its last
    column.

    `found`: at the times `BESIDE` around the located peak, the contact force in any unit, followed
    by its rate (per mesh period). If the contact may jump, the first of its
    `rootsopt.dynamics.saltation.marks` stands before them. `noise`: relative error of the forces in
    addition to rounding.

    The derivative is a weighted mean of those at two times, such that the same mean of the rates is
    zero. Where the force has a corner, this accounts for the motion of the corner: the values on
    both sides are extrapolated to it (`_at_corner`). At a smooth peak it is the derivative at the
    instant at which the force stops rising (envelope theorem), from times farther apart. Rates from
    differences of the force would not do: rounding of the gap would leave an error of up to 1e-3 in
    the weights.

    At a jump (such as with the `linear` contact), rounding decides on which side of the jump the
    located instant lies. The side with the greater force is used. The peak moves with the jump.
    """
    forces, rates = found[:, -2], found[:, -1]
    dtype = forces.dtype
    here, before, _, after, *_ = forces
    # Between the nearest times, a corner changes the force by no more than its rates allow.
    rise, fall = BESIDE_UNIT * jnp.stack([rates[1], rates[3]])
    rounding = (100 * float(jnp.finfo(dtype).eps) + _NOISES * noise) * here
    jumps = jnp.abs(after - before - rise - fall) > 2 * jnp.abs(rise - fall) + rounding
    turns = (rates[_NEAR[0]] > 0) & (rates[_NEAR[1]] < 0)
    known = rise - fall > rounding
    corner = jnp.where(known, after - before - rise - fall, jnp.inf)
    corner = corner / jnp.where(known, rise - fall, 1.0)
    unit = jnp.eye(len(BESIDE), dtype=dtype)
    near, sharp = _at_corner(unit, rates, corner)
    sides = jnp.where(turns, near, unit[jnp.asarray(_FAR)])
    first, last = sides @ rates
    drop = first - last
    share = first / jnp.where(drop > 0, drop, jnp.inf)
    place = jnp.where(turns, 0.0, _WIDE * (2 * share - 1))
    share = jnp.where(turns, jnp.clip(share, 0.0, 1.0), share)
    stops = (drop > 0) & (jnp.abs(place) < _WIDE * _FARTHEST) & ~jumps
    single = jnp.zeros_like(forces).at[jnp.argmax(forces[:5])].set(1.0)
    double = jnp.stack([1 - share, share]) @ sides
    weights = jnp.where(stops, double, single)[:, None]
    above = jnp.maximum(BESIDE_UNIT * rates[0] * place / 2, 0.0)
    if found.shape[1] > 2:
        moved = jnp.where(jumps, _with_jump(forces, found[:, 0]), 0.0)
        weights = jnp.concatenate([moved[:, None], weights], axis=1)
    top = jnp.where(turns & sharp, jnp.dot(double, forces), here + above)
    return jnp.where(stops, top, jnp.max(forces[:5])), weights


def _at_corner(
    unit: Float[Array, "7 7"], rates: Float[Array, "7"], corner: Float[Array, ""]
) -> tuple[Float[Array, "2 7"], Bool[Array, ""]]:
    """Return weights (2, 7) that extrapolate values at `BESIDE` to both sides of a corner, and
    whether they do.

    `unit`: identity matrix; `rates` of the force; `corner`: time of the corner (in `BESIDE_UNIT`).
    Each row extrapolates linearly from the two times on one side. Values beside the corner would do
    only to first order: 4e-8 mesh periods away, derivatives of the peak were off by 2e-6. The force
    was off by 1e-8 only 1e-10 mesh periods away. If the corner is not between the nearest times, or
    the rates change as much beyond them (a smooth peak), the values at `_NEAR` are used."""
    nearest, near = unit[jnp.asarray(_NEAREST)], unit[jnp.asarray(_NEAR)]
    steep, wide = (rates[first] - rates[last] for first, last in (_NEAREST, _NEAR))
    sharp = (jnp.abs(corner) < 1) & (steep > _SHARP * wide)
    beyond = jnp.where(sharp, jnp.stack([1 + corner, 1 - corner]), -1.0)
    return nearest + beyond[:, None] * (nearest - near), sharp


def _with_jump(forces: Float[Array, "7"], marks: Float[Array, "7"]) -> Float[Array, "7"]:
    """Return the weights (7,) of the derivatives of `marks` in the derivative of a peak at a jump.

    The weighted sum is the part of the derivative that comes from the motion of the jump:
    F dt*/dp. F is the time derivative of the force on the greater side, and t* the instant of the
    jump (see `rootsopt.dynamics.saltation`). `forces`, `marks`: contact force and first mark at the
    times `BESIDE`. Time derivatives are difference quotients, each on one side of the jump."""

    def rates(values):
        _, _, earlier, _, later, left, right = values
        return earlier - left, right - later

    before, after = rates(marks)
    closing = before - after
    kinked = jnp.abs(closing) > _KINK * jnp.maximum(jnp.abs(before), jnp.abs(after))
    rising = jnp.where(forces[4] > forces[2], *rates(forces)[::-1])
    moved = jnp.where(kinked, rising / jnp.where(kinked, closing, 1.0), 0.0)
    return jnp.zeros_like(forces).at[2].set(-moved).at[4].set(moved)
