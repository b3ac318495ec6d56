"""All local maxima of the contact force along a closed orbit, with their derivatives.

The peak is the greatest of several local maxima. Where two of them are equal, the peak has a corner
as a function of the design, while each maximum by itself is smooth. A search that knows all of them
can converge to such a corner.

A *shoulder* is an instant at which the force almost has a maximum: it rises or falls slowly, and
faster before and after. A change of the design can turn a shoulder into a maximum. Shoulders near
the greatest force are therefore listed as well.

The maxima are computed after the orbit and only on request, so the orbit's own program does not
grow.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from rootsopt.dynamics.flow import Equation
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.peak import BESIDE, BESIDE_UNIT, Steps, blended
from rootsopt.dynamics.tangent import linearized
from rootsopt.runtime.programs import Program

MOST = 12
"""Maximum number of local maxima that are reported: the greatest ones."""
_BESIDES = 4
"""Maximum number of shoulders that are reported in addition to the maxima."""
_LANES = 64
"""Number of instants at which the force is evaluated together, as arrays."""
_CLOSER, _ROUNDS = 16, 10
"""Number of instants tried around each maximum in one round of refinement, and number of rounds."""
_CHUNK = 32
"""Number of steps linearised together, as arrays."""
_DIP = 1e-6
"""Fall of the force between two maxima (fraction of the lower one) below which they count as one
maximum."""
_LEAST = 1e-3
"""Fraction of the greatest force below which a maximum is left out."""
_SHOULDER = 0.02
"""Difference from the greatest force, as a fraction of that force, above which a shoulder is not
listed. A shoulder is an instant at which the force almost has a maximum (see the module's
docstring)."""
_STEPS = 2048
"""Number of solver steps for which there is room, times a power of 2 if the orbit needs more."""
_SHORTEST = 1e-9
"""Minimum time (mesh periods) from the start of a step to a maximum inside it. An earlier maximum
is moved to this time."""


class Maxima(NamedTuple):
    """Local maxima and shoulders of the contact force over one orbit, greatest first.

    `times` (k,) in mesh periods from φ1 = 0; `forces` (k,) in N; `slopes` (k, d): derivatives of
    the forces along the orbit's d directions (N per unit of each direction).
    """

    times: NDArray[np.float64]
    forces: NDArray[np.float64]
    slopes: NDArray[np.float64]


def local_maxima(
    pair: RotorPair, tangents: RotorPair, orbit: Orbit, period: int, integrator: Integrator
) -> Maxima:
    """Return the local maxima of the contact force over a closed `orbit`, with derivatives.

    `tangents`: directions of the pair's parameters, as for `close_orbit`; `period` of the orbit
    (mesh periods); `integrator`: the integrator with which the orbit was closed.

    The derivatives follow the family of orbits (implicit function theorem). At a smooth maximum
    they are those at a fixed instant (envelope theorem). Where the force has a corner, they follow
    the corner, as those of the peak do. A maximum is left out if the force hardly falls (`_DIP`)
    between it and a greater maximum.
    """
    orbit = _cut(orbit)
    steps = _steps(orbit)
    times, forces = _located(pair, orbit, steps, float(period))
    if not times.size:
        return Maxima(times, forces, np.zeros((0, orbit.moved.shape[1])))
    padded = np.resize(times, MOST + _BESIDES)
    values, slopes = _differentiated(pair, tangents, orbit, padded, integrator)
    values, slopes = (np.asarray(x, np.float64)[: times.size] for x in (values, slopes))
    order = np.argsort(-values, kind="stable")
    return Maxima(times[order], values[order], slopes[order])


def prepare_maxima(
    pair: RotorPair, tangents: RotorPair, orbit: Orbit, integrator: Integrator
) -> None:
    """Compile the programs of `local_maxima` in the background, for arguments of the same kind.

    In the arguments, `jax.ShapeDtypeStruct` may replace arrays."""

    def like(*shape: int, dtype: Any = float) -> Any:
        return jax.ShapeDtypeStruct(shape, dtype)

    flow = orbit.flow
    grid, corners = like(_STEPS), like(_STEPS, flow.corners.shape[1])
    orbit = orbit._replace(flow=flow._replace(grid=grid, corners=corners))
    steps: Any = Steps(grid, grid, corners, corners, like(dtype=int))
    times = like(_room(flow.states.shape[0], _STEPS))
    _differentiated.prepare(pair, tangents, orbit, like(MOST + _BESIDES), integrator)
    _forces.prepare(pair, flow.states, steps, times, like(), like(dtype=int))


def _room(samples: int, steps: int) -> int:
    """Return the maximum number of times that one call of `_forces` gets in the first scan."""
    return samples + steps + 1


def _cut(orbit: Orbit) -> Orbit:
    """Return the `orbit` with room for few more steps than it has.

    There are few sizes, so that orbits share programs."""
    grid, corners = np.asarray(orbit.flow.grid), np.asarray(orbit.flow.corners)
    used, room = int(np.sum(grid < np.inf)), _STEPS
    while room < used:
        room *= 2
    spare = max(room - len(grid), 0)
    grid = np.pad(grid[:room], (0, spare), constant_values=np.inf)
    corners = np.pad(corners[:room], ((0, spare), (0, 0)))
    flow: Any = orbit.flow._replace(grid=grid, corners=corners)
    return orbit._replace(flow=flow)


def _steps(orbit: Orbit) -> Steps:
    """Return the solver steps of a closed orbit."""
    grid, after = np.asarray(orbit.flow.grid), np.asarray(orbit.flow.corners)
    begins = np.concatenate([np.zeros_like(grid[:1]), grid[:-1]])
    before = np.concatenate([np.asarray(orbit.state)[None], after[:-1]])
    arrays: Any = begins, grid, before, after, np.sum(grid < np.inf)
    return Steps(*arrays)


def _located(
    pair: RotorPair, orbit: Orbit, steps: Steps, length: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the times (mesh periods) and forces (N) of local maxima, then of shoulders.

    The maxima are in order of time. `length` of the orbit (mesh periods)."""
    states = np.asarray(orbit.flow.states)
    width = length / states.shape[0]
    ends = np.asarray(steps.ends)[: int(steps.count)]
    places = np.unique(np.concatenate([width * np.arange(states.shape[0]), ends, [length]]))
    room = _room(states.shape[0], steps.ends.shape[0])

    def force(times):
        padded = np.resize(np.ravel(times), max(room, np.size(times)))
        found = _forces(pair, states, steps, padded, np.asarray(width), np.asarray(np.size(times)))
        return np.asarray(found, np.float64)[: np.size(times)].reshape(np.shape(times))

    forces = force(places)
    at, sides = candidates(places, forces)
    if not at.size:
        return places[:0], forces[:0]
    best, top = places[at], forces[at]
    spread = np.linspace(-1, 1, _CLOSER)
    reach = 1.0
    for _ in range(_ROUNDS):
        around = best[:, None] + reach * (sides[1] - sides[0])[:, None] * spread
        around = np.clip(around, sides[0][:, None], sides[1][:, None])
        tried = force(around)
        row, column = np.arange(best.size), np.argmax(tried, axis=1)
        better = tried[row, column] > top
        best = np.where(better, around[row, column], best)
        top = np.where(better, tried[row, column], top)
        reach *= 2.0 / (_CLOSER - 1)
    even = forces[np.searchsorted(places, width * np.arange(states.shape[0]))]
    beside = shoulders(even)[:_BESIDES]
    return np.append(best, width * beside), np.append(top, even[beside])


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
    found = np.sort(np.asarray(kept, dtype=np.int64))
    low, high = places[np.maximum(found - 1, 0)], places[np.minimum(found + 1, last)]
    return found, np.stack([low, high])


