"""Compares reported gradients of random designs and scenes with differences of orbits.

A *pair* here is a random design (CIC with two and three lobes, arc, involute) in a random scene
(speed, load, backlash, gear; half of the scenes with friction, motor and gas). The study keeps
pairs that settle on a periodic orbit, most of them with periods above one and some above four. It
evaluates each pair at rtol 1e-8, 1e-9 and 1e-10. The derivatives of mean, peak and RMS force along
one direction of the design are compared with central differences of the forces of orbits closed
with another method (dopri8) at 1e-12.
"""

import csv
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments._common.scenes import CIC, FORCES
from experiments._common.shooting import closed, differentiated
from experiments._common.simulation import evaluator_of
from rootsopt.config import load
from rootsopt.dynamics.verdict import agreement
from rootsopt.response.evaluation import Evaluation, Evaluator

Row = dict[str, Any]
TOLERANCES = (1e-8, 1e-9, 1e-10)
MEASURES = (*FORCES, "rms_force_N")
"""Names of the forces whose gradients are compared."""
STEPS = 2e-5, 2e-6
"""Relative steps of the central differences. A difference with half the step follows, and both are
extrapolated to step 0. Orbits are accurate to 1e-12, so differences are accurate to 1e-7 or 1e-6.
The change from one to the other shows it."""
NOISY = 1e-5
"""Relative change of the differences above which the smaller step is used, too. Forces are strongly
curved close to a bifurcation."""
WAY = np.array([1.0, -0.7, 0.8])
"""Changes of the design parameters, relative to their values, along the direction of the
differences."""
BEYOND = 0.01
"""Share of gradients that may err by more than their check states."""
SHARE = 0.6
"""Share of pairs with a period above one below which pairs of period one are discarded."""
QUICK_COUNT = 4
"""Number of pairs of a reduced run."""
KINDS: dict[str, tuple[str, list[str]]] = {
    "cic, 3 lobes": ("cic", []),
    "cic, 2 lobes": ("cic", ["profile.lobes=2"]),
    "cic, friction, motor and gas": ("cic", []),
    "cic, motor": (
        "cic",
        [
            "scene.drive=torque",
            "scene.motor={slope_N_m_s_per_rad: 0.1, inertia_kg_m2: 1.0e-3}",
        ],
    ),
    "arc and involute": ("arc_involute", []),
    "cic, long periods": ("cic", []),
}
FULL = "cic, friction, motor and gas"
"""Kind of pairs with random friction, motor and gas. Half of all pairs are of this kind."""
LONG = "cic, long periods"
"""Kind of pairs of which only orbits of five mesh periods or more are kept. About one scene in
twenty of this kind has such an orbit."""
PATIENCE = 60
"""Maximum number of scenes of the kind `LONG` drawn for each pair wanted."""


def pairs(seed: int, kind: str) -> Iterator[list[str]]:
    """Yield random pairs of one `kind` without end, each as overrides of configs/cic.yaml."""
    family, fixed = KINDS[kind]
    draw = np.random.default_rng([seed, list(KINDS).index(kind)])
    lobes = 2 if "2 lobes" in kind else 3
    while True:
        angle, tip = draw.uniform(29, 42), draw.uniform(0.5, 5.0)
        longest = 33.0 * np.sin(np.radians(angle)) * (np.pi / 2 / lobes - np.radians(tip))
        values: dict[str, Any] = {
            "profile.family": family,
            "profile.pressure_angle_deg": round(angle, 2),
            "profile.involute_length_mm": round(draw.uniform(0.3, 0.95) * longest, 3),
            "profile.tip_arc_angle_deg": round(tip, 2),
            "scene.speed_rpm": round(10 ** draw.uniform(2.8, 3.7), 1),
            "scene.load.torque_N_m": round(10 ** draw.uniform(-0.2, 1.2), 3),
            "scene.timing_gear.backlash_mm": round(draw.uniform(0.02, 0.4), 3),
            "scene.timing_gear.damping_ratio": round(10 ** draw.uniform(-1.3, -0.2), 3),
            "scene.timing_gear.stiffness_N_m_per_rad": round(10 ** draw.uniform(3.6, 4.8), 0),
        }
        if kind == LONG:
            values |= {
                "scene.speed_rpm": round(draw.uniform(1000, 3000), 1),
                "scene.load.torque_N_m": round(draw.uniform(0.8, 5.0), 3),
                "scene.timing_gear.backlash_mm": round(draw.uniform(0.15, 0.4), 3),
                "scene.timing_gear.damping_ratio": round(draw.uniform(0.05, 0.35), 3),
            }
        if family == "arc_involute":
            values["profile.tip_arc_angle_deg"] = "null"
        if kind == FULL:
            values.pop("scene.load.torque_N_m")
            values |= full(draw)
        yield [*(f"{key}={value}" for key, value in values.items()), *fixed]


