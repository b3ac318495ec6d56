"""Loads on the bearings along a motion: of flanks, gas, timing gear and weight.

A rotor's bearings sit at z = ±(L/2 + a), the timing gear at z = L/2 + g. `docs/bearings.md` derives
the formulas.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rootsopt.dynamics.flow import Equation
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.parts import AxisLoads
from rootsopt.dynamics.parts.resultants import MIRROR, GasResultant
from rootsopt.dynamics.switches import with_switches
from rootsopt.dynamics.tangent import linearized
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.pump.bearings import equivalent_load
from rootsopt.runtime.programs import Program
from rootsopt.scene import Scene
from rootsopt.scene.build import along

_CHUNK = 32
"""Number of steps linearised together, as arrays."""
_LONGEST = 8
"""Maximum length of an orbit (mesh periods)."""
_EVEN = 128
"""Minimum number of pieces into which the steps of one mesh period are divided."""
_ASIDE = 1e-9
"""Half the length (mesh periods) of the short piece around each instant at which a load jumps."""
POSES = 720
"""Number of angles of rotor 1, over a mesh period, for loads without a motion."""


class BearingLoads(NamedTuple):
    """Loads on the bearings at one or several instants.

    `radial` (rotor, bearing, x and y): load (N) on each bearing, that at the timing gear's end
    first. `axial` (rotor): force (N) on a rotor along +z, from flanks and gas. `tilting` (rotor, x
    and y): moment (N·m) of flanks and gas about the middle of a rotor. Rotor 1 turns from x to y,
    about +z."""

    radial: Float[Array, "*n rotor bearing xy"]
    axial: Float[Array, "*n rotor"]
    tilting: Float[Array, "*n rotor xy"]

    @property
    def sizes(self) -> Float[Array, "*n 4"]:
        """Magnitudes (N) of the loads on the four bearings, those of rotor 1 first."""
        size = jnp.sqrt(jnp.sum(self.radial**2, axis=-1))
        return size.reshape(*size.shape[:-2], 4)

    @property
    def axial_sizes(self) -> Float[Array, "*n 4"]:
        """Magnitudes of the axial forces (N) on both rotors, then of their tilting moments (N·m).

        All are 0 for straight rotors."""
        moments = jnp.sqrt(jnp.sum(self.tilting**2, axis=-1))
        return jnp.concatenate([jnp.abs(self.axial), moments], axis=-1)


class BearingSet(eqx.Module):
    """A pair with its bearings, ready to compute their loads.

    `pair`: rotor pair; `loads`: forces other than those of the flanks; `length` (m) of the rotors;
    `twist` (rad) over it, `None` for straight rotors; `bearing`, `gear` (m): distance of each
    bearing and of the gear from the middle; `exponent`: p of the equivalent load, (mean
    |F|^p)^(1/p)."""

    pair: RotorPair
    loads: AxisLoads
    length: Float[Array, ""]
    twist: Float[Array, ""] | None
    bearing: Float[Array, ""]
    gear: Float[Array, ""]
    exponent: float = eqx.field(static=True)

    @classmethod
    def of(cls, scene: Scene, design: Float[Array, " d"]) -> "BearingSet":
        """Return the set of a `design` (d,) in config units; the scene must have `bearings`."""
        scene = scene.at(design)
        pair, shape = scene.pair_and_shape(design)
        found, half = scene.bearings, scene.length / 2
        assert found is not None
        loads = scene.axis_loads(found, pair.load, pair.gear, scene.mass(shape))
        ends = half + found.distance, half + found.gear_distance
        return cls(pair, loads, scene.length, scene.helix, *ends, found.exponent)

    def at(self, tau: Float[Array, ""], state: Float[Array, " n"]) -> BearingLoads:
        """Return the loads at rotation `tau` (mesh periods) and scaled `state`.

        Elastic supports carry the load that moves them; rigid bearings carry all forces."""
        pair = self.pair
        motion = pair.motion(tau, state)
        pushes = pair.pushes(motion)
        slices = pair.contact.slices
        places = np.zeros(1) if slices is None else slices.places
        forces, moments, axial = self._from_flanks(pushes, self.length * jnp.asarray(places))
        more = _from_gas(self.loads.gas, self.length, self.twist, motion.phi)
        forces, moments, axial = (
            a + b for a, b in zip((forces, moments, axial), more, strict=True)
        )
        tilting = jnp.stack([-moments[:, 1], moments[:, 0]], axis=1)
        teeth = self.loads.gear_force(motion)
        teeth = jnp.stack([-teeth, teeth])
        forces, moments = forces + teeth, moments + self.gear * teeth
        if self.loads.weight is not None:
            forces = forces - self.loads.weight * np.array([[0.0, 1.0], [0.0, 1.0]])
        for part, own in zip(pair.all_parts, pair.own_states(state), strict=True):
            if part.displaces:
                carried = part.force_on_axes(motion, own)
                assert carried is not None
                forces = -carried
        share = moments / (2 * self.bearing)
        radial = jnp.stack([forces / 2 + share, forces / 2 - share], axis=1)
        return BearingLoads(radial, axial, tilting)

    def _from_flanks(self, pushes, heights):
        """Return forces and first moments (rotor, x and y) and axial forces (rotor) of flanks.

        `heights` (slices,): z of the slices (m). The first moment is ∫ z dF - P A, where A is the
        axial force and P the place at which it acts, seen from the rotor's axis."""
        axis = jnp.stack([2 * self.loads.radius, jnp.zeros_like(self.loads.radius)])
        place = jnp.stack([pushes.place, pushes.place - axis], axis=2)
        forces = jnp.stack([-pushes.force, pushes.force], axis=2)
        axial = jnp.zeros_like(pushes.torque)
        if self.twist is not None:
            axial = -self.twist / self.length * pushes.torque
        first = heights[:, None, None, None] * forces - place * axial[..., None]
        return forces.sum((0, 1)), first.sum((0, 1)), axial.sum((0, 1))


