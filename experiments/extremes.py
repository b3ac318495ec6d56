"""Where solvers and precisions hold: scenes at and between the limits of every key.

    python experiments/extremes.py [-o DIR] [--quick] [--jobs 2]

1. Law: force and derivatives of every scene's contact law from no penetration to far beyond any,
   and the equation of motion with its derivatives in state and design, must be finite in either
   precision.
2. Motion: every scene is simulated from rest and must end in a finite result or in a named status.
3. Truth: a sample of those that ended periodic is closed again from the same state by dopri8 at
   1e-12 in double precision, and by SciPy's DOP853 along that orbit. The relative deviation of
   mean and peak force must be below `ALLOWED` times the tolerance.
4. Public path: a sample goes through `Evaluator` from config to record, some with up to 1000
   revolutions.

Scenes are drawn by `extremes_parts/scenes.py`. Writes extremes.csv (a row for each scene),
extremes.json (counts and worst deviations) and extremes.png; the exit status is 3 if a promise is
broken.
"""

import argparse
import dataclasses
import itertools
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

# As the commands do, before equinox is first imported.
os.environ.setdefault("EQX_ON_ERROR", "off")

from rootsopt.cli import use_cache, use_float64

use_float64()

from experiments.extremes_parts import checks as ask  # noqa: E402
from experiments.extremes_parts.checks import ALLOWED, FEW, HORIZON, SINGLE, Case  # noqa: E402
from experiments.extremes_parts.figure import draw  # noqa: E402
from experiments.extremes_parts.scenes import Kind, cloud, grid, row_of  # noqa: E402
from rootsopt import files  # noqa: E402
from rootsopt.config import Config  # noqa: E402


@dataclasses.dataclass(frozen=True)
class Study:
    """How many scenes: `kinds` with the number of random ones, whether the grid is added, how
    many of each kind go to the reference (a third of that where it needs a program of its own), to
    SciPy and through the `Evaluator`, and how many with the long horizon (mesh periods)."""

    kinds: tuple[tuple[Kind, int], ...]
    gridded: bool
    references: int
    scipy: int
    evaluated: int
    long: int
    horizon: int = 3000


FULL = Study(
    kinds=(
        (Kind(), 2500),
        (Kind(precision="float32"), 2500),
        (Kind("kvaerno5"), 200),
        (Kind("dopri8"), 300),
        (Kind("dopri5"), 150),
        (Kind("kvaerno3"), 100),
        (Kind("kvaerno5", "float32"), 100),
        (Kind(fidelity="map"), 300),
        (Kind(fidelity="map", precision="float32"), 150),
        (Kind(lobes=2), 250),
        (Kind(lobes=4), 120),
        (Kind(lobes=5), 120),
        (Kind(lobes=6), 120),
        (Kind(family="ee"), 250),
        (Kind(scene="plain"), 120),
        (Kind(scene="pump"), 150),
        (Kind("kvaerno5", scene="pump"), 40),
    ),
    gridded=True,
    references=24,
    scipy=4,
    evaluated=60,
    long=10,
)
QUICK = Study(
    kinds=((Kind(fidelity="linear"), 40),),
    gridded=False,
    references=0,
    scipy=3,
    evaluated=0,
    long=0,
)


