"""How far the flanks of an orbit are from touching, and the torque of its timing gear.

The *contact reserve* of a motion is the least gap of its flanks. Where they touch, it is negative:
the greatest penetration. The *backlash reserve* is the increase of the gear's backlash at which the
flanks just touch. A gear with more backlash lets rotor 2 move further from the middle of its play.
As long as the gear's torque stays the same, so does the rest of the motion. The reserve is
therefore found by moving the motion outwards by s until the least gap is 0.

Both reserves are smooth where the flanks begin to touch. Their derivatives are those at the instant
of the least gap, even if it moves (envelope theorem). Those of s follow from the implicit function
theorem.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from rootsopt.dynamics.collocation.elements import GAUSS, Elements
from rootsopt.dynamics.flanks import FlankForce, by_slice, touch_of
from rootsopt.dynamics.maxima import along_elements, around, located
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import VariedOrbit

RESERVES = "contact_reserve_um", "backlash_reserve_mm"
"""Names of the contact reserve and the backlash reserve.
"""
GEAR = tuple(
    f"{which}gear_{what}" for what in ("torque_N_m", "force_N") for which in ("mean_", "", "rms_")
)
"""Names of mean, greatest and RMS torque of the timing gear, and of its force at the pitch circle.
"""
LONGEST = 8
"""Maximum period of an orbit (mesh periods), rounded up by `RotorPair.whole`."""
# Minimum number of pieces into which one mesh period is divided.
_EVEN = 128
# Maximum number of instants at which flags change, and number of bisections that locate them.
_FLAGS, _HALVED = 64, 40
# Length (mesh periods) below which a piece counts as empty. Many corners coincide.
_EMPTY = 1e-13


def smooth_pieces(
    pair: RotorPair,
    elements: Elements,
    corners: Float[Array, " k"],
    flags: Callable[[Any], Any],
) -> tuple[Float[Array, " pieces"], Float[Array, " pieces"], Int[Array, ""]]:
    """Return starts and ends (mesh periods) of the pieces of an orbit in which a quantity is
    smooth, and the number of pieces in use. Unused pieces are empty and come last. `pair`: pair of
    the orbit.

    `corners` (k,): times from 0 to 1 at which the quantity is not smooth, in each mesh period;
    `flags`: function that returns, at a time, flags (s,) that change where it is not smooth. Pieces
    end there, and at the ends of elements. They are shorter than elements, because a power of a
    quantity needs shorter pieces than the motion."""
    mesh = elements.mesh
    period = mesh.period
    turns = jnp.arange(pair.whole(LONGEST))[:, None]
    every = jnp.append(corners, jnp.arange(1, _EVEN + 1) / _EVEN)
    own = jnp.mod(mesh.ends[1], period)
    ends = jnp.append(own, jnp.minimum((every + turns).ravel(), period))
    ends = jnp.sort(jnp.minimum(lax.stop_gradient(ends), period))
    begins = jnp.append(0.0, ends[:-1])
    before = jax.vmap(flags)(begins)
    changes = jnp.any(before != jnp.append(before[1:], before[:1], axis=0), axis=1)
    # Unused places get the last piece, which is empty.
    piece = jnp.nonzero(changes, size=_FLAGS, fill_value=len(ends) - 1)[0]

    def halved(_, ends):
        low, high = ends
        middle = (low + high) / 2
        same = jnp.all(jax.vmap(flags)(middle) == jax.vmap(flags)(low), axis=1)
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    _, high = lax.fori_loop(0, _HALVED, halved, (begins[piece], ends[piece]))
    ends = jnp.sort(jnp.append(ends, high))
    begins = jnp.append(0.0, ends[:-1])
    empty = ends - begins < _EMPTY
    order = jnp.argsort(empty)
    return begins[order], ends[order], jnp.sum(~empty)


# Number of positions of rotor 2 at which the least gap is computed. Newton's method leads from one
# to the next; the gap is nearly linear in the position.
_NEWTON = 6
# Greatest move towards the middle of the backlash, as a share of the distance from it. Without
# clearance, flanks part only in the middle, where the other flanks touch.
_INWARDS = 0.9999
INSTANTS = 96
"""Number of instants over an orbit at which `gaps` are computed."""


class Apart(NamedTuple):
    """Reserve and gear torque of an orbit, with derivatives along its d directions.

    `values` (5,): contact reserve (m); backlash reserve, as half the backlash (rad), like
    `TimingGear.half_backlash`; mean, greatest and RMS torque of the gear (N·m, magnitude). `slopes`
    (5, d): their derivatives."""

    values: Float[Array, "5"]
    slopes: Float[Array, "5 d"]


def apart(pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit) -> Apart:
    """Return reserve and gear torque of a closed `orbit` of a pair with a timing gear.

    `tangents`: directions of the pair's parameters to which the variation of the orbit belongs."""
    fields = zip(reserve(pair, tangents, orbit), gear_torque(pair, tangents, orbit), strict=True)
    return Apart(*map(jnp.concatenate, fields))


def _aside(pair: RotorPair, tau, state: Float[Array, " n"]) -> tuple[Array, Array]:
    """Return ε (rad) in the middle of the gear's backlash, and ε of the `state` minus this."""
    assert pair.gear is not None
    first, second = pair.gear.edges_at(pair.angle(tau))
    middle = (first + second) / 2
    return middle, pair.angle_scale * state[0] - middle


