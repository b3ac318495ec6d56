"""All local maxima of the contact force along a closed orbit, with their derivatives.

The peak is the greatest of several local maxima. Where two of them are equal, the peak has a corner
as a function of the design, while each maximum by itself is smooth. A search that knows all of them
can converge to such a corner.

A *shoulder* is an instant at which the force almost has a maximum: it rises or falls slowly, and
faster before and after. A change of the design can turn a shoulder into a maximum. Shoulders near
the greatest force are therefore listed as well.

The maxima are computed after the orbit and only on request, so the orbit's own program does not
grow.

Where the force has a corner, its two slopes along the motion have opposite signs, and the corner
moves with the parameters. Let s and d be the derivatives of the force with respect to time and to a
parameter, before and after the corner. Both sides remain equal, so the corner's force changes by
(s₁ d₂ - s₂ d₁) / (s₁ - s₂). At a smooth maximum this is a weighted mean of two equal derivatives.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from rootsopt.dynamics.collocation.elements import Elements, Mesh, in_blocks
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import VariedOrbit
from rootsopt.runtime.programs import CachedFunction

Quantity: TypeAlias = Callable[[RotorPair, Float[Array, ""], Float[Array, " n"]], Any]
"""A number of a pair at a time (mesh periods) and a scaled state (n,)."""
MOST = 12
"""Maximum number of local maxima that are reported: the greatest ones."""
# Maximum number of shoulders that are reported in addition to the maxima.
_BESIDES = 4
# Fractions of an element at which the force is evaluated to find the maxima.
_PLACES = np.arange(8) / 8
# Number of instants tried around each maximum in one round of refinement, and number of rounds.
_CLOSER, _ROUNDS = 16, 10
# Distance (mesh periods) before and after a maximum at which the force is differentiated. The last
# round of refinement locates a corner a hundred times more closely.
_ASIDE = 1e-9
# Relative difference between the forces at these instants above which the force jumps.
_JUMP = 1e-6
# Fall of the force between two maxima (fraction of the lower one) below which they count as one
# maximum.
_DIP = 1e-6
# Fraction of the greatest force below which a maximum is left out.
_LEAST = 1e-3
# Difference from the greatest force, as a fraction of that force, above which a shoulder is not
# listed. A shoulder is an instant at which the force almost has a maximum (see the module's
# docstring).
_SHOULDER = 0.02


class Maxima(NamedTuple):
    """Local maxima and shoulders of the contact force over one orbit, greatest first.

    `times` (k,) in mesh periods from φ1 = 0; `forces` (k,) in N; `slopes` (k, d): derivatives of
    the forces along the orbit's d directions (N per unit of each direction).
    """

    times: NDArray[np.float64]
    forces: NDArray[np.float64]
    slopes: NDArray[np.float64]


def local_maxima(pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit) -> Maxima:
    """Return the local maxima of the contact force over a closed `orbit`, with derivatives.

    `tangents`: the directions of the pair's parameters to which the variation of the orbit belongs.

    The derivatives follow the family of orbits. At a smooth maximum they are those at a fixed
    instant (envelope theorem). Where the force has a corner, they follow the corner, as those of
    the peak do. A maximum is left out if the force hardly falls (`_DIP`) between it and a greater
    maximum.
    """
    used = int(orbit.elements.mesh.used)
    times, forces = (np.ravel(np.asarray(x)[:used]) for x in _forces(pair, orbit.elements))
    period = float(orbit.elements.mesh.times[-1] - orbit.elements.mesh.times[0])
    places, forces = np.append(times, times[0] + period), np.append(forces, forces[0])
    at, sides = candidates(places, forces)
    beside = shoulders(places, forces)[:_BESIDES]
    first = np.append(places[at], places[beside])
    if not first.size:
        return Maxima(first, first, np.zeros((0, orbit.variation.state.shape[-1])))
    sides = np.concatenate([sides, [places[beside]] * 2], axis=1)
    room = ((0, 0), (0, MOST + _BESIDES - first.size))
    padded = np.pad(np.concatenate([first[None], sides]), room)
    maxima = _located(pair, tangents, orbit, padded, np.asarray(first.size))
    best, values, slopes = (np.asarray(x, np.float64)[: first.size] for x in maxima)
    order = np.argsort(-values, kind="stable")
    return Maxima(np.mod(best, period)[order], values[order], slopes[order])


def prepare_maxima(pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit) -> None:
    """Compile the programs of `local_maxima` in the background, for arguments of the same kind.

    In the arguments, `jax.ShapeDtypeStruct` may replace arrays."""
    places, count = ((3, MOST + _BESIDES), float), ((), int)
    structs: Any = (jax.ShapeDtypeStruct(shape, kind) for shape, kind in (places, count))
    _located.prepare(pair, tangents, orbit, *structs)
    _forces.prepare(pair, orbit.elements)


def candidates(
    places: NDArray[np.float64], forces: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the indices (k,) of local maxima among samples, and the intervals (2, k) around them.

    `places`, `forces` (m,): times and forces over one cycle, in which the last sample repeats the
    first. If this repeated sample is a maximum, it counts once, on the side of its higher
    neighbour. At most `MOST` maxima are returned, in order of time."""
    last = len(places) - 1
    before, after = np.roll(forces, 1), np.roll(forces, -1)
    before[0], after[-1] = forces[-2], forces[1]
    at = np.flatnonzero((forces >= before) & (forces > after) & (forces > 0))
    seam = last if forces[-2] > forces[1] else 0
    at = at[(at != 0) & (at != last) | (at == seam)]
    at = at[forces[at] > _LEAST * forces.max()]
    # The highest come first; a lower one counts if the force falls between it and all of them.
    kept: list[int] = []
    for k in at[np.argsort(-forces[at], kind="stable")]:
        apart = all(_dip(forces, int(k), other) < (1 - _DIP) * forces[k] for other in kept)
        if apart and len(kept) < MOST:
            kept.append(int(k))
    indices = np.sort(np.asarray(kept, dtype=np.int64))
    low, high = places[np.maximum(indices - 1, 0)], places[np.minimum(indices + 1, last)]
    return indices, np.stack([low, high])


