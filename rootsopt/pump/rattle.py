"""Rattle of the timing gear: flights and impacts of its teeth, and the run-out that starts them.

`docs/pump.md` derives the limit of silent running.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from rootsopt.config.units import UM
from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import CLOSED, OPEN, Steady
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.status import Status

SILENT = "silent_eccentricity_um"
"""Name of the limit of silent running in result files."""
# Fractions of an element at which the gear is evaluated. Its elements end where teeth touch or
# part.
_PLACES = (np.arange(8) + 0.5) / 8
# Number of angles over a turn for the linear motion, and for its check that no flank touches.
_ANGLES, _POSES = 2880, 360
# Ratio of the eccentricities that is assumed if both are 0: only the first gear is eccentric.
_FIRST = np.array([1.0, 0.0])


class SilentLimit(NamedTuple):
    """Eccentricity below which the teeth stay in contact.

    `value` (m): eccentricity of the more eccentric gear if both grow in proportion; `slopes` (d,):
    its derivatives with respect to the design; `depth` (m): greatest penetration of the flanks in
    the motion at the limit, negative where they stay apart. If the flanks touch, the limit has no
    meaning.
    """

    value: Float[Array, ""]
    slopes: Float[Array, " d"]
    depth: Float[Array, ""]


def rattle_record(pair: RotorPair, motion: Steady) -> dict[str, dict[str, float]]:
    """Return the result file's entries for the rattle of the timing gear in the `motion`.

    They are the share of time without contact of its teeth, the number of impacts per turn, and the
    greatest torque (N·m) between the teeth. Without impacts, this torque is 0. There are no entries
    without a motion to report."""
    status, window = Status.of(motion.status), motion.window
    held = status in CLOSED or bool(motion.held)
    if held:
        elements = motion.known.elements
        used, turns = int(elements.mesh.used), int(motion.period) / pair.lobes
        teeth = [np.asarray(x)[:used].ravel() for x in _of_orbit(pair, elements)]
    elif status in (*OPEN, Status.IDLE) and window is not None:
        done, states = int(window.done), window.states
        turns = done / pair.lobes
        teeth = [np.asarray(x)[:done].ravel() for x in _of_window(pair, states)]
    else:
        return {}
    touch, torque, time = teeth
    # A window does not repeat, so a flight across its end does not count as an impact.
    before = np.roll(touch, 1) if held else np.append(touch[:1], touch[:-1])
    impacts = int(np.sum(touch & ~before))
    entries = {
        "time_apart": float(np.sum(time[~touch]) / np.sum(time)),
        "impacts_per_revolution": impacts / turns,
        "greatest_impact_N_m": float(np.max(np.abs(torque))) if impacts else 0.0,
    }
    return {"gear_rattle": entries}


def silent_record(limit: SilentLimit) -> dict[str, tuple[float, NDArray[np.float64]]]:
    """Return the result file's entry for the limit of silent running: (value, derivatives (d,)).

    There is none if the flanks would touch before the teeth part."""
    if limit.depth >= 0:
        return {}
    return {SILENT: (float(limit.value) / UM, np.asarray(limit.slopes) / UM)}


def _teeth(pair: RotorPair, tau, states) -> tuple[Bool[Array, ""], Float[Array, ""], Array]:
    """Return whether the teeth touch, the gear's torque (N·m), and the relative duration of a mesh
    period."""
    assert pair.gear is not None
    motion = pair.motion(tau, states)
    own, lapse = np.zeros(0), pair.lapse(states) * jnp.ones_like(tau)
    return pair.gear.margins(motion, own)[0] > 0, pair.gear.torque_on_1(motion, own), lapse


@CachedFunction
def _of_orbit(pair: RotorPair, elements: Elements):
    """Return the `_teeth` at the `_PLACES` of all elements of an orbit, with durations."""
    begin, length = elements.mesh.ends[0], elements.mesh.lengths
    tau = begin[:, None] + length[:, None] * _PLACES
    number = jnp.broadcast_to(jnp.arange(tau.shape[0])[:, None], tau.shape)
    states = elements.inside(number, tau)
    touches, torque, lapse = jax.vmap(jax.vmap(lambda t, z: _teeth(pair, t, z)))(tau, states)
    return touches, torque, lapse * length[:, None]


@CachedFunction
def _of_window(pair: RotorPair, states: Float[Array, "p s n"]):
    periods, samples, _ = states.shape
    tau = jnp.arange(periods * samples).reshape(periods, samples) / samples
    return jax.vmap(jax.vmap(lambda t, z: _teeth(pair, t, z)))(tau, states)


@CachedFunction
def silent_limit(scene: Scene, design: Float[Array, " d"]) -> SilentLimit:
    """Return the limit of silent running of a `design` (d,) in config units.

    The scene must have a gear with errors."""

    def limit(design):
        profile = scene.profile(design)
        return silent_eccentricity(scene.at(design), profile, geometry(profile))

    value, relative = limit(design)
    slopes = jax.jacfwd(lambda design: limit(design)[0])(design)
    pair, every = scene.pair(design), _ANGLES // _POSES
    phi = 2 * jnp.pi * jnp.arange(_POSES) / _POSES
    touch = jax.vmap(lambda phi, x: pair.contact_force(phi, x, jnp.zeros(())))
    return SilentLimit(value, slopes, jnp.max(touch(phi, relative[::every]).depth))


def silent_eccentricity(
    scene: Scene, profile: Profile, shape: Geometry
) -> tuple[Float[Array, ""], Float[Array, " angles"]]:
    """Return the limit of silent running (m), and ε (rad) over a turn in the motion at the limit.

    `profile` and `shape`: those of a design, in a scene whose gear has errors. The limit follows
    from the linear motion in permanent contact, under load, drive, gear and inertia. The deflection
    of the teeth has two parts. One is due to load and measured error, the other is proportional to
    the eccentricities. The limit is 0 if the first part alone separates the teeth."""
    inertia, load = scene.inertia(shape), scene.load(profile, shape)
    gear = scene.gear_of(inertia)
    assert gear is not None
    assert gear.errors is not None
    phi = 2 * jnp.pi * jnp.arange(_ANGLES) / _ANGLES
    errors, most = gear.errors, jnp.max(gear.errors.eccentricity)
    unit = jnp.where(most > 0, errors.eccentricity / jnp.where(most > 0, most, 1.0), _FIRST)
    middle, wider = eqx.tree_at(lambda e: e.eccentricity, errors, unit).run_out(phi, 0 * phi)
    measured, swings = errors.measurement(phi), middle - wider
    on_1, on_2 = (jax.vmap(torque)(phi) for torque in (load.torque1, load.torque2))
    on_1 = 0 * phi if on_1 is None else on_1
    frequency = scene.speed * jnp.arange(_ANGLES // 2 + 1)
    stiffness, inertial = gear.stiffness + 1j * gear.damping * frequency, -inertia * frequency**2
    # Response of rotor 1 to a torque at this frequency, as a multiple of that of rotor 2.
    follows = jnp.zeros_like(stiffness)
    if scene.motor is not None:
        turning = (inertia + scene.motor.inertia) * frequency - 1j * scene.motor.slope
        follows = inertia * frequency / turning

    def deflection(on_1, on_2, error):
        """Return the deflection (rad) that torques (N·m) against the rotors and an error cause."""
        first, second, errs = (jnp.fft.rfft(x) for x in (on_1, on_2, error))
        forced = inertial * errs + second - follows * first
        return jnp.fft.irfft(forced / (inertial + stiffness * (1 + follows)), _ANGLES)

    rest, swing = deflection(on_1, on_2, measured), deflection(0 * phi, 0 * phi, swings)
    held = jnp.min(rest) > 0
    share = -swing / jnp.where(held, rest, 1.0)
    # The vertex of the parabola through the greatest value and its neighbours.
    k = jnp.argmax(share)
    low, top, high = (share[(k + step) % _ANGLES] for step in (-1, 0, 1))
    top = top - (high - low) ** 2 / (8 * (high - 2 * top + low))
    limit = jnp.where(held, 1 / top, 0.0)
    relative = measured + limit * swings - gear.half_backlash - (rest + limit * swing)
    relative = relative if gear.offset is None else relative + gear.offset
    return scene.pitch_radius * limit, relative
