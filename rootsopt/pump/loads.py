"""Loads on the bearings along a motion: of flanks, gas, timing gear and weight.

A rotor's bearings sit at z = ±(L/2 + a), the timing gear at z = L/2 + g. Forces are those in the
fixed frame: rotor 1 at the origin, rotor 2 at (2r, 0). Rotor 1 turns counter-clockwise.
`docs/bearings.md` derives the formulas."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Inexact

from rootsopt.dynamics.collocation.elements import BLOCK, GAUSS, POINTS, in_blocks, whole_blocks
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.parts.load import MIRROR, AxisLoads, GasResultant, tooth_force
from rootsopt.dynamics.reserve import LONGEST, smooth_pieces
from rootsopt.dynamics.steady import SAMPLES, VariedOrbit
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene, along

EQUIVALENT = "bearing_load_equivalent_N"
"""Name of the bearings' greatest equivalent dynamic load in result files."""
BEARING = (*(EQUIVALENT, "bearing_load_max_N", "axial_force_max_N", "tilting_moment_max_N_m"),)
"""Names of the quantities that an evaluation takes from the bearing loads along the motion."""


def equivalent_load(force: Inexact[Array, "*k n"], exponent: float) -> Float[Array, "*k"]:
    """Return the constant load (N) with the same bearing life, (mean |F|^p)^(1/p).

    `force` (…, n): loads (N) at equal steps of rotation; `exponent`: p."""
    return jnp.mean(jnp.abs(force) ** exponent, axis=-1) ** (1 / exponent)


# Number of quantities that are averaged: a power of each bearing's load, and 1.
_INTEGRANDS = 5
# Distance (mesh periods) before and after a jump at which the integrands are evaluated.
_ASIDE = 1e-9
# Number of angles of rotor 1, over a mesh period, for loads without a motion.
_POSES = 720


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
        bearings, half = scene.bearings, scene.length / 2
        assert bearings is not None
        loads = scene.axis_loads(bearings, pair.load, pair.gear, scene.mass(shape))
        ends = half + bearings.distance, half + bearings.gear_distance
        return cls(pair, loads, scene.length, scene.helix, *ends, bearings.exponent)

    def flags(self, orbit: VariedOrbit, tau: Float[Array, ""]) -> Any:
        """Return what changes where the loads are not smooth along an `orbit`.

        `tau`: time (mesh periods)."""
        motion = self.pair.motion(tau, orbit.elements.motion(tau))
        return self.loads.switches(motion, np.zeros(0))

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

        `heights` (slices,): z of the slices (m). The first moment is ∫ z dF - P A. A is the axial
        force, and P its point of action relative to the rotor's axis."""
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


@CachedFunction
def orbit_loads(scene: Scene, design: Float[Array, " d"], orbit: VariedOrbit) -> OrbitLoads:
    """Return the bearing loads over a closed `orbit`.

    `design` (d,): in config units, to which the variation of the orbit belongs. Averages are
    integrals over pieces of the orbit in which the loads are smooth. The greatest load is that
    among uniform samples."""

    def build(design):
        return BearingSet.of(scene, design), jnp.zeros(())

    bearings, tangents, _ = along(build, design, jnp.eye(design.shape[0]))
    unit, period = lax.stop_gradient(bearings.pair.force_scale), orbit.elements.mesh.period
    tau = period * jnp.arange(SAMPLES) / SAMPLES
    at_samples = tau, orbit.elements.motion(tau)
    series = lax.map(lambda at: bearings.at(*at), at_samples, batch_size=BLOCK)
    sizes = _channels(series, scene)
    latest = jnp.argmax(sizes, axis=0)

    def quantities(bearings, tau, state):
        """Return the integrands, then all quantities whose greatest value is reported.

        The integrands are the loads to the power of the exponent, and 1. Averages are over time:
        both are multiplied by the relative duration of a mesh period."""
        loads = bearings.at(tau, state)
        size = loads.sizes / unit
        # The root of a load that vanishes has no derivative.
        pushed = size > 0
        powers = jnp.where(pushed, jnp.where(pushed, size, 1.0) ** bearings.exponent, 0.0)
        lapse = bearings.pair.lapse(state) * jnp.ones_like(unit)
        return jnp.concatenate([lapse * powers, lapse[None], _channels(loads, scene)])

    def varied(tau):
        """Return the quantities, and their derivatives along the design, at constant time."""
        return orbit.pushed(quantities, tau, bearings, tangents)

    # The loads have corners where the motion has none, for example where the gear's torque changes
    # sign. Those of the gas are known (mesh periods, from 0 to 1).
    gas, flags = bearings.loads.gas, partial(bearings.flags, orbit)
    corners = jnp.zeros(0) if gas is None else gas.corners() * bearings.pair.lobes / (2 * jnp.pi)
    begins, ends, count = smooth_pieces(bearings.pair, orbit.elements, corners, flags)
    leaps, moves = _leaps(scene, orbit, bearings, tangents)
    sides = leaps[:, None] + _ASIDE * np.array([-1.0, 1.0])
    # All instants in one array, so that the derivatives are compiled once.
    single = jnp.append(tau[latest], sides)
    single = jnp.pad(single, (0, -len(single) % POINTS)).reshape(-1, POINTS)
    inside = begins[:, None] + (ends - begins)[:, None] * GAUSS.nodes
    number = len(single)
    instants = whole_blocks(jnp.concatenate([single, inside]))
    values, slopes = in_blocks(jax.vmap(jax.vmap(varied)), number + count, *instants)

    def integral(nodes):
        """Return the integrals over the orbit of values at the nodes of all pieces."""
        whole = GAUSS.whole(nodes[number : number + len(ends), :, :_INTEGRANDS])
        return jnp.tensordot(ends - begins, whole, 1)

    def alone(nodes):
        """Return the values at the greatest loads, and on both sides of the leaps."""
        flat = nodes[:number].reshape(number * POINTS, *nodes.shape[2:])
        k = np.arange(len(latest))
        beside = flat[len(latest) : len(latest) + sides.size, :_INTEGRANDS]
        return flat[k, _INTEGRANDS + k], beside.reshape(*sides.shape, *beside.shape[1:])

    before, after = jnp.moveaxis(alone(values)[1], 1, 0)
    total = integral(values)
    # The integrals also change because the instants move at which the integrands jump.
    slope = integral(slopes) + jnp.einsum("mr,md->rd", before - after, moves)
    mean, duration = total[:-1] / total[-1], total[-1]
    slope = (slope[:-1] - mean[:, None] * slope[-1]) / duration
    root = 1 / bearings.exponent
    equivalent = unit * mean**root
    factor = equivalent * root / jnp.where(mean > 0, mean, jnp.inf)
    # At a sample, time does not move with the design.
    rises = alone(slopes)[0]
    return OrbitLoads(equivalent, factor[:, None] * slope, series, jnp.max(sizes, axis=0), rises)