def shoulders(places: NDArray[np.float64], forces: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices (k,) of shoulders among samples of one cycle.

    `places`, `forces` (m,): as for `candidates`. A shoulder is a sample at which the slope of the
    force comes closest to 0, without a change of sign. Only shoulders close to the greatest force
    are returned (`_SHOULDER`). The shoulder with the greatest force comes first."""
    times, forces = places[:-1], forces[:-1]
    period = places[-1] - places[0]
    room = np.mod(np.roll(times, -1) - np.roll(times, 1), period)
    slope = (np.roll(forces, -1) - np.roll(forces, 1)) / room
    before, after, steep = np.roll(slope, 1), np.roll(slope, -1), np.abs(slope)
    same = (np.sign(before) == np.sign(slope)) & (np.sign(after) == np.sign(slope))
    least = (steep <= np.abs(before)) & (steep < np.abs(after))
    high = forces > (1 - _SHOULDER) * np.max(forces)
    indices = np.flatnonzero(same & least & high)
    return indices[np.argsort(-forces[indices], kind="stable")]


def _dip(forces: NDArray[np.float64], one: int, other: int) -> float:
    """Return the least force between the samples `one` and `other` of a cycle.

    There are two ways around the cycle. Return the greater of their least forces."""
    low, high = sorted((one, other))
    inner, outer = forces[low : high + 1], np.concatenate([forces[high:], forces[: low + 1]])
    return float(max(inner.min(), outer.min()))


def contact_force(pair: RotorPair, tau: Float[Array, ""], state: Float[Array, " n"]) -> Any:
    """Return the contact force (N) of `pair` at `tau` (mesh periods) and scaled `state`."""
    return pair.contact_at(tau, state).total


@CachedFunction
def _forces(pair: RotorPair, elements: Elements) -> tuple[Float[Array, "e q"], Float[Array, "e q"]]:
    return along_elements(contact_force, pair, elements)


def along_elements(
    quantity: Quantity, pair: RotorPair, elements: Elements
) -> tuple[Float[Array, "e q"], Any]:
    """Return times (mesh periods) and values of a `quantity` at the `_PLACES` of elements.

    Those of elements that are not in use have no meaning."""
    mesh = elements.mesh
    tau = mesh.ends[0][:, None] + mesh.lengths[:, None] * _PLACES
    number = jnp.broadcast_to(jnp.arange(tau.shape[0])[:, None], tau.shape)
    each = jax.vmap(jax.vmap(lambda tau, state: quantity(pair, tau, state)))
    return tau, in_blocks(each, mesh.used, tau, elements.inside(number, tau))


def around(mesh: Mesh, values: Float[Array, "e q"], times: Float[Array, "e q"]) -> Array:
    """Return the time (mesh periods) of the greatest of the `values`, and those of its neighbours.

    `values`, `times`: from `along_elements`. The result (3,) is a column of `places` in `located`.
    """
    used = (jnp.arange(values.shape[0]) < mesh.used)[:, None]
    best = jnp.argmax(jnp.where(used, values, -jnp.inf))
    # The elements in use come first, and the motion continues periodically.
    flat, last = times.ravel(), mesh.used * len(_PLACES) - 1
    before = jnp.where(best > 0, flat[jnp.maximum(best - 1, 0)], flat[last] - mesh.period)
    after = jnp.where(best < last, flat[jnp.minimum(best + 1, last)], flat[0] + mesh.period)
    return jnp.stack([flat[best], before, after])


@CachedFunction
def _located(pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit, places, count):
    return located(contact_force, pair, tangents, orbit, places, count)


def located(
    quantity: Quantity,
    pair: RotorPair,
    tangents: RotorPair,
    orbit: VariedOrbit,
    places: Float[Array, "3 k"],
    count: Int[Array, ""] | int,
) -> tuple[Float[Array, " k"], Float[Array, " k"], Float[Array, "k d"]]:
    """Return times (mesh periods) and values of the first `count` of k maxima of a `quantity`, and
    the derivatives of the values.

    `places`: an instant near each maximum, then the instants between which it lies."""
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)
    moved = eqx.filter(tangents, eqx.is_inexact_array)
    spread = jnp.linspace(-1, 1, _CLOSER)

    def value_at(tau, state, dynamic):
        return quantity(eqx.combine(dynamic, static), tau, state)

    def closer(number, now):
        best, top, low, high = now
        reach = (2.0 / (_CLOSER - 1)) ** number * (high - low)
        tried = jnp.clip(best + reach * spread, low, high)
        values = jax.vmap(value_at, (0, 0, None))(tried, orbit.elements.motion(tried), dynamic)
        k = jnp.argmax(values)
        better = values[k] > top
        return jnp.where(better, tried[k], best), jnp.where(better, values[k], top), low, high

    def slopes(tau):
        """Return the value at `tau`, its derivative along the motion, and along the directions."""
        state, rate, along = orbit.at(tau)

        def push(time, state_change, change):
            return jax.jvp(value_at, (tau, state, dynamic), (time, state_change, change))

        # Append the direction along the motion, so that the quantity is traced only once.
        times = jnp.append(1.0, jnp.zeros(along.shape[-1]))
        still = jax.tree.map(lambda x: jnp.pad(x, ((1, 0),) + ((0, 0),) * (x.ndim - 1)), moved)
        changes = jnp.concatenate([rate[:, None], along], axis=1)
        values, slopes = jax.vmap(push, (0, 1, 0))(times, changes, still)
        return values[0], slopes[0], slopes[1:]

    def one(k, maxima):
        start = places[0, k], -jnp.inf, places[1, k], places[2, k]
        best, top, *_ = lax.fori_loop(0, _ROUNDS, closer, start)
        values, (before, after), turned = jax.vmap(slopes)(best + _ASIDE * jnp.array([-1.0, 1.0]))
        falls = before - after
        later = jnp.clip(before / jnp.where(falls > 0, falls, jnp.inf), 0.0, 1.0)
        slope = (1 - later) * turned[0] + later * turned[1]
        if pair.contact.jumps:
            # The higher side moves with the event.
            mesh = orbit.elements.mesh
            event = jnp.argmin(jnp.abs(mesh.times - orbit.elements.holding(best)[1]))
            moves = orbit.variation.times[event]
            higher = jnp.argmax(values)
            there = turned[higher] + jnp.stack([before, after])[higher] * moves
            jumps = jnp.abs(values[1] - values[0]) > _JUMP * jnp.abs(top)
            slope = jnp.where(jumps, there, slope)
        return tuple(x.at[k].set(y) for x, y in zip(maxima, (best, top, slope), strict=True))

    nothing = jnp.zeros_like(places[0])
    rows = jnp.zeros((nothing.shape[0], orbit.variation.state.shape[-1]))
    return lax.fori_loop(0, count, one, (nothing, nothing, rows))
