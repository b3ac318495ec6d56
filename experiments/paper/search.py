"""Global search for the quantities that the paper does not state, compiled by Numba.

The search simulates thousands of scenes from rest with `experiments._common.engines.numba_pair` and
rootsopt's contact map of each rotor, made once for all scenes. On periodic motions, its forces
differ from rootsopt's by about a percent. SciPy's differential evolution minimises the distance of
the four forces from the paper's forces, over the whole box of plausible values.
"""

import dataclasses
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from experiments._common.engines import Motion, Rotor, Scene, motion_of
from experiments._common.engines.numba_pair import MARGIN, Search, Table, integrate, spline_of
from experiments._common.simulation import profile_of
from experiments.paper.scene import FAMILIES, PAPER, QUANTITIES, Quantity, config_of
from rootsopt.contact import FlankPair
from rootsopt.profiles import Profile, geometry

_DEEPEST = -0.035
"""Relative rotation (rad) below which the contact maps end. All plays lie inside, with a
reserve."""
_ROLLS, _RELATIVES = 1024, 96
_SETTLE, _WINDOW, _RTOL = 32, 12, 1e-5
"""Length of the transient (mesh periods), length of the window in which forces are measured (mesh
periods), and tolerance of the motion."""
_LONGEST = 6
"""Longest period of a motion that is searched for (mesh periods)."""
_REPEATS = 1e-2
"""Scaled difference below which a motion repeats."""
_APERIODIC = 0.35
"""Cost added for a pair whose motion does not repeat (natural logarithm of a force ratio)."""
_LOST = 5.0
"""Cost of a scene in which the lobes of a pair pass through each other."""


class Rotors(NamedTuple):
    """A pair's polar area moment (m⁴), its contact map, and constants of its compiled motion."""

    moment: float
    table: Table
    rotor: Rotor
    search: Search
    scene: Scene


class Samples(NamedTuple):
    """n simulated scenes.

    `values` (n, p) of the quantities; `forces` (scene, pair, mean and peak): in N, NaN if the lobes
    pass through each other; `periods` (n, 2): mesh periods by pair, 0 if the motion does not
    repeat.
    """

    values: NDArray[np.float64]
    forces: NDArray[np.float64]
    periods: NDArray[np.int64]

    @property
    def misfits(self) -> NDArray[np.float64]:
        """Largest relative difference of a force from the paper's (n,); inf without forces."""
        worst = np.max(np.abs(self.forces / PAPER - 1), axis=(1, 2))
        return np.where(np.isfinite(worst), worst, np.inf)

    @property
    def periodic(self) -> NDArray[np.bool_]:
        """Whether the motions of both pairs repeat, for each scene (n,)."""
        return np.all(self.periods > 0, axis=1)


