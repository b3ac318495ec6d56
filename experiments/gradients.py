"""How right are reported gradients? Random designs and scenes against differences of orbits.

    python experiments/gradients.py [-o DIR] [--count 200] [--seed 0] [--part K/N] [--quick]
    python experiments/gradients.py -o DIR --draw

Draws designs (CIC with two and three lobes, arc and involute) and scenes (speed, load, backlash,
gear, with gas and friction or a motor), keeps those that settle on a periodic orbit, as many as
possible with periods beyond one and some beyond four, and evaluates each at rtol 1e-8, 1e-9 and
1e-10. The derivatives of the mean and peak force are compared with central differences of the
forces of orbits closed with another method (dopri8) at 1e-12. Writes gradients_K.csv; `--draw`
draws gradients.png from all parts and prints the table. Exit status 3 if a tolerance ends without a
result where a looser one has one, or a gradient is further off than its check promises.
"""

import argparse
import csv
import dataclasses
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("EQX_ON_ERROR", "off")

from rootsopt.cli import use_float64

use_float64()

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from rootsopt import files  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.dynamics.flow import Integrator  # noqa: E402
from rootsopt.dynamics.steady import agreement, close_orbit, no_tangents  # noqa: E402
from rootsopt.evaluate import Evaluation, Evaluator  # noqa: E402
from rootsopt.model import Model  # noqa: E402

