"""Tests where solvers are valid: scenes at and between the limits of every config key.

1. Law: force and derivatives of every scene's contact law must be finite at all
   penetrations from zero to far beyond the largest possible. The equation of motion and its
   derivatives with respect to state and design must be finite too.
2. Motion: every scene is simulated from rest and must end in a finite result or a named status.
3. Truth: a sample of the periodic results is closed again from the same state by dopri8 at 1e-12,
   and by SciPy's DOP853 along that orbit. The relative deviation of mean and peak
   force must be below `ALLOWED` times the tolerance.

`scenes.py` draws the scenes, `checks.py` checks each of them.
"""

import dataclasses
import os
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments._common.driver import Run
from experiments._common.style import (
    BLACK,
    BLUE,
    COLORS,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    sheet,
)
from experiments._common.tables import Row, print_record
from experiments.extremes import checks as ask
from experiments.extremes.checks import ALLOWED, FEW, Case
from experiments.extremes.scenes import Kind, cloud, grid, row_of


@dataclasses.dataclass(frozen=True)
class Size:
    """Numbers of scenes.

    `kinds`: each kind with its number of random scenes; `gridded`: whether the grid is added;
    `references`, `scipy`: number of scenes of each kind that go to the reference (a
    third where the reference needs its own program) and to SciPy.
    """

    kinds: tuple[tuple[Kind, int], ...]
    gridded: bool
    references: int
    scipy: int


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
)
QUICK = Size(
    kinds=((Kind(), 40),),
    gridded=False,
    references=0,
    scipy=3,
)
COLOURS = {
    "periodic": BLUE,
    "not_settled": SKY,
    "idle": "#999999",
    "passed_through": "#F0E442",
    "too_deep": ORANGE,
    "inaccurate": "#882255",
    "unresolved": PURPLE,
    "stalled": GREEN,
    "solver_failed": VERMILION,
    "non_finite": BLACK,
}

# Maximum number of solvers shown; those with most scenes come first.
MOST = 7
_EDGES = np.logspace(-2, 8, 11)
MARKS = "os^vD<>"


def atlas(rows: list[Row]) -> Figure:
    """Draw the outcomes of each solver, and the deviations from the reference."""
    counts = Counter(row["method"] for row in rows)
    groups = [name for name, _ in counts.most_common(MOST)]
    columns = min(3, len(groups) + 1)
    lines = -(-(len(groups) + 1) // columns)
    figure, axes = sheet(4.0 * columns, 3.4 * lines, lines, columns)
    axes = axes.ravel()
    present = [name for name in COLOURS if any(row["status"] == name for row in rows)]
    for ax, group in zip(axes, groups, strict=False):
        outcomes(ax, group, [row for row in rows if row["method"] == group], present)
    ax = axes[len(groups)]
    deviations(ax, groups, [row for row in rows if row.get("reference") == "closed"])
    ax.legend(fontsize=5.5)
    for ax in axes[len(groups) + 1 :]:
        ax.axis("off")
    for ax in axes:
        ax.tick_params(labelsize=7)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    return figure


def outcomes(ax: Axes, group: str, mine: list[Row], present: list[str]) -> None:
    """Draw the share of each outcome over the number of contact oscillations in a mesh period.

    `group`: method of the solver; `mine`: rows of this solver; `present`:
    outcomes to draw."""
    bins = len(_EDGES) - 1
    swings = np.clip([row["swings"] for row in mine], _EDGES[0], _EDGES[-1] * 0.999)
    place = np.digitize(swings, _EDGES) - 1
    total = np.bincount(place, minlength=bins)
    below = np.zeros(bins)
    for name in present:
        hit = np.array([row["status"] == name for row in mine])
        share = np.bincount(place[hit], minlength=bins) / np.maximum(total, 1)
        ax.bar(
            _EDGES[:-1], share, bottom=below, width=np.diff(_EDGES), align="edge",
            color=COLOURS[name], edgecolor="white", linewidth=0.3,
            label=name.replace("_", " "),
        )  # fmt: skip
        below += share
    ax.set_xscale("log")
    ax.set_xlim(_EDGES[0], _EDGES[-1])
    ax.set_ylim(0, 1)
    ax.set_title(f"{group} ({len(mine)} scenes)", fontsize=9)
    ax.set_xlabel("oscillations of the contact in a mesh period", fontsize=8)
    ax.set_ylabel("share of scenes", fontsize=8)


def deviations(ax: Axes, groups: list[str], judged: list[Row]) -> None:
    """Draw the deviation from the reference over the tolerance by solver, with the allowed
    limit."""
    for mark, colour, group in zip(MARKS, COLORS, groups, strict=False):
        mine = [row for row in judged if row["method"] == group]
        if mine:
            ax.loglog(
                [row["solver.rtol"] for row in mine],
                [max(row["mean_off"], row["peak_off"], 1e-13) for row in mine],
                mark, ms=4, mfc="none", color=colour,
                label=group,
            )  # fmt: skip
    line = np.array([1e-12, 1e-2])
    ax.loglog(line, ALLOWED * line, "k-", lw=1, label=f"{ALLOWED:g} × tolerance")
    ax.set_xlabel("tolerance", fontsize=8)
    ax.set_ylabel("relative deviation of mean or peak force", fontsize=8)
    ax.set_title(f"deviation from the reference ({len(judged)} scenes)", fontsize=9)
    ax.grid(alpha=0.3)


def run(job: Run) -> bool:
    """Draw and check all scenes, one per core at a time; write a row per scene after every stage.

    Returns whether all promises are kept."""
    size = QUICK if job.quick else FULL
    cases = drawn(size)
    job.say(f"{len(cases)} scenes")
    checks = {"law": ask.law(cases), "equation": ask.equation(cases, seed=1)}
    job.say(f"law and equation: {checks}")

    def each(what: str, task: Callable[[Case], None], chosen: list[Case]) -> None:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(task, chosen))
        job.say(f"{what}: {len(chosen)}")
        job.csv("extremes.csv", [case.row for case in cases])

    # The program of the next kind compiles while scenes of this kind are simulated.
    first = [next(case for case in cases if case.kind == kind) for kind, _ in size.kinds]
    for number, (kind, _) in enumerate(size.kinds):
        for case in first[number : number + 2]:
            ask.prepare(case)
        each(kind.label, ask.simulate, [case for case in cases if case.kind == kind])
    picked, compared = samples(size, cases)
    each("reference", ask.refine, picked)
    each("scipy", ask.by_scipy, compared)
    rows = [case.row for case in cases]
    found = summary(rows, checks)
    job.json("extremes.json", found)
    job.figure("extremes.png", atlas(rows))
    print_record(found)
    return not any(found[key] for key in ("unnamed", "not_finite", "beyond_allowed"))


