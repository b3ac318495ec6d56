"""Compares reported gradients of random designs and scenes with differences of orbits.

A *pair* here is a random design (CIC with two and three lobes, arc, involute) in a random scene
(speed, load, backlash, gear; half of the scenes with friction, motor and gas). The study keeps
pairs that settle on a periodic orbit, most of them with periods above one and some above four. It
evaluates each pair at rtol 1e-8, 1e-9 and 1e-10. The derivatives of mean, peak and RMS force along
one direction of the design are compared with central differences of the forces of orbits closed
with another method (dopri8) at 1e-14.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments._common.driver import Run
from experiments._common.scenes import CIC, FORCES, MEASURES
from experiments._common.shooting import closed, differentiated, forces_near
from experiments._common.simulation import evaluator_of
from experiments._common.style import COLORS, sheet
from experiments._common.tables import Row, show
from rootsopt.config import load
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import agreement
from rootsopt.response.evaluation import Evaluation, Evaluator

TOLERANCES = (1e-8, 1e-9, 1e-10)

# Further columns.
FACTS = "residual", "floquet_multiplier", "gradient_disagreement", "orbit_elements", "seconds"

# Greatest relative step of the central differences, and number of steps, each half of the one
# before. Longer steps pass the grazing of orbits that almost touch once more.
STEP, LEVELS = 4e-5, 6

# Changes of the design parameters, relative to their values, along the direction of the
# differences.
WAY = np.array([1.0, -0.7, 0.8])

# Share of gradients that may err by more than their check states.
BEYOND = 0.01

# Share of pairs with a period above one below which pairs of period one are discarded.
SHARE = 0.6

# Number of pairs of a reduced run.
QUICK_COUNT = 4
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

# Kind of pairs with random friction, motor and gas. Half of all pairs are of this kind.
FULL = "cic, friction, motor and gas"

# Kind of pairs whose orbits last five mesh periods or more. Of the scenes drawn for it, about one
# in twenty has such an orbit; the others are left out.
LONG = "cic, long periods"

# Maximum number of scenes of the kind `LONG` drawn for each pair wanted.
PATIENCE = 60


def pairs(seed: int, kind: str) -> Iterator[list[str]]:
    """Yield random pairs of one `kind` without end, each as overrides of configs/cic_drawn.yaml."""
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


def differences(evaluator: Evaluator, found: Evaluation) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate the forces along `WAY`, in relative steps.

    Returns the derivatives (3,) in N per unit of relative change, and their estimated errors (3,).
    Both are NaN where an orbit does not close."""
    design = np.array(list(found.design.values()))
    period = int(found.steady_state["period"])

    def pair(change: float) -> RotorPair:
        return evaluator.pair(design * (1 + change * WAY[: len(design)]))

    orbit = closed(pair(0.0), found.state, period)
    return differentiated(forces_near(pair, orbit, period), STEP, LEVELS)


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
) -> Iterator[Row]:
    """Yield the evaluations and their errors, one row per tolerance.

    Errors are relative to the greatest term of the derivative."""
    usable = [one for one in found.values() if one.usable]
    size = np.max(np.abs(slopes_of(usable[-1])), axis=1)
    truth, noise = differences(evaluator, usable[-1])
    for rtol, one in found.items():
        row: Row = {"kind": kind, "rtol": rtol, "status": one.status.label}
        row |= {"period": one.steady_state.get("period"), "scene": " ".join(overrides)}
        facts = one.steady_state | one.statistics
        row |= {name: facts.get(name) for name in FACTS}
        if one.usable:
            errors = np.abs(np.sum(slopes_of(one), axis=1) - truth) / size
            for k, measure in enumerate(MEASURES):
                row[measure], row[f"{measure}_error"] = one.response[measure], errors[k]
                row[f"{measure}_noise"] = noise[k] / size[k]
        yield row


