"""Tests where solvers are valid: scenes at and between the limits of every config key.

1. Law: force and derivatives of every scene's contact law must be finite at all
   penetrations from zero to far beyond the largest possible. The equation of motion and its
   derivatives with respect to state and design must be finite too.
2. Motion: every scene is simulated from rest and must end in a finite result or a named status.
3. Truth: a sample of the periodic results is closed again from the same state by dopri8 at 1e-12,
   and by SciPy's DOP853 along that orbit. The relative deviation of mean and peak
   force must be below `ALLOWED` times the tolerance.
4. Public path: a sample goes through the evaluator from config to record, some with up to 1000
   revolutions.

`scenes.py` draws the scenes, `checks.py` checks each of them.
"""

import dataclasses
import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from experiments.extremes import checks as ask
from experiments.extremes.checks import FEW, HORIZON, Case
from experiments.extremes.scenes import Kind, cloud, grid, row_of
from rootsopt.config import Config

Say = Callable[[str], None]
Keep = Callable[[list[Case]], None]


@dataclasses.dataclass(frozen=True)
class Size:
    """Numbers of scenes.

    `kinds`: each kind with its number of random scenes; `gridded`: whether the grid is added;
    `references`, `scipy`, `evaluated`: number of scenes of each kind that go to the reference (a
    third where the reference needs its own program), to SciPy, and through the evaluator; `long`:
    number of evaluated scenes with the long transient `horizon` (mesh periods).
    """

    kinds: tuple[tuple[Kind, int], ...]
    gridded: bool
    references: int
    scipy: int
    evaluated: int
    long: int
    horizon: int = 3000


FULL = Size(
    kinds=(
        (Kind(), 2500),
        (Kind("dopri8"), 300),
        (Kind(lobes=2), 250),
        (Kind(lobes=4), 120),
        (Kind(lobes=5), 120),
        (Kind(lobes=6), 120),
        (Kind(family="ee"), 250),
        (Kind(scene="plain"), 120),
        (Kind(scene="pump"), 150),
    ),
    gridded=True,
    references=24,
    scipy=4,
    evaluated=60,
    long=10,
)
QUICK = Size(
    kinds=((Kind(), 40),),
    gridded=False,
    references=0,
    scipy=3,
    evaluated=0,
    long=0,
)


@dataclasses.dataclass(frozen=True)
class Results:
    """All scenes with their rows, and the counts of non-finite values of law and equation."""

    cases: list[Case]
    checks: dict[str, Any]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Return a row per scene."""
        return [case.row for case in self.cases]


def run(
    quick: bool,
    jobs: int = 2,
    say: Say = lambda text: None,
    keep: Keep = lambda cases: None,
) -> Results:
    """Draw and check all scenes, `jobs` at a time; call `keep` with all scenes after every
    stage."""
    size = QUICK if quick else FULL
    cases = drawn(size)
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

    # The program of the next kind compiles while scenes of this kind are simulated.
    first = [next(case for case in cases if case.kind == kind) for kind, _ in size.kinds]
    for number, (kind, _) in enumerate(size.kinds):
        for case in first[number : number + 2]:
            ask.prepare(case)
        each(kind.label, ask.simulate, [case for case in cases if case.kind == kind])
        keep(cases)
    picked, compared = samples(size, cases)
    each("reference", ask.refine, picked)
    keep(cases)
    each("scipy", ask.by_scipy, compared)
    for kind, _ in size.kinds[: 2 if size.evaluated else 0]:
        mine = [case for case in cases if case.kind == kind][: size.evaluated]
        for place, case in enumerate(mine):
            horizon = size.horizon if place < size.long else 8 * HORIZON
            ask.evaluate(case, ask.evaluator_of(case.config, horizon))
    keep(cases)
    return Results(cases, checks)


def drawn(size: Size) -> list[Case]:
    """Draw the scenes of all kinds; the grid belongs to the first kind."""
    cases: list[Case] = []
    for kind, count in size.kinds:
        configs: Iterable[Config] = cloud(kind, count, seed=0)
        if size.gridded and kind == Kind():
            configs = itertools.chain(configs, grid(kind))
        cases += [
            Case(kind, c, {"kind": kind.label, **dataclasses.asdict(kind), **row_of(c)})
            for c in configs
        ]
    return cases


def samples(size: Size, cases: list[Case]) -> tuple[list[Case], list[Case]]:
    """Choose periodic scenes. Return the scenes for the reference, and the scenes for SciPy."""
    picked: list[Case] = []
    compared: list[Case] = []
    for kind, _ in size.kinds:
        shape = kind.lobes, kind.family, kind.scene
        if kind.lobes in (4, 5, 6):
            continue
        mine = [case for case in cases if case.kind == kind]
        good = [case for case in mine if case.row["status"] == "periodic"]
        own = shape != (3, "cic", "gear")
        picked += good[: size.references // (3 if own else 1)]
        if kind.scene != "pump":  # tests/planar.py has its independent equation.
            compared += [case for case in good if case.row["swings"] < FEW][: size.scipy]
    return picked, compared


def summary(results: Results) -> dict[str, Any]:
    """Return counts of each status, the worst deviations, and counts of broken promises."""
    rows, checks = results.rows, results.checks
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
    counts = [checks["law"], *checks["equation"].values()]
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