def _from_gas(gas: GasResultant | None, length, twist, phi):
    """Return forces and first moments (rotor, x and y) and axial forces (rotor) of the gas.

    `length` (m); `twist` (rad) over it, or `None`; `phi`: φ1 (rad). The axial force of the gas is
    taken to act at the middle of the chord."""
    if gas is None:
        return jnp.zeros((2, 2)), jnp.zeros((2, 2)), jnp.zeros(2)
    forces = gas.slice_forces(phi)
    heights = length * jnp.asarray(gas.places)
    first, axial = heights[:, None, None] * forces, jnp.zeros(forces.shape[:2])
    if twist is not None:
        contact, tip = gas.chords(phi)
        against = jnp.sum(tip**2 - contact**2, axis=-1) / 2
        weights = jnp.asarray(gas.weights)[:, None]
        axial = twist / length * gas.pressure_length * weights * against
        middle = (contact + tip) / 2 * np.stack([np.ones(2), MIRROR])
        first = first - middle * axial[..., None]
    return forces.sum(0), first.sum(0), axial.sum(0)


class OrbitLoads(NamedTuple):
    """Loads on the bearings over a closed orbit.

    `equivalent` (4,): equivalent dynamic load (N) of every bearing, those of rotor 1 first;
    `slopes` (4, d): its derivatives along the orbit's directions; `series`: loads at the orbit's
    samples. `greatest` (k,): greatest load (N) of every bearing among the samples, and for twisted
    rotors that of each of `BearingLoads.axial_sizes`; `greatest_slopes` (k, d): its derivatives."""

    equivalent: Float[Array, "4"]
    slopes: Float[Array, "4 d"]
    series: BearingLoads
    greatest: Float[Array, " k"]
    greatest_slopes: Float[Array, "k d"]