def wanted_of(quick: bool, count: int) -> dict[str, int]:
    """Return the number of pairs of each kind. Half of the pairs are of the kind `FULL`.

    `count`: number of pairs of all kinds except `LONG`, which a reduced run omits."""
    if quick:
        return {FULL: count}
    kinds = [kind for kind in KINDS if kind not in (FULL, LONG)]
    share = count // 2 // len(kinds)
    return {FULL: count - share * len(kinds)} | dict.fromkeys(kinds, share) | {LONG: count // 20}


def pairs_of_kind(
    kind: str, wanted: int, seed: int, say: Callable[[str], None]
) -> Iterator[list[Row]]:
    """Yield the rows of each pair of a `kind`, until `wanted` pairs have been measured."""
    lively = plain = 0
    for number, overrides in enumerate(pairs(seed, kind)):
        if lively + plain >= wanted or (kind == LONG and number > PATIENCE * wanted):
            break
        # Wait for rare longer periods, but only for a limited number of scenes.
        waiting = number < 6 * wanted and kind != FULL and plain >= (1 - SHARE) * wanted
        least = 5 if kind == LONG else 2 if waiting else 1
        evaluator = evaluator_of(load(CIC, overrides), give_up_early=True)
        series = evaluated(evaluator)
        first = next(series)
        period = int(first[1].steady_state.get("period", 0)) if first[1].usable else 0
        if period >= least:
            new = [*rows_of(evaluator, kind, overrides, dict([first, *series]))]
            lively, plain = lively + (period > 1), plain + (period == 1)
            found = {row["rtol"]: (row["status"], row.get("mean_force_N_error")) for row in new}
            say(f"{kind} {lively} {plain} period {period} {found}")
            yield new


def errors_of(rows: Sequence[Row]) -> Figure:
    """Draw the gradient error over the estimate of its check, and its distribution by tolerance."""
    picture, ((left, right),) = sheet(10, 4.2, 1, 2)
    for rtol, color, marker in zip(TOLERANCES, COLORS[:3], "os^", strict=True):
        good = [r for r in rows if r["rtol"] == rtol and r["status"] == "periodic"]
        off = np.array([[r[f"{name}_error"] for name in MEASURES] for r in good]).ravel()
        said = np.repeat([r["gradient_disagreement"] for r in good], len(MEASURES))
        kept = np.isfinite(off)
        left.loglog(said[kept], off[kept], marker, color=color, ms=3, alpha=0.5, label=f"{rtol:g}")
        for name, style in zip(FORCES, ("-", "--"), strict=True):
            errors = np.sort([r[f"{name}_error"] for r in good])
            errors = errors[np.isfinite(errors)]
            share = 100 * (np.arange(errors.size) + 1) / errors.size
            label = f"{name.split('_')[0]}, rtol {rtol:g}"
            right.semilogx(errors, share, style, color=color, label=label)
    left.plot([1e-9, 1e-2], [1e-9, 1e-2], "k:", lw=1, label="equal")
    left.set(
        xlabel="gradient_disagreement (relative)",
        ylabel="error of the gradients of mean, peak, RMS\nagainst differences (relative)",
        title="Check against error",
    )
    left.legend(title="solver.rtol")
    right.set(
        xlabel="error of the gradient against differences (relative)",
        ylabel="share of design–scene pairs below (%)",
        title="Errors, mean and peak force",
        ylim=(0, 100),
    )
    right.legend(fontsize=8)
    return picture


def run(job: Run) -> bool:
    """Measure random pairs; write three rows per pair, one per tolerance, after each pair.

    A reduced run measures four pairs of one kind. Returns whether all promises are kept."""
    wanted = wanted_of(job.quick, QUICK_COUNT if job.quick else job.options.count)
    rows: list[Row] = []
    for kind, count in wanted.items():
        for new in pairs_of_kind(kind, count, job.options.seed, job.say):
            rows += new
            job.csv("gradients.csv", rows)
    job.figure("gradients.png", errors_of(rows))
    table, broken = judge(rows)
    show("Largest error of the gradients of mean, peak and RMS", table)
    print(*broken, f"{len(broken)} promises broken", sep="\n")
    return not broken


def judge(rows: Sequence[Row]) -> tuple[list[Row], list[str]]:
    """Return the table of errors by tolerance, and a line for each broken promise.

    Promises are broken by a gradient whose error exceeds the limit of its check, by a pair that has
    a result at one tolerance but none at a finer tolerance, and by too many errors above the
    `gradient_disagreement`. The noise of the differences is no error."""
    table, broken = [], []
    ratios: list[float] = []
    for rtol in TOLERANCES:
        mine = [row for row in rows if row["rtol"] == rtol]
        good = [row for row in mine if row["status"] == "periodic"]
        off, noise = (
            np.reshape([[row[f"{name}_{what}"] for name in MEASURES] for row in good], (-1, 3))
            for what in ("error", "noise")
        )
        limit = float(agreement(jnp.asarray(rtol)))
        for row, beyond in zip(good, np.maximum(off - noise, 0.0), strict=True):
            ratios += (beyond / row["gradient_disagreement"]).tolist()
            if np.nanmax([0.0, *beyond]) > limit:
                broken.append(f"OFF {rtol} {np.nanmax(beyond)} {row['scene']}")
        worst = np.nanmax(off, axis=1)
        worst = worst[np.isfinite(worst)]
        shares = np.quantile(worst, [0.5, 0.75, 0.95, 1.0]).tolist() if worst.size else [np.nan] * 4
        median, most, nearly_all, greatest = shares
        table.append(
            {
                "rtol": f"{rtol:g}",
                "pairs": len(mine),
                "periodic": len(good),
                "median": median,
                "75_%_below": most,
                "95_%_below": nearly_all,
                "maximum": greatest,
            }
        )
    for scene in dict.fromkeys(row["scene"] for row in rows):
        ends = [row["status"] for row in rows if row["scene"] == scene]
        if ends[0] == "periodic" and set(ends) != {"periodic"}:
            broken.append(f"WORSE {ends} {scene}")
    known = np.array(ratios)[np.isfinite(ratios)]
    if np.sum(known > 1) > BEYOND * known.size:
        broken.append(f"UNBOUNDED {np.mean(known > 1):.1%} of {known.size} gradients")
    return table, broken