def drawn(size: Size) -> list[Case]:
    """Draw the scenes of all kinds; the grid belongs to the first kind."""
    cases: list[Case] = []
    for kind, count in size.kinds:
        configs = [*cloud(kind, count, seed=0)]
        if size.gridded and kind == Kind():
            configs += grid(kind)
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
        good = [case for case in cases if case.kind == kind and case.row["status"] == "periodic"]
        if kind.lobes in (4, 5, 6):
            continue
        own = (kind.lobes, kind.family, kind.scene) != (3, "cic", "gear")
        picked += good[: size.references // (3 if own else 1)]
        if kind.scene != "pump":  # tests/planar.py has its independent equation.
            compared += [case for case in good if case.row["swings"] < FEW][: size.scipy]
    return picked, compared


def summary(rows: list[Row], checks: dict[str, Any]) -> dict[str, Any]:
    """Return counts of each status, the worst deviations, and counts of broken promises."""

    def worst(key: str, chosen: list[Row]) -> float | None:
        return max((row[key] for row in chosen if key in row), default=None)

    table = {}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        mine = [row for row in rows if row["kind"] == kind]
        closed = [row for row in mine if row.get("reference") == "closed"]
        table[kind] = {
            "scenes": len(mine),
            "status": dict(Counter(row["status"] for row in mine)),
            "longest_s": worst("seconds", mine),
            "references": dict(Counter(row["reference"] for row in mine if "reference" in row)),
            "worst_share_of_allowed": worst("share_of_allowed", closed),
        }
    counts = [checks["law"], *checks["equation"].values()]
    judged = [row for row in rows if row.get("reference") == "closed"]
    return {
        "scenes": len(rows),
        "kinds": table,
        "checks": checks,
        "unnamed": sum(not row["named"] for row in rows),
        "not_finite": sum(count["not_finite"] for count in counts),
        "compared": len(judged),
        "beyond_allowed": sum(row["share_of_allowed"] > 1 for row in judged),
        "scipy": {
            "compared": sum("scipy_end" in row for row in rows),
            "worst_end": worst("scipy_end", rows),
            "worst_mean_off": worst("scipy_mean_off", rows),
        },
    }