class _LoadEquation(Equation):
    """The equation of motion with the integrals of the bearing loads to the power of the exponent.

    `dynamic` holds the arrays of a `BearingSet`, and `static` the rest of it."""

    def pair(self, dynamic) -> RotorPair:
        return eqx.combine(dynamic, self.static).pair

    def rates(self, tau, state, contact, dynamic):
        del contact
        return self.sizes(tau, state, dynamic)

    def sizes(self, tau, state, dynamic):
        """Return the bearing loads to the power of the exponent (4,), in units of the force."""
        bearings = eqx.combine(dynamic, self.static)
        size = bearings.at(tau, state).sizes / self.force_unit
        # The root of a load that vanishes has no derivative.
        pushed = size > 0
        return jnp.where(pushed, jnp.where(pushed, size, 1.0) ** bearings.exponent, 0.0)


class _Pieces(NamedTuple):
    """Pieces of an orbit's steps, in order of time.

    `begin`, `end`: of each piece (mesh periods; `end` is inf beyond the last); `step`: index of the
    step that holds it; `first`: start of this step."""

    begin: Float[Array, " pieces"]
    end: Float[Array, " pieces"]
    step: Int[Array, " pieces"]
    first: Float[Array, " pieces"]


def _pieces(
    grid: Float[Array, " steps"], ends: Float[Array, " ends"], corners: Float[Array, " k"], period
) -> _Pieces:
    """Return the steps of `grid` (mesh periods), divided at `ends` and at the `corners` of loads.

    `ends`: further ends, unused ones inf; `corners` (k,): in one mesh period; `period` of the orbit
    (mesh periods). Each corner lies in a short piece, so that no load is evaluated right at a jump.
    The power of a load needs shorter steps than the motion."""
    turns = jnp.arange(_LONGEST, dtype=grid.dtype)[:, None, None]
    sides = _ASIDE * jnp.array([-1.0, 1.0], grid.dtype)[:, None]
    even = jnp.arange(_EVEN, dtype=grid.dtype) / _EVEN
    added = jnp.append(jnp.mod(corners + sides, 1.0), even) + turns[..., 0]
    added = jnp.where(added < period, added, jnp.inf).ravel()
    end = jnp.sort(jnp.concatenate([grid, ends, lax.stop_gradient(added).astype(grid.dtype)]))
    begin = jnp.concatenate([jnp.zeros_like(end[:1]), end[:-1]])
    starts = jnp.concatenate([jnp.zeros_like(grid[:1]), grid[:-1]])
    used = jnp.sum(grid < jnp.inf)
    step = jnp.clip(jnp.searchsorted(grid, end), 0, used - 1)
    # Rounding may put a corner beyond the last step.
    end = jnp.where(end > grid[used - 1], jnp.inf, end)
    return _Pieces(begin, end, step, starts[step])


def loads_corners(bearings: BearingSet) -> Float[Array, " k"]:
    """Return the times (mesh periods, from 0 to 1) at which the gas forces are not smooth."""
    gas = bearings.loads.gas
    if gas is None:
        return jnp.zeros(0)
    return gas.corners() * bearings.pair.lobes / (2 * jnp.pi)