TOLERANCES = (1e-8, 1e-9, 1e-10)
MEASURES = ("mean_force_N", "peak_force_N")
STEP = 2e-5
"""Relative step of the differences: orbits are known to 1e-12, which leaves 1e-7."""
CLOSER = 1e-4
"""Disagreement with differences from which on these are taken again with a quarter of the step, and
extrapolated to step 0: close to a bifurcation forces bend."""
SHARE = 0.6
"""Share of pairs with a period beyond one that is aimed at."""
KINDS: dict[str, tuple[str, list[str]]] = {
    "cic, 3 lobes": ("cic", []),
    "cic, 2 lobes": ("cic", ["profile.lobes=2"]),
    "cic, gas and friction": (
        "cic",
        [
            "scene.load={pressure_difference_Pa: 2.0e4}",
            "contact.friction={static: 0.2, kinetic: 0.1, stiction_speed_mm_s: 100, "
            "friction_speed_mm_s: 1000}",
        ],
    ),
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
LONG = "cic, long periods"
"""Of this kind only orbits of five periods or more are kept. One pair in twenty is wanted, from
livelier scenes; the draw ends after `PATIENCE` scenes for each pair wanted."""
PATIENCE = 60


def pairs(seed: int, kind: str) -> Iterator[list[str]]:
    """Endless overrides of configs/cic.yaml of one kind."""
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
        if "scene.load" in "".join(fixed):
            values.pop("scene.load.torque_N_m")
        yield [*(f"{key}={value}" for key, value in values.items()), *fixed]


@eqx.filter_jit
def forces(model: Model, design, state, period, how: Integrator):
    """(mean, peak) force of the closed orbit, its residual and whether it was integrated."""
    pair = model.pair(design)
    orbit = close_orbit(pair, no_tangents(pair), state, period, how, check=False)
    return jnp.stack([orbit.response[0], orbit.response[2]]), orbit.residual, orbit.flow.solved


def differences(evaluator: Evaluator, found: Evaluation, step: float = STEP) -> np.ndarray:
    """Derivatives (2, d) of mean and peak force by central differences of a relative `step`, NaN
    where an orbit does not close."""
    how = Integrator("dopri8", jnp.asarray(1e-12), evaluator.orbit.max_steps)
    design = np.array(list(found.design.values()))
    period = jnp.asarray(found.steady_state["period"])
    columns = []
    for k, value in enumerate(design):
        sides = []
        for sign in (1, -1):
            moved = design.copy()
            moved[k] += sign * step * value
            state = jnp.asarray(found.state)
            force, residual, solved = forces(
                evaluator.model, jnp.asarray(moved), state, period, how
            )
            closed = bool(solved) and float(residual) < 1e-10
            sides.append(np.asarray(force) if closed else np.full(2, np.nan))
        columns.append((sides[0] - sides[1]) / (2 * step * value))
    return np.stack(columns, axis=1)


def evaluated(config: Config) -> Iterator[tuple[float, Evaluation]]:
    """The design at every tolerance, each from rest, the loosest first."""
    evaluator = Evaluator(config, survey=True)
    evaluator.prepared = True
    for rtol in TOLERANCES:
        evaluator.orbit = dataclasses.replace(evaluator.orbit, rtol=jnp.asarray(rtol))
        yield rtol, evaluator(series=False)


def errors(found: Evaluation, truth: np.ndarray) -> list[float]:
    """Greatest error of each gradient, relative to its greatest component."""
    slopes = [np.array(list(found.gradient[measure].values())) for measure in MEASURES]
    return [
        float(np.max(np.abs(slope - row)) / np.max(np.abs(row)))
        for slope, row in zip(slopes, truth, strict=True)
    ]


def rows_of(
    config: Config, kind: str, overrides: list[str], found: dict[float, Evaluation]
) -> list[dict[str, Any]]:
    """One row for each tolerance."""
    truth = None
    rows = []
    for rtol, one in found.items():
        row: dict[str, Any] = {"kind": kind, "rtol": rtol, "status": one.status.label}
        row |= {"period": one.steady_state.get("period"), "scene": " ".join(overrides)}
        for name in ("residual", "floquet_multiplier"):
            row[name] = one.steady_state.get(name)
        for name in ("gradient_disagreement", "orbit_defect", "orbit_steps", "seconds"):
            row[name] = one.statistics.get(name)
        if one.usable:
            if truth is None:
                evaluator = Evaluator(config, survey=True)
                truth = differences(evaluator, one)
                if max(errors(one, truth)) > CLOSER:
                    truth = (16 * differences(evaluator, one, STEP / 4) - truth) / 15
            for measure, error in zip(MEASURES, errors(one, truth), strict=True):
                row[measure], row[f"{measure}_error"] = one.response[measure], error
        rows.append(row)
    return rows


def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of the pairs of this part."""
    part, parts = (int(x) for x in options.part.split("/"))
    kinds = [kind for kind in KINDS if kind != LONG][: 1 if options.quick else None]
    wanted = {
        kind: options.count * (2 if k == 0 else 1) // (len(kinds) + 1)
        for k, kind in enumerate(kinds)
    }
    wanted[kinds[0]] += options.count - sum(wanted.values())
    if not options.quick:
        kinds.append(LONG)
        wanted[LONG] = options.count // 20
    rows: list[dict[str, Any]] = []
    for kind in kinds[part::parts]:
        lively = plain = 0
        for number, overrides in enumerate(pairs(options.seed, kind)):
            if lively + plain >= wanted[kind] or (
                kind == LONG and number > PATIENCE * wanted[kind]
            ):
                break
            # Rare longer periods are waited for, but not for ever.
            patient = number < 6 * wanted[kind]
            config = load("configs/cic.yaml", overrides)
            series = evaluated(config)
            first = next(series)
            scout = int(first[1].steady_state.get("period", 0)) if first[1].usable else 0
            if (
                not scout
                or (kind == LONG and scout < 5)
                or (scout == 1 and patient and plain >= (1 - SHARE) * wanted[kind])
            ):
                continue
            new = rows_of(config, kind, overrides, dict([first, *series]))
            lively, plain = lively + (scout > 1), plain + (scout == 1)
            rows += new
            say = {row["rtol"]: (row["status"], row.get("mean_force_N_error")) for row in new}
            print(kind, lively, plain, "period", new[0]["period"], say, flush=True)
            write(options, rows)
    return rows


def write(options: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    """Write the rows of a part."""
    options.output.mkdir(parents=True, exist_ok=True)
    keys = dict.fromkeys(key for row in rows for key in row)
    name = f"gradients_{options.part.replace('/', '_of_')}.csv"
    with open(options.output / name, "w", newline="") as file:
        writer = csv.DictWriter(file, keys)
        writer.writeheader()
        writer.writerows(rows)


def read(folder: Path) -> list[dict[str, Any]]:
    """Rows of all parts."""
    rows = []
    for path in sorted(folder.glob("gradients_*.csv")):
        with open(path, newline="") as file:
            rows += list(csv.DictReader(file))
    return rows


def judge(rows: list[dict[str, Any]]) -> int:
    """Print the table; the number of broken promises."""
    broken = 0
    scenes: dict[str, dict[float, dict[str, Any]]] = {}
    for row in rows:
        scenes.setdefault(row["scene"], {})[float(row["rtol"])] = row
    print(f"{len(scenes)} pairs")
    periods = sorted(int(float(found[TOLERANCES[0]]["period"])) for found in scenes.values())
    print("periods:", {k: periods.count(k) for k in dict.fromkeys(periods)})
    for rtol in TOLERANCES:
        mine = [found[rtol] for found in scenes.values()]
        good = [row for row in mine if row["status"] == "periodic"]
        print(f"rtol {rtol:g}: {len(good)} periodic of {len(mine)}", end="")
        for name in MEASURES:
            off = np.array([float(row[f"{name}_error"]) for row in good])
            off = off[np.isfinite(off)]
            shares = np.quantile(off, [0.5, 0.95, 1.0]) if off.size else [np.nan] * 3
            print(
                f"; {name}: median {shares[0]:.1e}, 95 % {shares[1]:.1e}, most {shares[2]:.1e}"
                f" ({off.size} compared)",
                end="",
            )
        print()
        limit = float(agreement(jnp.asarray(rtol)))
        for row in good:
            worst = np.nanmax([0.0, *(float(row[f"{name}_error"]) for name in MEASURES)])
            if worst > limit:
                broken += 1
                print("OFF", rtol, worst, row["scene"])
    for scene, found in scenes.items():
        usable = [found[rtol]["status"] == "periodic" for rtol in TOLERANCES]
        if usable[0] and not all(usable):
            broken += 1
            print("WORSE", [found[rtol]["status"] for rtol in TOLERANCES], scene)
    print(f"{broken} promises broken")
    return broken


def figure(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Error against the check, and its distribution at every tolerance."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    colors = ("#0072B2", "#D55E00", "#009E73")
    picture = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(picture)
    left, right = picture.subplots(1, 2)
    for rtol, color, marker in zip(TOLERANCES, colors, "os^", strict=True):
        good = [r for r in rows if float(r["rtol"]) == rtol and r["status"] == "periodic"]
        off = np.array([float(r["mean_force_N_error"]) for r in good])
        said = np.array([float(r["gradient_disagreement"]) for r in good])
        kept = np.isfinite(off)
        left.loglog(said[kept], off[kept], marker, color=color, ms=4, alpha=0.7, label=f"{rtol:g}")
        for name, style in zip(MEASURES, ("-", "--"), strict=True):
            errors = np.sort([float(r[f"{name}_error"]) for r in good])
            errors = errors[np.isfinite(errors)]
            share = 100 * (np.arange(errors.size) + 1) / errors.size
            what = name.split("_")[0]
            right.semilogx(errors, share, style, color=color, label=f"{what}, rtol {rtol:g}")
    left.plot([1e-9, 1e-2], [1e-9, 1e-2], "k:", lw=1, label="equal")
    left.set(
        xlabel="disagreement on halved steps (relative)",
        ylabel="error of the gradient of the mean\nagainst differences (relative)",
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
    for axes in (left, right):
        axes.grid(alpha=0.3)
    picture.savefig(folder / "gradients.png", dpi=files.DPI)


def main() -> int:
    """Run or draw."""
    parser = argparse.ArgumentParser(description="Errors of gradients")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/gradients"))
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--part", default="0/1", help="K/N: every N-th kind, from the K-th on")
    parser.add_argument("--quick", action="store_true", help="four pairs of one kind")
    parser.add_argument("--draw", action="store_true", help="table and figure from all parts")
    options = parser.parse_args()
    if options.quick:
        options.count = 4
    rows = read(options.output) if options.draw else measure(options)
    rows = read(options.output)
    if options.part == "0/1" or options.draw:
        figure(options.output, rows)
    return 3 if judge(rows) else 0


if __name__ == "__main__":
    sys.exit(main())