def rotors_of(family: str) -> Rotors:
    """Return the data of a pair that all scenes share; `family`: its profile family."""
    config = config_of(family)
    profile = profile_of(config)
    table = _table(profile)
    # With a map, the compiled motion needs only the rotor's pitch angle.
    radius, lobes = config.profile.pitch_radius_mm * 1e-3, config.profile.lobes
    rotor = Rotor(lobes, radius, 0.0, math.pi / (2 * lobes), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    idle = Search(np.zeros((1, 5)), np.zeros(1))
    # Both configs share the scene. `motion_at` replaces the quantities.
    scene = Scene.of(config_of(FAMILIES[0]))
    return Rotors(float(geometry(profile).polar_area_moment), table, rotor, idle, scene)


def _table(profile: Profile) -> Table:
    """Return the contact map of a profile, from rootsopt's search for the closest approach."""
    half = float(profile.half_pitch)
    first = -min(0.9 * half, 2 * math.sqrt(-_DEEPEST) + 0.02)
    step, fall = (half - first) / (_ROLLS - 1 - MARGIN), -_DEEPEST / (_RELATIVES - 1 - MARGIN)
    poses = first + step * np.arange(_ROLLS), _DEEPEST + fall * np.arange(_RELATIVES)
    return Table(spline_of(np.asarray(_gaps(profile, *poses))), first, step, _DEEPEST, fall)


@jax.jit
def _gaps(profile, rolls, relatives):
    """Return the gap (m) at each pair of `rolls` and `relatives` (rad).

    Where the tip land passes, it is continued from the land's end by a parabola."""
    pair, land = FlankPair.of(profile), profile.segments()[0]
    end = land.stop if land.land else 0.0

    def gap(roll, relative):
        found = pair(roll, relative)
        beyond = profile.pitch_radius * (roll - end - relative / 2) ** 2
        return jnp.where(found.found, found.gap, beyond)

    return jax.vmap(lambda x: jax.vmap(lambda e: gap(x, e))(relatives))(rolls)


def motion_at(rotors: Rotors, values: NDArray[np.float64]) -> Motion:
    """Return the constants of the equation of motion with `values` (p,) of the quantities."""
    length, torque, stiffness, damping_ratio, backlash, clearance = map(float, values)
    scene = dataclasses.replace(
        rotors.scene,
        length=length * 1e-3,
        load_torque=torque,
        gear_stiffness=stiffness,
        gear_damping_ratio=damping_ratio,
        half_backlash=backlash * 1e-3 / (2 * rotors.scene.pitch_radius),
        clearance=clearance * 1e-3,
    )
    return motion_of(scene, rotors.moment)


@njit(nogil=True, error_model="numpy")
def _simulate(rotor, motion, table, search, settle, window, rtol):
    """Simulate from rest. Return mean and peak force (N) over the window, and the period.

    The period (mesh periods) is 0 if the motion does not repeat. Forces are NaN if the lobes pass
    through each other.
    """
    angle = rate = total = peak = 0.0
    states = np.zeros((window, 2))
    for i in range(settle + window):
        angle, rate, part, _, top, _, _, _ = integrate(
            rotor, motion, table, search, 0.0, 1.0, angle, rate, rtol, i >= settle
        )
        if not abs(angle) * motion.angle_scale < -table.deepest or math.isnan(part):
            return math.nan, math.nan, 0
        if i >= settle:
            total += part
            peak = max(peak, top)
            states[i - settle] = angle, rate
    period = 0
    for k in range(_LONGEST, 0, -1):
        if np.abs(states[k:] - states[:-k])[-_LONGEST:].max() < _REPEATS:
            period = k
    return total / window * motion.force_scale, peak, period


def scan(pairs: list[Rotors], values: NDArray[np.float64]) -> Samples:
    """Simulate both pairs for each of `values` (n, p), one thread per core."""

    def one(at):
        found = []
        for rotors in pairs:
            motion = motion_at(rotors, at)
            settings = rotors.table, rotors.search, _SETTLE, _WINDOW, _RTOL
            found.append(_simulate(rotors.rotor, motion, *settings))
            if math.isnan(found[-1][0]):
                return [(math.nan, math.nan, 0)] * len(pairs)
        return found

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = np.array(list(pool.map(one, values)), float)
    return Samples(values, found[..., :2], found[..., 2].astype(int))


def costs(samples: Samples) -> NDArray[np.float64]:
    """Return the cost (n,): RMS of log(force / paper's force), increased if a motion does not
    repeat.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.log(np.maximum(samples.forces, 1e-3) / PAPER)
        cost = np.sqrt(np.mean(away**2, axis=(1, 2)))
    cost += _APERIODIC * np.sum(samples.periods == 0, axis=1)
    return np.where(np.isfinite(cost), cost, _LOST)


def values_at(
    points: NDArray[np.float64], quantities: Sequence[Quantity] = QUANTITIES
) -> NDArray[np.float64]:
    """Return the values (n, p) of the quantities at points (n, p) of the unit box."""
    low, high = (np.array([getattr(q, end) for q in quantities]) for end in ("low", "high"))
    logarithmic = low * (high / low) ** points
    return np.where([q.logarithmic for q in QUANTITIES], logarithmic, low + (high - low) * points)


def explore(
    seed: int,
    generations: int,
    population: int,
    quantities: Sequence[Quantity] = QUANTITIES,
) -> Samples:
    """Return all scenes that differential evolution tries, with the random `seed`.

    The search covers the box of the ranges of `quantities`, with `population` scenes per quantity
    in each generation.
    """
    pairs = [rotors_of(family) for family in FAMILIES]
    parts: list[Samples] = []

    def cost(points):
        parts.append(scan(pairs, values_at(points.T, quantities)))
        return costs(parts[-1])

    differential_evolution(
        cost,
        [(0.0, 1.0)] * len(QUANTITIES),
        maxiter=generations,
        popsize=population,
        mutation=(0.4, 0.9),
        recombination=0.8,
        tol=0.0,
        init="sobol",
        rng=np.random.default_rng(seed),
        polish=False,
        updating="deferred",
        vectorized=True,
    )
    return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def regimes(samples: Samples, within: float) -> list[int]:
    """Return the index of the best scene of every regime, best first.

    A regime is a combination of the periods of both motions. Only scenes that repeat and have a
    misfit of at most `within` count.
    """
    order = np.argsort(samples.misfits)
    found: dict[tuple[int, ...], int] = {}
    for i in order[: np.searchsorted(samples.misfits[order], within, side="right")]:
        if samples.periodic[i]:
            found.setdefault(tuple(samples.periods[i]), int(i))
    return list(found.values())