@Program
def orbit_loads(  # 90 lines: the functions of its two loops share the linearised equation.
    scene: Scene,
    design: Float[Array, " d"],
    orbit: Orbit,
    period: Int[Array, ""],
    integrator: Integrator,
) -> OrbitLoads:
    """Return the bearing loads over a closed `orbit` of `period` mesh periods.

    `design` (d,): in config units, the one of the orbit; `integrator`: that of the orbit. The
    derivatives follow the family of orbits, with respect to the design. The steps of the orbit are
    linearised once more, with the loads as further integrals."""

    def build(design):
        return BearingSet.of(scene, design), jnp.zeros(())

    bearings, tangents, _ = along(build, design, jnp.eye(design.shape[0]))
    pair = bearings.pair
    dtype, count = orbit.state.dtype, orbit.state.shape[0]
    dynamic, static = eqx.partition(bearings, eqx.is_inexact_array)
    moved = eqx.filter(tangents, eqx.is_inexact_array)
    unit = lax.stop_gradient(pair.force_scale)
    # Reserve four integrals, one for each bearing: mean, mean square, and cosine and sine of one
    # line.
    room = Measures(orders=np.ones(1))
    equation = _LoadEquation(static, room, unit, jnp.ones_like(unit), count, integrator.solver())
    # The loads have corners that the motion does not have, as where the gear's torque changes sign.
    marked = dataclasses.replace(pair, parts=(*pair.parts, bearings.loads))
    tolerance = integrator.tolerance
    ends = with_switches(
        lax.stop_gradient(marked), orbit.flow, period.astype(dtype), tolerance, orbit.flow.grid
    )
    samples = orbit.flow.states.shape[0]
    tau = period * jnp.arange(samples, dtype=dtype) / samples
    series = lax.map(lambda at: bearings.at(*at), (tau, orbit.flow.states))
    sizes = _channels(series, scene)
    latest = jnp.argmax(sizes, axis=0)
    # The motion is known at the ends of pieces: one ends at the instant of each greatest load.
    pieces = _pieces(
        orbit.flow.grid, jnp.append(ends, tau[latest]), loads_corners(bearings), period
    )
    before = jnp.concatenate([orbit.state[None], orbit.flow.corners[:-1]])
    taken, lanes = jnp.sum(pieces.end < jnp.inf), jnp.arange(_CHUNK)

    def linear_piece(k):
        begin, end = pieces.begin[k], pieces.end[k]
        start = equation.start(before[pieces.step[k]], pair.free)
        state = equation.advanced(pieces.first[k], begin, start, dynamic)[0][:count]

        def run(y, dynamic):
            return equation.advanced(begin, end, y, dynamic)[0]

        return linearized(run, equation.start(state, pair.free), dynamic, moved, count)

    openings = _openings(dynamic, static, moved) if scene.twist_free else None

    def opening(k, state):
        """Return what is added to slopes because the jump inside piece `k`, if any, moves."""
        assert openings is not None
        opened, delay = openings
        begin, end = pieces.begin[k], pieces.end[k]
        away = (begin + end) / 2 - opened
        inside = (jnp.abs(away - jnp.round(away)) < _ASIDE / 2) & (end - begin < 3 * _ASIDE)
        before, after = (equation.sizes(time, state, dynamic) for time in (begin, end))
        lapse = pair.lapse(state) if pair.free else 1.0
        return jnp.outer(lapse * (before - after), inside @ delay)

    def advance(carry, job):
        moved, total, slopes, peaks = carry
        wanted, end, found, jumps = job
        after = found.by_state @ moved + found.by_parameters
        new = total + found.value[count:], slopes + after[count:]
        total, slopes = jax.tree.map(lambda x, y: jnp.where(wanted, x, y), new, (total, slopes))
        if jumps is not None:
            slopes = slopes.at[:4].add(jnp.where(wanted, jumps, 0.0))
        here = wanted & (tau[latest] == end)
        peaks = jnp.where(here[:, None, None], after[:count], peaks)
        return (jnp.where(wanted, after[:count], moved), total, slopes, peaks), None

    def chunk(carry):
        number, sums = carry
        place = number * _CHUNK + lanes
        at = jnp.minimum(place, taken - 1)
        found = jax.vmap(linear_piece)(at)
        jumps = None if openings is None else jax.vmap(opening)(at, found.value[:, :count])
        jobs = place < taken, pieces.end[at], found, jumps
        sums, _ = lax.scan(advance, sums, jobs)
        return number + 1, sums

    size = room.count + pair.free
    peaks = jnp.broadcast_to(orbit.moved, (len(latest), *orbit.moved.shape))
    totals = jnp.zeros(size, dtype), jnp.zeros((size, orbit.moved.shape[1]), dtype)
    begin = jnp.zeros((), int), (orbit.moved, *totals, peaks)
    _, (_, total, slopes, peaks) = lax.while_loop(lambda now: now[0] * _CHUNK < taken, chunk, begin)
    duration, drift = period.astype(dtype), jnp.zeros(orbit.moved.shape[1], dtype)
    if pair.free:
        duration, drift = total[-1], slopes[-1]
    mean = total[:4] / duration
    slopes = (slopes[:4] - mean[:, None] * drift) / duration
    root = 1 / bearings.exponent
    equivalent = unit * mean**root
    factor = equivalent * root / jnp.where(mean > 0, mean, jnp.inf)

    def rise(channel, tau, state, along_state, along):
        def one(state, dynamic):
            found = eqx.combine(dynamic, static).at(tau, state)
            return _channels(found, scene)[channel]

        return jax.jvp(one, (state, dynamic), (along_state, along))[1]

    # At a sample, time does not move with the design.
    each = jax.vmap(rise, (None, None, None, 1, 0))
    channels = jnp.arange(len(latest))
    rises = jax.vmap(each, (0, 0, 0, 0, None))(
        channels, tau[latest], orbit.flow.states[latest], peaks, moved
    )
    greatest = jnp.max(sizes, axis=0)
    return OrbitLoads(equivalent, factor[:, None] * slopes, series, greatest, rises)