def _contact(moved: Float[Array, ""], pair: RotorPair, tau, state) -> FlankForce:
    """Return the contact at a state, with rotor 2 `moved` outwards (rad).

    A negative number moves it towards the middle of the gear's backlash, but not beyond."""
    middle, aside = _aside(pair, tau, state)
    side = jnp.where(aside < 0, -1.0, 1.0)
    relative = middle + side * jnp.maximum(side * aside + moved, 0.0)
    return pair.contact_at(tau, state.at[0].set(relative / pair.angle_scale))


def reserve(
    pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit
) -> tuple[Float[Array, "2"], Float[Array, "2 d"]]:
    """Return contact and backlash reserve of an `orbit`, and their derivatives, as in `Apart`."""

    def newton(moved, _):
        """Return the next guess, this guess, and the place where the flanks then come closest."""

        def gap(*at):
            contact = _contact(moved, *at)
            return contact.depth, contact.lever2, jnp.abs(_aside(*at)[1])

        times, (depths, *further) = along_elements(gap, pair, orbit.elements)
        places = around(orbit.elements.mesh, depths, times)
        nearest = jnp.nonzero(times.ravel() == places[0], size=1)[0][0]
        depth, lever, aside = (x.ravel()[nearest] for x in (depths, *further))
        nearer = jnp.maximum(moved - depth / lever, -_INWARDS * aside)
        return nearer, (moved, places)

    def exact(at):
        """Return the least gap, its derivatives, and the lever of the flank."""
        moved, places = at
        depth = functools.partial(_depth, moved)
        (time,), (deepest,), (slope,) = located(depth, pair, tangents, orbit, places[:, None], 1)
        # The contact's own lever is not exact enough for a derivative.
        state = orbit.elements.motion(time)
        lever = jax.grad(lambda moved: _depth(moved, pair, time, state))(moved)
        return -deepest, -slope, lever

    moves, places = lax.scan(newton, jnp.zeros_like(pair.angle_scale), length=_NEWTON)[1]
    ends = np.array([0, _NEWTON - 1])
    gaps, slopes, levers = lax.map(exact, (moves[ends], places[ends]))
    half = moves[-1] + gaps[1] / levers[1]
    return jnp.stack([gaps[0], half]), jnp.stack([slopes[0], slopes[1] / levers[1]])


def _depth(moved: Float[Array, ""], *at) -> Float[Array, ""]:
    return _contact(moved, *at).depth


def gaps(
    pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit
) -> tuple[Float[Array, " n"], Float[Array, "n d"]]:
    """Return the gaps (m) of drive and coast flanks at `INSTANTS` of an `orbit`, and their
    derivatives along the orbit's directions.

    Each gap is smooth, but their least value has corners where its side or its instant changes. The
    pair must be two-sided."""
    assert pair.two_sided
    times = orbit.elements.mesh.period * jnp.arange(INSTANTS) / INSTANTS

    def of_section(pair, motion):
        sides = jnp.array([1.0, -1.0])
        return jax.vmap(lambda side: touch_of(pair, side, motion).depth)(sides)

    def both(pair, tau, state):
        depths = by_slice(pair, of_section, pair.motion(tau, state))
        return -jnp.max(depths.reshape(-1, 2), axis=0)

    def at(tau):
        return orbit.pushed(both, tau, pair, tangents)

    values, slopes = lax.map(at, times, batch_size=INSTANTS // 2)
    return values.ravel(), slopes.reshape(2 * INSTANTS, -1)


def _torque(pair: RotorPair, tau, state) -> Float[Array, ""]:
    assert pair.gear is not None
    return pair.gear.torque_on_1(pair.motion(tau, state), np.zeros(0))


def gear_torque(
    pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit
) -> tuple[Float[Array, "3"], Float[Array, "3 d"]]:
    """Return mean, greatest and RMS torque of the gear over an `orbit`, and their derivatives.

    Units: as in `Apart`. Averages are over time."""

    def integrands(pair, tau, state):
        size = jnp.abs(_torque(pair, tau, state))
        return pair.lapse(state) * jnp.stack([size, size**2, jnp.ones_like(size)])

    def varied(tau):
        return orbit.pushed(integrands, tau, pair, tangents)

    def flags(tau):
        return (_torque(pair, tau, orbit.elements.motion(tau)) > 0)[None]

    begins, ends, _ = smooth_pieces(pair, orbit.elements, jnp.zeros(0), flags)
    nodes = begins[:, None] + (ends - begins)[:, None] * GAUSS.nodes
    samples = jax.vmap(jax.vmap(varied))(nodes)
    total, slope = (jnp.tensordot(ends - begins, GAUSS.whole(x), 1) for x in samples)
    mean, square = total[:2] / total[2]
    by_mean, by_square = (slope[:2] - jnp.stack([mean, square])[:, None] * slope[2]) / total[2]
    rms = jnp.sqrt(square)
    by_rms = by_square / (2 * jnp.where(rms > 0, rms, jnp.inf))

    def size(*at):
        return jnp.abs(_torque(*at))

    times, sizes = along_elements(size, pair, orbit.elements)
    places = around(orbit.elements.mesh, sizes, times)[:, None]
    _, (peak,), (by_peak,) = located(size, pair, tangents, orbit, places, 1)
    return jnp.stack([mean, peak, rms]), jnp.stack([by_mean, by_peak, by_rms])