def _leaps(
    scene: Scene, orbit: VariedOrbit, bearings: BearingSet, tangents: BearingSet
) -> tuple[Array, Array]:
    """Return the times (m,) at which the loads jump (mesh periods), and how they move (m, d).

    These are the instants at which a pocket opens, and events of the orbit if levers may jump.
    `tangents`: derivatives of the `bearings` along the design."""
    mesh, variation = orbit.elements.mesh, orbit.variation
    times, moves = [jnp.zeros(0)], [jnp.zeros((0, variation.times.shape[1]))]
    if scene.twist_free and bearings.loads.gas is not None:
        openings, slopes = _openings(bearings, tangents)
        longest = bearings.pair.whole(LONGEST)
        opened = (openings + jnp.arange(longest)[:, None]).ravel()
        times.append(opened)
        moves.append((opened < mesh.period)[:, None] * jnp.tile(slopes, (longest, 1)))
    if bearings.pair.contact.jumps:
        times.append(mesh.times)
        moves.append(variation.times)
    return jnp.concatenate(times), jnp.concatenate(moves)


def _openings(bearings: BearingSet, tangents: BearingSet) -> tuple[Array, Array]:
    """Return the times (2,) at which a pocket opens, and their derivatives (2, d) along `tangents`.

    Times are in mesh periods, from 0 to 1. The `bearings` must have gas. The times move with the
    twist only."""
    dynamic, static = eqx.partition(bearings, eqx.is_inexact_array)
    moved = eqx.filter(tangents, eqx.is_inexact_array)

    def times(dynamic):
        bearings = eqx.combine(dynamic, static)
        return bearings.loads.gas.openings() * bearings.pair.lobes / (2 * jnp.pi)

    slopes = jax.vmap(lambda along: jax.jvp(times, (dynamic,), (along,))[1])(moved)
    return times(dynamic), slopes.T


def _channels(loads: BearingLoads, scene: Scene) -> Float[Array, "*n k"]:
    if scene.helix is None:
        return loads.sizes
    return jnp.concatenate([loads.sizes, loads.axial_sizes], axis=-1)


@CachedFunction
def static_loads(scene: Scene, design: Float[Array, " d"]) -> tuple[Array, Array]:
    """Return the bearings' (equivalent, greatest) loads (4,) in N if the gear carries the load.

    The flanks do not touch, and nothing oscillates. `design` (d,): in config units."""
    profile = scene.profile(design)
    return still_loads(scene.at(design), profile, geometry(profile))


def still_loads(scene: Scene, profile: Profile, shape: Geometry) -> tuple[Array, Array]:
    """Return the same as `static_loads` for the `profile` and `shape` of a design.

    JAX can differentiate it. The scene must have `bearings`."""
    bearings, half = scene.bearings, scene.length / 2
    assert bearings is not None
    load = scene.load(profile, shape)
    loads = scene.axis_loads(bearings, load, scene.gear, scene.mass(shape))

    def size(phi):
        forces, first, _ = _from_gas(loads.gas, scene.length, scene.helix, phi)
        teeth = tooth_force(load.torque2(phi), loads.radius, loads.tooth_angle)
        teeth = jnp.stack([-teeth, teeth]) if scene.gear is not None else jnp.zeros((2, 2))
        forces, first = forces + teeth, first + (half + bearings.gear_distance) * teeth
        if loads.weight is not None:
            forces = forces - loads.weight * np.array([[0.0, 1.0], [0.0, 1.0]])
        share = first / (2 * (half + bearings.distance))
        radial = jnp.stack([forces / 2 + share, forces / 2 - share], axis=1)
        return BearingLoads(radial, jnp.zeros(2), first).sizes

    phi = 2 * jnp.pi / scene.lobes * (jnp.arange(_POSES) + 0.5) / _POSES
    sizes = jax.vmap(size)(phi)
    return equivalent_load(sizes.T, bearings.exponent), jnp.max(sizes, axis=0)