def _openings(dynamic, static, moved) -> tuple[Array, Array] | None:
    """Return the times (2,) at which a pocket opens, and their derivatives (2, d) along `moved`.

    Times are in mesh periods, from 0 to 1. `None` without gas. `dynamic`, `static`: arrays
    and rest of a `BearingSet`. The times move with the twist only."""

    def times(dynamic):
        bearings = eqx.combine(dynamic, static)
        return bearings.loads.gas.openings() * bearings.pair.lobes / (2 * jnp.pi)

    if eqx.combine(dynamic, static).loads.gas is None:
        return None
    slopes = jax.vmap(lambda along: jax.jvp(times, (dynamic,), (along,))[1])(moved)
    return times(dynamic), slopes.T


def _channels(loads: BearingLoads, scene: Scene) -> Float[Array, "*n k"]:
    """Return all quantities whose greatest value is reported."""
    if scene.straight:
        return loads.sizes
    return jnp.concatenate([loads.sizes, loads.axial_sizes], axis=-1)


@Program
def static_loads(scene: Scene, design: Float[Array, " d"]) -> tuple[Array, Array]:
    """Return (equivalent, greatest) loads (4,) in N of the bearings if the gear carries the load.

    The flanks do not touch, and nothing oscillates. `design` (d,): in config units."""
    profile = scene.profile(design)
    return still_loads(scene.at(design), profile, geometry(profile))


def still_loads(scene: Scene, profile: Profile, shape: Geometry) -> tuple[Array, Array]:
    """Return the same as `static_loads` for the `profile` and `shape` of a design.

    JAX can differentiate it. The scene must have `bearings`."""
    found, half = scene.bearings, scene.length / 2
    assert found is not None
    load = scene.load(profile, shape)
    loads = scene.axis_loads(found, load, scene.gear, scene.mass(shape))

    def size(phi):
        forces, first, _ = _from_gas(loads.gas, scene.length, scene.helix, phi)
        across = load.torque2(phi) / loads.radius
        teeth = jnp.stack([jnp.abs(across) * jnp.tan(loads.tooth_angle), across])
        teeth = jnp.stack([-teeth, teeth]) if scene.gear is not None else jnp.zeros((2, 2))
        forces, first = forces + teeth, first + (half + found.gear_distance) * teeth
        if loads.weight is not None:
            forces = forces - loads.weight * np.array([[0.0, 1.0], [0.0, 1.0]])
        share = first / (2 * (half + found.distance))
        radial = jnp.stack([forces / 2 + share, forces / 2 - share], axis=1)
        return BearingLoads(radial, jnp.zeros(2), first).sizes

    phi = 2 * jnp.pi / scene.lobes * (jnp.arange(POSES) + 0.5) / POSES
    sizes = jax.vmap(size)(phi)
    return equivalent_load(sizes.T, found.exponent), jnp.max(sizes, axis=0)


__all__ = ["BearingLoads", "BearingSet", "OrbitLoads", "orbit_loads", "static_loads", "still_loads"]