def full(draw: np.random.Generator) -> dict[str, Any]:
    """Return random friction, motor and gas, as overrides."""
    pressure, static = 10 ** draw.uniform(3.7, 4.8), draw.uniform(0.02, 0.25)
    kinetic, creep = static * draw.uniform(0.3, 1.0), 10 ** draw.uniform(0.7, 2.3)
    slide = creep * 10 ** draw.uniform(0.3, 1.3)
    slope, inertia = 10 ** draw.uniform(-2.0, 0.0), 10 ** draw.uniform(-4.0, -2.3)
    return {
        "scene.load": f"{{pressure_difference_Pa: {pressure:.0f}}}",
        "contact.friction": f"{{static: {static:.3f}, kinetic: {kinetic:.3f}, "
        f"stiction_speed_mm_s: {creep:.1f}, friction_speed_mm_s: {slide:.1f}}}",
        "scene.drive": "torque",
        "scene.motor": f"{{slope_N_m_s_per_rad: {slope:.3f}, inertia_kg_m2: {inertia:.5f}}}",
    }


def differences(
    evaluator: Evaluator, found: Evaluation, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate the forces along `WAY`, in relative steps.

    Returns the derivatives (3,) in N per unit of relative change, and their estimated errors (3,).
    Both are NaN where an orbit does not close."""
    design = np.array(list(found.design.values()))
    period = int(found.steady_state["period"])

    def at(change: float) -> np.ndarray:
        moved = design * (1 + change * WAY[: len(design)])
        shot = closed(evaluator.pair(moved), found.state, period)
        return shot.forces if shot.miss < 1e-10 else np.full(len(MEASURES), np.nan)

    return differentiated(at, step)


def evaluated(evaluator: Evaluator) -> Iterator[tuple[float, Evaluation]]:
    """Yield (rtol, evaluation) of the config's design: the loosest tolerance from rest, the others
    from the state that it found.
    """
    first = evaluator.at_tolerance(TOLERANCES[0])(series=False)
    yield TOLERANCES[0], first
    for rtol in TOLERANCES[1:]:
        yield rtol, evaluator.at_tolerance(rtol)(start=first.start, series=False)


def slopes_of(found: Evaluation) -> np.ndarray:
    """Return the terms (3, d) of the reported derivatives of the forces along `WAY`, in N."""
    rows = np.array([list(found.gradient[measure].values()) for measure in MEASURES])
    design = np.array(list(found.design.values()))
    return rows * design * WAY[: len(design)]


def rows_of(
    evaluator: Evaluator, kind: str, overrides: list[str], found: dict[float, Evaluation]
) -> list[dict[str, Any]]:
    """Return the evaluations and their errors, one row per tolerance.

    Errors are relative to the greatest term of the derivative."""
    usable = [one for one in found.values() if one.usable]
    size = np.max(np.abs(slopes_of(usable[-1])), axis=1)
    truth, noise = differences(evaluator, usable[-1], STEPS[0])
    if not np.max(noise / size) < NOISY:
        again = differences(evaluator, usable[-1], STEPS[1])
        if not np.max(again[1] / size) > np.max(noise / size):
            truth, noise = again
    rows = []
    for rtol, one in found.items():
        row: dict[str, Any] = {"kind": kind, "rtol": rtol, "status": one.status.label}
        row |= {"period": one.steady_state.get("period"), "scene": " ".join(overrides)}
        for name in ("residual", "floquet_multiplier"):
            row[name] = one.steady_state.get(name)
        for name in ("gradient_disagreement", "orbit_elements", "seconds"):
            row[name] = one.statistics.get(name)
        if one.usable:
            errors = np.abs(np.sum(slopes_of(one), axis=1) - truth) / size
            for k, measure in enumerate(MEASURES):
                row[measure], row[f"{measure}_error"] = one.response[measure], errors[k]
                row[f"{measure}_noise"] = noise[k] / size[k]
        rows.append(row)
    return rows


@dataclasses.dataclass(frozen=True)
class Draw:
    """Choice of random pairs: their number, the seed, and a part of the kinds.

    `part` (k, n): every n-th kind, starting with the k-th.
    """

    count: int = 200
    seed: int = 0
    part: tuple[int, int] = (0, 1)


def wanted_of(quick: bool, count: int) -> dict[str, int]:
    """Return the number of pairs of each kind. Half of the pairs are of the kind `FULL`.

    `count`: number of pairs of all kinds except `LONG`, which a reduced run omits."""
    if quick:
        return {FULL: count}
    kinds = [kind for kind in KINDS if kind not in (FULL, LONG)]
    share = count // 2 // len(kinds)
    return {FULL: count - share * len(kinds)} | dict.fromkeys(kinds, share) | {LONG: count // 20}


def run(
    quick: bool,
    draw: Draw | None = None,
    say: Callable[[str], None] = lambda text: None,
    keep: Callable[[list[Row]], None] = lambda rows: None,
) -> list[Row]:
    """Measure the pairs chosen by `draw`; return three rows per pair, one per tolerance.

    After each pair, `keep` is called with all rows so far. A reduced run measures four pairs of one
    kind.
    """
    draw = draw or Draw()
    part, parts = draw.part
    wanted = wanted_of(quick, QUICK_COUNT if quick else draw.count)
    rows: list[Row] = []
    for kind in list(wanted)[part::parts]:
        for new in pairs_of_kind(kind, wanted[kind], draw.seed, say):
            rows += new
            keep(rows)
    return rows


def pairs_of_kind(
    kind: str, wanted: int, seed: int, say: Callable[[str], None]
) -> Iterator[list[Row]]:
    """Yield the rows of each pair of a `kind`, until `wanted` pairs have been measured."""
    lively = plain = 0
    for number, overrides in enumerate(pairs(seed, kind)):
        if lively + plain >= wanted or (kind == LONG and number > PATIENCE * wanted):
            break
        # Wait for rare longer periods, but only for a limited number of scenes.
        patient = number < 6 * wanted
        evaluator = evaluator_of(load(CIC, overrides), give_up_early=True)
        series = evaluated(evaluator)
        first = next(series)
        scout = int(first[1].steady_state.get("period", 0)) if first[1].usable else 0
        if (
            not scout
            or (kind == LONG and scout < 5)
            or (scout == 1 and patient and kind != FULL and plain >= (1 - SHARE) * wanted)
        ):
            continue
        new = rows_of(evaluator, kind, overrides, dict([first, *series]))
        lively, plain = lively + (scout > 1), plain + (scout == 1)
        found = {row["rtol"]: (row["status"], row.get("mean_force_N_error")) for row in new}
        say(f"{kind} {lively} {plain} period {new[0]['period']} {found}")
        yield new


def read(folder: Path) -> list[dict[str, Any]]:
    """Read the rows of all parts from the result folder."""
    rows = []
    for path in sorted(folder.glob("gradients_*.csv")):
        with open(path, newline="") as file:
            rows += list(csv.DictReader(file))
    return rows


@dataclasses.dataclass(frozen=True)
class Judgement:
    """Summary of all pairs: counts by period, quantiles of the errors, broken promises.

    `errors`: rtol → (periodic pairs, all pairs, force → (median, 95 % quantile, maximum, number of
    gradients compared)). `ratios`: median, 95 % and 99 % quantile and maximum of the errors
    relative to the `gradient_disagreement`; noise of the differences is no error. `broken`: a line
    for each gradient whose error exceeds the limit of its check, for each pair that has a result at
    one tolerance but none at a finer tolerance, and if too many errors exceed the
    `gradient_disagreement`.
    """

    pairs: int
    periods: dict[int, int]
    errors: dict[float, tuple[int, int, dict[str, tuple[float, float, float, int]]]]
    ratios: tuple[float, ...]
    broken: list[str]

    def lines(self) -> Iterator[str]:
        """Yield the lines of the table, as text."""
        yield f"{self.pairs} pairs"
        yield f"periods: {self.periods}"
        for rtol, (good, count, forces) in self.errors.items():
            parts = [f"rtol {rtol:g}: {good} periodic of {count}"]
            for name, (median, most, worst, compared) in forces.items():
                parts.append(
                    f"{name}: median {median:.1e}, 95 % {most:.1e}, maximum {worst:.1e}"
                    f" ({compared} compared)"
                )
            yield "; ".join(parts)
        quantiles = ", ".join(f"{ratio:.1e}" for ratio in self.ratios)
        yield f"error / disagreement: median, 95 %, 99 %, maximum {quantiles}"
        yield from self.broken
        yield f"{len(self.broken)} promises broken"


def judge(rows: Sequence[Row]) -> Judgement:
    """Summarise the rows of all parts, and compare errors with the promises of the checks."""
    scenes: dict[str, dict[float, Row]] = {}
    for row in rows:
        scenes.setdefault(row["scene"], {})[float(row["rtol"])] = row
    periods = sorted(int(float(found[TOLERANCES[0]]["period"])) for found in scenes.values())
    errors, broken = {}, []
    for rtol in TOLERANCES:
        mine = [found[rtol] for found in scenes.values()]
        good = [row for row in mine if row["status"] == "periodic"]
        quantiles = {}
        for name in MEASURES:
            off = np.array([float(row[f"{name}_error"]) for row in good])
            off = off[np.isfinite(off)]
            shares = np.quantile(off, [0.5, 0.95, 1.0]).tolist() if off.size else [np.nan] * 3
            quantiles[name] = (*shares, off.size)
        errors[rtol] = len(good), len(mine), quantiles
        limit = float(agreement(jnp.asarray(rtol)))
        for row in good:
            beyond = [float(row[f"{k}_error"]) - float(row[f"{k}_noise"]) for k in MEASURES]
            worst = np.nanmax([0.0, *beyond])
            if worst > limit:
                broken.append(f"OFF {rtol} {worst} {row['scene']}")
    for scene, found in scenes.items():
        usable = [found[rtol]["status"] == "periodic" for rtol in TOLERANCES]
        if usable[0] and not all(usable):
            broken.append(f"WORSE {[found[rtol]['status'] for rtol in TOLERANCES]} {scene}")
    ratios = ratios_of(rows)
    if ratios.size and np.mean(ratios > 1) > BEYOND:
        broken.append(f"UNBOUNDED {100 * np.mean(ratios > 1):.1f} % of {ratios.size} gradients")
    shares = np.quantile(ratios, [0.5, 0.95, 0.99, 1.0]) if ratios.size else np.full(4, np.nan)
    counts = {k: periods.count(k) for k in dict.fromkeys(periods)}
    return Judgement(len(scenes), counts, errors, tuple(shares.tolist()), broken)


def ratios_of(rows: Sequence[Row]) -> np.ndarray:
    """Return the errors of all gradients, less the noise of the differences, relative to the
    `gradient_disagreement`."""
    found = [
        (float(row[f"{name}_error"]), float(row[f"{name}_noise"]), row["gradient_disagreement"])
        for row in rows
        if row["status"] == "periodic"
        for name in MEASURES
    ]
    off, noise, said = np.array(found, dtype=float).reshape(-1, 3).T
    ratios = np.maximum(off - noise, 0.0) / said
    return ratios[np.isfinite(ratios)]