def shoulders(forces: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices (k,) of shoulders among uniform samples `forces` (m,) of one cycle.

    A shoulder is a sample at which the slope of the force comes closest to 0, without a change of
    sign. Only shoulders close to the greatest force count (`_SHOULDER`). The shoulder with the
    greatest force comes first."""
    slope = np.roll(forces, -1) - np.roll(forces, 1)
    before, after, steep = np.roll(slope, 1), np.roll(slope, -1), np.abs(slope)
    same = (np.sign(before) == np.sign(slope)) & (np.sign(after) == np.sign(slope))
    least = (steep <= np.abs(before)) & (steep < np.abs(after))
    high = forces > (1 - _SHOULDER) * np.max(forces)
    found = np.flatnonzero(same & least & high)
    return found[np.argsort(-forces[found], kind="stable")]


def _dip(forces: NDArray[np.float64], one: int, other: int) -> float:
    """Return the least force between the samples `one` and `other` of a cycle.

    There are two ways around the cycle. The one with the greater least force counts."""
    low, high = sorted((one, other))
    inner, outer = forces[low : high + 1], np.concatenate([forces[high:], forces[: low + 1]])
    return float(max(inner.min(), outer.min()))


@Program
def _forces(pair: RotorPair, states, steps: Steps, times, width, count):
    """Return the contact force (N) at the first `count` of the `times` (mesh periods).

    `states`: samples with the spacing `width` (mesh periods). Results for the other times have no
    meaning."""
    lanes = jnp.arange(_LANES)

    def look(carry):
        turn, found = carry
        at = jnp.minimum(turn * _LANES + lanes, times.shape[0] - 1)

        def force(tau):
            return pair.contact_at(tau, blended(pair, states, steps, tau, width)).total

        return turn + 1, found.at[at].set(jax.vmap(force)(times[at]))

    start = jnp.zeros((), int), jnp.zeros_like(times)
    return lax.while_loop(lambda carry: carry[0] * _LANES < count, look, start)[1]


class _StepSlopes(NamedTuple):
    """Several linearised steps: state and force after each step, and their derivatives.

    `value` (jobs, n + 1); `by_state` (jobs, n + 1, n): with respect to the state before the step;
    `by_parameters` (jobs, n + 1, d): along d directions of the parameters."""

    value: Float[Array, "jobs rows"]
    by_state: Float[Array, "jobs rows n"]
    by_parameters: Float[Array, "jobs rows d"]


@Program
def _differentiated(
    pair: RotorPair,
    tangents: RotorPair,
    orbit: Orbit,
    times: Float[Array, " k"],
    integrator: Integrator,
) -> tuple[Float[Array, " k"], Float[Array, "k d"]]:
    """Return the force (N) at located maxima, and its derivatives along the family of orbits.

    `times` (k,): instants of the maxima (mesh periods)."""
    dtype, count = orbit.state.dtype, orbit.state.shape[0]
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)
    moved = eqx.filter(tangents, eqx.is_inexact_array)
    unit, solver = pair.force_scale, integrator.solver()
    equation = Equation(static, Measures(), unit, jnp.ones_like(unit), count, solver)
    grid = orbit.flow.grid
    begins = jnp.concatenate([jnp.zeros_like(grid[:1]), grid[:-1]])
    before = jnp.concatenate([orbit.state[None], orbit.flow.corners[:-1]])
    taken = jnp.sum(grid < jnp.inf)
    holds = jnp.clip(jnp.searchsorted(grid, times), 0, taken - 1)
    times = jnp.maximum(times, begins[holds] + _SHORTEST)
    sides = BESIDE_UNIT * jnp.asarray(BESIDE, dtype)
    lanes = jnp.arange(_CHUNK)

    def linear_step(begin, end, state):
        y = equation.start(state, pair.free)
        found = linearized(
            lambda y, dynamic: equation.with_force(begin, end, y, dynamic), y, dynamic, moved, count
        )
        rows = jnp.append(jnp.arange(count), jnp.arange(y.shape[0], found.value.shape[0]))
        return jax.tree.map(lambda x: x[rows], _StepSlopes(*found))

    # One loop linearises the steps of the orbit, then those up to the maxima, then those beside
    # the maxima, so that the linearised step is compiled once.
    chunks = -(-taken // _CHUNK)
    steps_to, beside = -(-times.shape[0] // _CHUNK), -(-times.shape[0] * sides.shape[0] // _CHUNK)
    most = -(-grid.shape[0] // _CHUNK)

    def turn(carry):
        number, kept, reached, near = carry
        place = number * _CHUNK + lanes
        step = jnp.minimum(place, taken - 1)
        to = jnp.clip(place - chunks * _CHUNK, 0, times.shape[0] - 1)
        aside = (number - chunks - steps_to) * _CHUNK + lanes
        aside = jnp.clip(aside, 0, times.shape[0] * sides.shape[0] - 1)
        of, side = aside // sides.shape[0], aside % sides.shape[0]
        phase = jnp.where(number < chunks, 0, jnp.where(number < chunks + steps_to, 1, 2))
        begin = jnp.stack([begins[step], begins[holds[to]], times[of]])[phase]
        end = jnp.stack([grid[step], times[to], times[of] + sides[side]])[phase]
        state = jnp.stack([before[step], before[holds[to]], reached.value[of, :count]])[phase]
        found = jax.vmap(linear_step)(begin, end, state)

        def store(into, at, wanted):
            at = jnp.where(wanted, at, into.value.shape[0])
            return jax.tree.map(lambda x, y: x.at[at].set(y, mode="drop"), into, found)

        kept = store(kept, place, (phase == 0) & (place < taken))
        reached = store(reached, to, phase == 1)
        return number + 1, kept, reached, store(near, aside, phase == 2)

    shape = jax.eval_shape(linear_step, grid[0], grid[0], orbit.state)

    def room(jobs):
        return jax.tree.map(lambda x: jnp.zeros((jobs, *x.shape), x.dtype), shape)

    rooms = room(most * _CHUNK), room(times.shape[0]), room(times.shape[0] * sides.shape[0])
    _, kept, reached, near = lax.while_loop(
        lambda carry: carry[0] < chunks + steps_to + beside, turn, (jnp.zeros((), int), *rooms)
    )
    along = _along(kept, orbit.moved, taken)[holds]
    there = _after(reached, along)[:, :count]
    every = jnp.repeat(there, sides.shape[0], axis=0)
    at = times[:, None] + sides
    slopes = _after(near, every)[:, count:].reshape(*at.shape, near.value.shape[1] - count, -1)
    found = near.value.reshape(*at.shape, -1)
    noise = pair.rounding(orbit.flow.depth)
    values, weights = lax.map(lambda x: equation.peak(x[0], x[1], noise, dynamic), (at, found))
    return unit * values, unit * jnp.einsum("ksf,ksfd->kd", weights, slopes)


def _after(pieces: _StepSlopes, before: Float[Array, "jobs n d"]) -> Float[Array, "jobs rows d"]:
    """Return the derivatives of the values after the steps `pieces`.

    `before`: derivatives of the state before each step."""
    moved = jnp.sum(pieces.by_state[..., None] * before[:, None], axis=2)
    return moved + pieces.by_parameters


def _along(kept: _StepSlopes, start: Float[Array, "n d"], taken: Int[Array, ""]) -> Any:
    """Return the derivatives (steps, n, d) of the state at the start of each step of an orbit.

    `kept`: the linearised steps; `start` (n, d): derivatives at the start of the orbit; `taken`:
    number of steps."""
    count = start.shape[0]

    def advance(k, carry):
        now, found = carry
        piece = jax.tree.map(lambda x: x[k][None], kept)
        return _after(piece, now[None])[0, :count], found.at[k].set(now)

    found = jnp.zeros((kept.value.shape[0], *start.shape), start.dtype)
    return lax.fori_loop(0, taken, advance, (start, found))[1]


__all__ = ["MOST", "Maxima", "candidates", "local_maxima", "prepare_maxima", "shoulders"]
