"""Series of a motion: position and force over its reported window."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import SAMPLES, Steady
from rootsopt.dynamics.window import Window
from rootsopt.runtime.programs import CachedFunction


@dataclasses.dataclass(frozen=True)
class Series:
    """Motion, force and penetration over the reported window, as NumPy arrays (samples,).

    `time` (s): uniform unless rotor 1 is free; `rotation` of rotor 1 (rad), uniform; `relative`: ε
    (rad); `rate`: dε/dt (rad/s); `drive_force`, `coast_force`: normal force (N) on each flank;
    `depth`: greatest penetration (m; negative: gap); `bearing_loads` (samples, 4): loads (N) on the
    bearings, None without `scene.bearings` or without an orbit. The bearings are that of rotor 1 at
    the timing gear's end, its other one, and those of rotor 2."""

    time: NDArray[np.float64]
    rotation: NDArray[np.float64]
    relative: NDArray[np.float64]
    rate: NDArray[np.float64]
    drive_force: NDArray[np.float64]
    coast_force: NDArray[np.float64]
    depth: NDArray[np.float64]
    bearing_loads: NDArray[np.float64] | None = None

    @property
    def force(self) -> NDArray[np.float64]:
        """Contact force (N): sum of the normal forces on both flanks."""
        return self.drive_force + self.coast_force


@CachedFunction
def contact_series(pair: RotorPair, tau, states):
    """Return (mesh period (s), relative durations (t,), (ε (rad), dε/dt (rad/s)), flank contact).

    `tau` (t,): times (mesh periods); `states` (t, n): scaled states; all results but the first have
    an axis (t,). A relative duration is that of a mesh period, divided by the mesh period."""
    lapse = pair.lapse(states) if pair.free else jnp.ones_like(tau)
    contact = jax.vmap(pair.contact_at)(tau, states)
    return pair.mesh_period, lapse, pair.physical(tau, states)[1:], contact


def series_of(pair: RotorPair, tau, states) -> Series:
    """Return the series of a motion with scaled `states` (t, n) at `tau` (t,) in mesh periods."""
    # Reduce to one turn of the rotor: the rounding error of a late time is greater.
    turn = np.mod(tau, pair.lobes)
    period, lapse, (relative, rate), contact = contact_series(pair, turn, states)
    period = np.asarray(period)
    time = period * tau
    if pair.free:
        from scipy.integrate import cumulative_simpson  # Slow import (0.5 s), only for motors.

        time = period * cumulative_simpson(lapse, x=tau, initial=0.0)
    double = functools.partial(np.asarray, dtype=np.float64)
    return Series(
        time=double(time),
        rotation=2 * np.pi / pair.lobes * np.asarray(tau, np.float64),
        relative=double(relative),
        rate=double(rate),
        drive_force=double(contact.drive),
        coast_force=double(contact.coast),
        depth=double(contact.depth),
    )


def orbit_series(pair: RotorPair, found: Steady) -> Series:
    """Return the series of a closed orbit, repeated to cover at least one revolution of rotor 1."""
    period = int(found.period)
    cycles = -(-pair.lobes // period)
    tau = period * np.arange(cycles * SAMPLES) / SAMPLES
    return series_of(pair, tau, np.tile(np.asarray(sampled(found.known.elements)), (cycles, 1)))


def window_series(pair: RotorPair, window: Window) -> Series:
    """Return the series of a window of a motion that does not settle."""
    states = np.asarray(window.states)
    periods, samples, count = states.shape
    return series_of(pair, np.arange(periods * samples) / samples, states.reshape(-1, count))


@CachedFunction
def sampled(elements: Elements) -> Float[Array, "samples n"]:
    """Return `SAMPLES` uniform samples of the scaled states of an orbit, from φ1 = 0 on."""
    return elements.motion(elements.mesh.period * jnp.arange(SAMPLES) / SAMPLES)