def run(
    study: Study, jobs: int, say: Callable[[str], None], keep: Callable[[list[Case]], None]
) -> tuple[list[Case], dict[str, Any]]:
    """All scenes with their rows, kept after every stage, and the finite values of law and
    equation."""
    cases: list[Case] = []
    for kind, count in study.kinds:
        configs: Iterable[Config] = cloud(kind, count, seed=0)
        if study.gridded and kind == Kind():
            configs = itertools.chain(configs, grid(kind))
        cases += [
            Case(kind, c, {"kind": kind.label, **dataclasses.asdict(kind), **row_of(c)})
            for c in configs
        ]
    say(f"{len(cases)} scenes")
    checks = {"law": ask.law(cases), "equation": ask.equation(cases, seed=1)}
    say(f"law and equation: {checks}")

    def each(what: str, task: Callable[[Case], None], chosen: list[Case]) -> None:
        began = time.perf_counter()
        with ThreadPoolExecutor(jobs) as pool:
            for done, _ in enumerate(pool.map(task, chosen), 1):
                if done % 200 == 0:
                    say(f"{what}: {done} of {len(chosen)}")
        say(f"{what}: {len(chosen)} in {time.perf_counter() - began:.0f} s")

    # The next kind's program is made while scenes of this one are simulated.
    first = [next(case for case in cases if case.kind == kind) for kind, _ in study.kinds]
    for number, (kind, _) in enumerate(study.kinds):
        for case in first[number : number + 2]:
            ask.prepare(case)
        each(kind.label, ask.simulate, [case for case in cases if case.kind == kind])
        keep(cases)
    picked: list[Case] = []
    compared: list[Case] = []
    for kind, _ in study.kinds:
        shape = kind.lobes, kind.family, kind.fidelity, kind.scene
        if kind.lobes in (4, 5, 6):
            continue
        mine = [case for case in cases if case.kind == kind]
        good = [case for case in mine if case.row["status"] == "periodic"]
        own = shape != (3, "cic", "search", "gear")
        if kind.fidelity != "linear":  # Whose jumps no reference gets over.
            picked += good[: study.references // (3 if own else 1)]
        if kind.scene != "pump":  # Whose independent equation is that of tests/planar.py.
            compared += [case for case in good if case.row["swings"] < FEW][: study.scipy]
    each("reference", ask.refine, picked)
    keep(cases)
    each("scipy", ask.by_scipy, compared)
    for kind, _ in study.kinds[: 2 if study.evaluated else 0]:
        mine = [case for case in cases if case.kind == kind][: study.evaluated]
        for place, case in enumerate(mine):
            horizon = study.horizon if place < study.long else 8 * HORIZON
            ask.evaluate(case, ask.evaluator_of(case.config, horizon))
    return cases, checks


def summary_of(cases: list[Case], checks: dict[str, Any]) -> dict[str, Any]:
    """Counts of each status, worst deviations, and what broke a promise."""
    rows = [case.row for case in cases]
    kinds = dict.fromkeys(row["kind"] for row in rows)
    judged = [row for row in rows if row.get("reference") == "closed"]
    table = {}
    for kind in kinds:
        mine = [row for row in rows if row["kind"] == kind]
        closed = [row for row in judged if row["kind"] == kind]
        table[kind] = {
            "scenes": len(mine),
            "status": dict(Counter(row["status"] for row in mine)),
            "longest_s": max(row["seconds"] for row in mine),
            "compared": len(closed),
            "reference_not_closed": sum(
                row["kind"] == kind and row.get("reference") == "not closed" for row in rows
            ),
            "beyond_allowed": sum(row["share_of_allowed"] > 1 for row in closed),
            "worst_share_of_allowed": max((r["share_of_allowed"] for r in closed), default=None),
            "worst_mean_off": max((row["mean_off"] for row in closed), default=None),
            "worst_peak_off": max((row["peak_off"] for row in closed), default=None),
        }
    counts = [*checks["law"].values(), *checks["equation"].values()]
    scipy = [row for row in rows if "scipy_end" in row]
    public = [row for row in rows if "evaluator_status" in row]
    return {
        "scenes": len(rows),
        "kinds": table,
        "checks": checks,
        "unnamed": sum(not row["named"] for row in rows),
        "not_finite": sum(count["not_finite"] for count in counts),
        "compared": len(judged),
        "beyond_allowed": sum(row["share_of_allowed"] > 1 for row in judged),
        "scipy": {
            "compared": len(scipy),
            "worst_end": max((row["scipy_end"] for row in scipy), default=None),
            "worst_mean_off": max((row["scipy_mean_off"] for row in scipy), default=None),
        },
        "evaluator": {
            "scenes": len(public),
            "status": dict(Counter(row["evaluator_status"] for row in public)),
            "longest_s": max((row["evaluator_seconds"] for row in public), default=None),
            "most_mesh_periods": max((row["evaluator_periods"] for row in public), default=None),
        },
    }


def main() -> int:
    arguments = argparse.ArgumentParser(description="Where solvers and precisions hold.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/extremes"))
    arguments.add_argument("--quick", action="store_true", help="a few scenes of one kind")
    arguments.add_argument("--jobs", type=int, default=2, help="scenes simulated side by side")
    options = arguments.parse_args()
    use_cache()
    folder = files.ResultFolder(options.output)
    began = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - began:7.0f} s  {text}", flush=True)

    def keep(cases: list[Case]) -> None:
        keys = list(dict.fromkeys(key for case in cases for key in case.row))
        columns = {key: [case.row.get(key, "") for case in cases] for key in keys}
        folder.write_csv("extremes.csv", columns)

    cases, checks = run(QUICK if options.quick else FULL, options.jobs, say, keep)
    keep(cases)
    summary = summary_of(cases, checks)
    folder.write_json("extremes.json", summary)
    draw([case.row for case in cases], ALLOWED, SINGLE, options.output / "extremes.png")
    for kind, found in summary["kinds"].items():
        print(kind, found)
    broken = {key: summary[key] for key in ("unnamed", "not_finite", "beyond_allowed")}
    print(broken)
    return 3 if any(broken.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
