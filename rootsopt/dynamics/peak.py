"""The greatest contact force of a motion: where it is, and how it changes with the design."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.pair import RotorPair

_BLOCK = 63
"""Places looked at together."""
_ROUNDS = 6
"""Times the neighbourhood of the greatest force is looked at more closely."""
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
_LEAST = 1e-9
"""Fall of the force beside a corner, relative to it; what is less may be rounding."""


def motion(states: Float[Array, "samples n"], place: Float[Array, ""]) -> Float[Array, "n"]:
    """State at a `place` counted in samples: the quartic through the five nearest."""
    middle = jnp.clip(jnp.round(place).astype(int), 2, states.shape[0] - 3)
    near = lax.dynamic_slice_in_dim(states, middle - 2, 5)
    x = place - middle - jnp.arange(-2, 3, dtype=place.dtype)
    others = jnp.where(jnp.eye(5, dtype=bool), 1.0, x)
    factors = jnp.asarray([24.0, -6.0, 4.0, -6.0, 24.0], place.dtype)
    return jnp.sum((jnp.prod(others, axis=1) / factors)[:, None] * near, axis=0)


class Steps(NamedTuple):
    """Steps of a solver: where they begin and end (mesh periods; inf beyond the last), the states
    there, and how many there are."""

    begins: Float[Array, " steps"]
    ends: Float[Array, " steps"]
    before: Float[Array, "steps n"]
    after: Float[Array, "steps n"]
    count: Int[Array, ""]

    def motion(self, tau: Float[Array, ""]) -> Float[Array, " n"]:
        """State (scaled) at time `tau` (mesh periods): ε and dε/dτ by the cubic through both at
        the ends of the step, others in proportion."""
        k, step, x = self._place(tau)
        (start, rate), (end, last) = self.before[k, :2], self.after[k, :2]
        rise = end - start
        bend, twist = 3 * rise - step * (2 * rate + last), step * (rate + last) - 2 * rise
        place = start + x * (step * rate + x * (bend + x * twist))
        swing = jnp.stack([place, rate + x * (2 * bend + 3 * x * twist) / step])
        others = (1 - x) * self.before[k, 2:] + x * self.after[k, 2:]
        return jnp.concatenate([swing, others])

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
    states: Float[Array, "samples n"],
    steps: Steps,
    tau: Float[Array, ""],
    width: Float[Array, ""],
) -> Float[Array, " n"]:
    """State at `tau` (mesh periods) from the `states` at times a `width` apart and the `steps`.

    A polynomial through samples to both sides of a corner does not know of it; the steps are short
    there, and their cubics count where they are as good."""
    return jnp.where(steps.reaches(tau, width), steps.motion(tau), motion(states, tau / width))


def locate_peak(
    pair: RotorPair, states: Float[Array, "samples n"], length: Float[Array, ""], steps: Steps
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Time (mesh periods) of the greatest force, and the greatest penetration (m) that was seen,
    from the `states` at uniform times over `length` mesh periods and the `steps` of the solver.

    An impact's peak can be narrower than the sampling, with a corner where the damping
    saturates: it is enclosed by looking ever more closely around the greatest sample. An impact
    can also fall between two samples: the same is done around the greatest force at the ends of
    the steps, which counts if it is greater. Inside a step the state is known less well where that
    is long; it is looked at there only if the steps are about as close as the samples, or the
    motion can swing between samples.
    """
    samples = states.shape[0]
    width = length / samples
    blocks = -(-samples // _BLOCK)
    corners = -(-steps.count // _BLOCK)
    spread = jnp.linspace(-1, 1, _BLOCK, dtype=width.dtype)
    if pair.pace is None:
        swings = steps.count > samples
    else:
        swings = width * pair.mesh_period > pair.pace.swing
    inside = swings | (2 * steps.count > samples)

    # One loop for all, so that the contact is compiled once.
    def look(i, carry):
        greatest, best, corner, depth = carry
        by_steps = i >= blocks + _ROUNDS
        way = by_steps.astype(int)
        round_ = i - blocks - way * (_ROUNDS + corners)
        at_ends = by_steps & (round_ < 0)
        looking = at_ends | (i < blocks)
        block = jnp.where(by_steps, round_ + corners, i) * _BLOCK + jnp.arange(_BLOCK)
        ends = steps.ends[jnp.minimum(block, steps.count - 1)] / width
        block = jnp.where(by_steps, ends, jnp.minimum(block, samples - 1).astype(width.dtype))
        # Not beyond the steps to both sides of the end: the force may jump at theirs.
        first, last = steps.begins[corner], steps.ends[jnp.minimum(corner + 1, steps.count - 1)]
        reach = (2.0 / (_BLOCK - 1)) ** jnp.maximum(round_, 0).astype(width.dtype)
        reach *= jnp.where(by_steps, (last - first) / width, 1.0)
        low, high = (
            jnp.where(by_steps, at / width, limit)
            for at, limit in ((first, 0.0), (last, samples - 1.0))
        )
        places = jnp.where(looking, block, jnp.clip(best[way] + reach * spread, low, high))

        def contact(place):
            tau = place * width
            state = jnp.where(by_steps, steps.motion(tau), blended(states, steps, tau, width))
            known = ~by_steps | inside | steps.reaches(tau, width)
            return pair.contact_at(tau, state), known

        found, known = jax.vmap(contact)(places)
        force = jnp.where(known, found.total, -jnp.inf)
        top = jnp.argmax(force)
        more = force[top] > greatest[way]
        greatest = greatest.at[way].set(jnp.where(more, force[top], greatest[way]))
        best = best.at[way].set(jnp.where(more, places[top], best[way]))
        here = jnp.minimum((round_ + corners) * _BLOCK + top, steps.count - 1)
        corner = jnp.where(at_ends & more, here, corner)
        return greatest, best, corner, jnp.maximum(depth, jnp.max(found.depth))

    least = jnp.full_like(width, -jnp.inf)
    nothing = jnp.zeros_like(width)
    start = jnp.stack([least, least]), jnp.stack([nothing, nothing]), jnp.zeros((), int), least
    turns = blocks + 2 * _ROUNDS + corners
    greatest, best, _, depth = lax.fori_loop(0, turns, look, start)
    return jnp.where(greatest[1] > greatest[0], best[1], best[0]) * width, depth


def one_sided(forces: Float[Array, "7"]) -> tuple[Float[Array, ""], Float[Array, "7"]]:
    """The peak from the forces at the times `BESIDE` it, and with which weights their
    derivatives make up that of the peak.

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
    # A jump stands out from the slope that it makes over the wide distance.
    line = here + (right - left) / (2 * _WIDE) * jnp.asarray(BESIDE[:5], forces.dtype)
    smooth = jnp.max(jnp.abs(forces[:5] - line)) < bend / (8 * _WIDE) + 100 * rounding
    vertex = (right - left) / (2 * jnp.where(bend > _ROUNDINGS * rounding, bend, jnp.inf))
    near = jnp.abs(vertex) < _FARTHEST[forces.dtype.itemsize]
    vertex = jnp.where(smooth & near, vertex, 0.0)
    at_vertex = jnp.stack([one, none, none, none, none, -vertex / 2, vertex / 2])
    highest = jnp.where(corner | smooth, 0, jnp.argmax(forces[:5]))
    single = (jnp.arange(len(BESIDE)) == highest).astype(forces.dtype)
    weights = jnp.where(corner, at_corner, jnp.where(highest == 0, at_vertex, single))
    above = jnp.where(corner, 0.0, bend / 2 * vertex**2)
    return forces[highest] + above, weights
