"""Quiet and noisy orbits of both rotor pairs over speed, load, play and design.

    python experiments/bifurcation.py [-o DIR] [--quick]

Starts from rest and from five other states at a dozen values of a parameter, follows every
periodic orbit reached over the whole range, through folds and period doublings, stable or not
(`rootsopt.continuation`), and reports where a stable quiet orbit exists, where a stable noisy
one, and where both do. Writes bifurcation.csv, special_points.csv, bifurcation.json,
bifurcation_speed.png, bifurcation_scene.png and bifurcation_ranges.png.
"""

import argparse
import dataclasses
import itertools
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rootsopt.cli import use_cache, use_float64

use_float64()
use_cache()

import numpy as np  # noqa: E402
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.lines import Line2D  # noqa: E402
from matplotlib.patches import Patch  # noqa: E402
from matplotlib.ticker import FuncFormatter  # noqa: E402

from rootsopt import continuation, files  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.continuation import Branch, End, Kind, Steps  # noqa: E402
from rootsopt.errors import InputError  # noqa: E402
from rootsopt.evaluate import Evaluator  # noqa: E402
from rootsopt.plot import BLUE, VERMILION  # noqa: E402

STARTS = ((0.0, 0.0), (-0.2, -1.8), (-1.0, 0.0), (-3.0, 0.0), (0.8, 5.0), (-0.5, -8.0))
"""Scaled initial states tried at every value of the parameter."""
QUIET = 4.0
"""An orbit is quiet up to this peak force, in units of the force that carries the load at the pitch
radius; beyond, the flanks hammer."""
POINTS, FEWEST = 100, 25
"""Mesh periods in all points of a branch, and the least number of points allowed."""
LONGEST, DOUBLED = 4, 2
"""Longest orbit followed where a simulation reaches it, and where another one doubles to it."""
CELLS = 570
"""Parts of a range in which quiet and noisy orbits are looked for."""
LIVELY = ("scene.timing_gear.backlash_mm=0.2", "scene.timing_gear.damping_ratio=0.2")
SCENES = {
    "shipped": (),
    "livelier": LIVELY,
}
TITLES = {
    "shipped": "shipped scene: backlash 0.1 mm, gear damping 0.5",
    "livelier": "livelier scene: backlash 0.2 mm, gear damping 0.2",
}
SLOWEST = {"shipped": 300, "livelier": 3500}
"""Lowest speed (rpm). Slower, the livelier pair bounces so often within a mesh period that its
orbits can hardly be followed."""
NAMES = {
    "speed_rpm": "speed (rpm)",
    "torque_N_m": "load torque (N·m)",
    "backlash_mm": "gear backlash (mm)",
    "involute_length_mm": "involute length u (mm)",
}
MARKS = {
    Kind.FOLD: ("o", "fold"),
    Kind.PERIOD_DOUBLING: ("s", "period doubling"),
    Kind.NEIMARK_SACKER: ("D", "Neimark-Sacker"),
    Kind.CORNER: ("x", "touch begins or ends"),
}
COLORS = {"cic": BLUE, "ee": VERMILION}


@dataclasses.dataclass
class Diagram:
    """Branches of one pair in one scene over one parameter; `seeds`: what the evaluations that
    looked for orbits came to, as (value, status)."""

    scene: str
    family: str
    parameter: str
    low: float
    high: float
    branches: list[Branch]
    seeds: list[tuple[float, str]]


def explore(
    scene: str, config: Config, parameter: str, low: float, high: float, seeds: int, starts: tuple
) -> Diagram:
    """Follow all orbits that can be reached from the starts at so many values."""
    diagram = Diagram(scene, config.profile.family, parameter, low, high, [], [])
    for value in np.linspace(low, high, seeds + 2)[1:-1]:
        here = continuation.with_value(config, parameter, float(value))
        patient, hasty = Evaluator(here), Evaluator(here, survey=True)
        found: list[tuple[float, float]] = []
        for number, start in enumerate(starts):
            # A chaotic motion takes long to tell, and need not be told from everywhere.
            evaluator = hasty if number else patient
            evaluation = evaluator(start=np.array(start), series=False)
            diagram.seeds.append((float(value), evaluation.status.label))
            if not evaluation.usable or evaluation.state is None:
                continue
            forces = evaluation.response["mean_force_N"], evaluation.response["peak_force_N"]
            if any(np.allclose(forces, other, rtol=1e-3) for other in found):
                continue
            found.append(forces)
            follow_on(diagram, here, evaluation.state, evaluation.steady_state["period"], forces)
    return diagram


def follow_on(diagram: Diagram, config: Config, state, period: int, forces) -> None:
    """Follow an orbit, and those it doubles to or came from, unless they are known."""
    value = continuation.value_of(config, diagram.parameter)
    if period > LONGEST or known(diagram, value, period, forces):
        return
    try:
        first = continuation.follow(
            config, diagram.parameter, state, period, limits(diagram, period)
        )
    except InputError as error:
        print(f"{value:g}: {error}", file=sys.stderr)
        return
    queue = [first]
    while queue:
        branch = queue.pop(0)
        diagram.branches.append(branch)
        note(diagram, branch)
        for special in branch.bifurcations:
            doubling = special.kind is Kind.PERIOD_DOUBLING
            # A longer orbit born where the simple one was unstable before is unstable too.
            if 2 * branch.period > DOUBLED or not doubling:
                continue
            if not any(p.stable for p in beside(branch, special)):
                continue
            doubled = continuation.follow_doubled(
                branch, special, limits(diagram, 2 * branch.period)
            )
            if doubled is not None and not known_branch([*diagram.branches, *queue], doubled):
                queue.append(doubled)
        for end, point in zip(branch.ends, (branch.points[0], branch.points[-1]), strict=True):
            if end is End.HALVED:
                here = continuation.with_value(config, diagram.parameter, point.value)
                half = branch.period // 2
                try:
                    simple = continuation.follow(
                        here, diagram.parameter, point.state, half, limits(diagram, half)
                    )
                except InputError:
                    continue
                if not known_branch([*diagram.branches, *queue], simple):
                    queue.append(simple)


def beside(branch: Branch, special) -> tuple:
    return branch.points[special.after : special.after + 2]


def limits(diagram: Diagram, period: int) -> Steps:
    return Steps(diagram.low, diagram.high, points=max(POINTS // period, FEWEST))


def known(diagram: Diagram, value: float, period: int, forces) -> bool:
    """Whether a branch of the diagram has this orbit."""
    return any(
        np.allclose(forces, (point.mean, point.peak), rtol=1e-3)
        for branch in diagram.branches
        if branch.period == period
        for point in branch.at(value)
    )


def known_branch(branches: list[Branch], new: Branch) -> bool:
    """Whether the middle of a branch lies on another one of the same period."""
    middle = new.points[len(new.points) // 2]
    return any(
        np.allclose((middle.mean, middle.peak), (point.mean, point.peak), rtol=1e-3)
        for branch in branches
        if branch.period == new.period
        for point in branch.at(middle.value)
    )


def note(diagram: Diagram, branch: Branch) -> None:
    ends = " and ".join(end.name.lower().replace("_", " ") for end in branch.ends)
    values = [point.value for point in branch.points]
    print(
        f"{diagram.scene} {diagram.family} {diagram.parameter}: period {branch.period}, "
        f"{len(values)} points in {min(values):.5g} … {max(values):.5g}, "
        f"{len(branch.bifurcations)} special, ends: {ends}",
        file=sys.stderr,
    )


# Quiet and noisy


def ranges(diagram: Diagram) -> dict[str, list[list[float]]]:
    """Ranges of the parameter with a stable quiet orbit, a stable noisy one, both, and none."""
    edges = np.linspace(diagram.low, diagram.high, CELLS + 1)
    centres = (edges[1:] + edges[:-1]) / 2
    quiet, noisy = np.zeros(CELLS, bool), np.zeros(CELLS, bool)
    for branch in diagram.branches:
        for old, new in itertools.pairwise(branch.points):
            if not (old.stable and new.stable):
                continue
            (low, a), (high, b) = sorted((p.value, peak_ratio(branch, p)) for p in (old, new))
            inside = (centres >= low) & (centres <= high)
            ratio = np.interp(centres[inside], [low, high], [a, b])
            quiet[inside] |= ratio <= QUIET
            noisy[inside] |= ratio > QUIET
    found = {"quiet": quiet, "noisy": noisy, "both": quiet & noisy, "none": ~(quiet | noisy)}
    return {name: list(runs(mask, edges)) for name, mask in found.items()}


def peak_ratio(branch: Branch, point) -> float:
    """Peak force in units of the static one."""
    torque = branch.config.scene.load.torque_N_m
    torque = point.value if branch.parameter == "torque_N_m" else torque
    assert torque is not None  # Scenes here have a constant load.
    return point.peak / (torque / (branch.config.profile.pitch_radius_mm * 1e-3))


def runs(mask: np.ndarray, edges: np.ndarray) -> Iterator[list[float]]:
    change = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    for begin, end in change.reshape(-1, 2):
        yield [float(edges[begin]), float(edges[end])]


def overlaps(diagram: Diagram) -> list[list[float]]:
    """Ranges in which more than one stable orbit exists, quiet or noisy."""
    edges = np.linspace(diagram.low, diagram.high, CELLS + 1)
    centres = (edges[1:] + edges[:-1]) / 2
    count = np.zeros(CELLS, int)
    for branch in diagram.branches:
        for old, new in itertools.pairwise(branch.points):
            if old.stable and new.stable:
                low, high = sorted((old.value, new.value))
                count += (centres > low) & (centres <= high)
    return list(runs(count > 1, edges))


# Files


def point_rows(diagrams: list[Diagram]) -> list[dict[str, Any]]:
    return [
        {
            "scene": diagram.scene,
            "family": diagram.family,
            "parameter": diagram.parameter,
            "branch": number,
            **orbit_row(point),
        }
        for diagram in diagrams
        for number, branch in enumerate(diagram.branches)
        for point in branch.points
    ]


def special_rows(diagrams: list[Diagram]) -> list[dict[str, Any]]:
    return [
        {
            "scene": diagram.scene,
            "family": diagram.family,
            "parameter": diagram.parameter,
            "branch": number,
            "kind": special.kind.name.lower(),
            **orbit_row(special.point),
        }
        for diagram in diagrams
        for number, branch in enumerate(diagram.branches)
        for special in branch.bifurcations
    ]


def orbit_row(point) -> dict[str, Any]:
    row = {
        "value": point.value,
        "period": point.period,
        "mean_force_N": point.mean,
        "peak_force_N": point.peak,
        "rms_force_N": point.rms,
        "stable": point.stable,
        "gap_time": point.gap_time,
        "residual": point.residual,
    }
    for number, multiplier in enumerate(point.multipliers, 1):
        row |= {f"multiplier_{number}_real": multiplier.real}
        row |= {f"multiplier_{number}_imag": multiplier.imag}
    return row


def summary(diagrams: list[Diagram], seconds: float) -> dict[str, Any]:
    return {
        "quiet_up_to_static_forces": QUIET,
        "diagrams": [
            {
                "scene": diagram.scene,
                "family": diagram.family,
                "parameter": diagram.parameter,
                "range": [diagram.low, diagram.high],
                "stable": ranges(diagram),
                "several_stable": overlaps(diagram),
                "branches": [
                    {
                        "period": branch.period,
                        "points": len(branch.points),
                        "ends": [end.name.lower() for end in branch.ends],
                    }
                    for branch in diagram.branches
                ],
                "without_periodic_orbit": sorted(
                    {seed for seed in diagram.seeds if seed[1] != "periodic"}
                ),
            }
            for diagram in diagrams
        ],
        "largest_residual": max((row["residual"] for row in point_rows(diagrams)), default=None),
        "seconds": seconds,
        "versions": files.versions(),
    }


# Figures


def draw_branches(ax, diagram: Diagram, quantity: str, color: str) -> None:
    """Stable parts solid, unstable ones dashed, special points marked."""
    for branch in diagram.branches:
        points = branch.points
        for stable, part in itertools.groupby(
            itertools.pairwise(points), lambda pair: pair[0].stable and pair[1].stable
        ):
            pairs = list(part)
            line = [pairs[0][0], *(pair[1] for pair in pairs)]
            ax.plot(
                [p.value for p in line],
                [getattr(p, quantity) for p in line],
                color=color,
                linestyle="-" if stable else (0, (3, 2)),
                linewidth=2.2 if stable else 0.9,
                alpha=1.0 if stable else 0.75,
            )
        for special in branch.bifurcations:
            if not any(point.stable for point in beside(branch, special)):
                continue
            marker, _ = MARKS[special.kind]
            face = "white" if marker != "x" else color
            ax.plot(
                special.value, getattr(special.point, quantity), marker, color=color, ms=5.5,
                mfc=face, mew=1.3, zorder=4,
            )  # fmt: skip
    unsettled = sorted({value for value, status in diagram.seeds if status == "chaotic"})
    if unsettled:
        height = 0.03 if diagram.family == "cic" else 0.07
        place = {"transform": ax.get_xaxis_transform()}
        ax.plot(unsettled, [height] * len(unsettled), "*", color=color, ms=9, **place)


def legend_handles(families) -> list:
    handles: list = [Patch(color=COLORS[name], label=name.upper()) for name in families]
    handles += [
        Line2D([], [], color="black", lw=2.2, label="stable"),
        Line2D([], [], color="black", lw=0.9, ls=(0, (3, 2)), label="unstable"),
    ]
    for marker, label in MARKS.values():
        if marker != "D":
            handles.append(
                Line2D([], [], color="black", marker=marker, ls="", mfc="white", label=label)
            )
    handles.append(Line2D([], [], color="black", marker="*", ls="", ms=9, label="chaotic"))
    return handles


def sheet(width: float, height: float, rows: int, columns: int, **options):
    figure = Figure(figsize=(width, height), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def draw_grid(columns: list[list[Diagram]], titles: list[str]) -> Figure:
    """Peak force above, mean force below; a column for each list of diagrams."""
    count = len(columns)
    figure, axes = sheet(1.5 + 5.2 * count, 7.4, 2, count, sharey="row", sharex="col")
    for column, (diagrams, title) in enumerate(zip(columns, titles, strict=True)):
        for row, (quantity, name) in enumerate((("peak", "peak"), ("mean", "mean"))):
            ax = axes[row, column]
            for diagram in diagrams:
                draw_branches(ax, diagram, quantity, COLORS[diagram.family])
            ax.set_yscale("log")
            for which in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
                which(
                    FuncFormatter(
                        lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "1235" else ""
                    )
                )
            ax.set_xlim(diagrams[0].low, diagrams[0].high)
            ax.grid(color="0.92", linewidth=0.6, which="both")
            if column == 0:
                ax.set_ylabel(f"{name} contact force (N)")
        axes[0, column].set_title(title)
        axes[1, column].set_xlabel(NAMES[diagrams[0].parameter])
    families = dict.fromkeys(d.family for diagrams in columns for d in diagrams)
    handles = legend_handles(families)
    figure.legend(handles=handles, loc="outside lower center", ncols=3 * count, frameon=False)
    return figure


def draw_ranges(diagrams: list[Diagram]) -> Figure:
    """Bars where a stable quiet and a stable noisy orbit exist."""
    figure, axes = sheet(10, 1.2 + 0.75 * len(diagrams), 1, 1)
    ax = axes[0, 0]
    styles = {"quiet": ("#009E73", "", 0.17), "noisy": ("#E69F00", "//", -0.17)}
    for line, diagram in enumerate(diagrams):
        found = ranges(diagram)
        for name, (color, hatch, shift) in styles.items():
            bars = [(low, high - low) for low, high in found[name]]
            ax.broken_barh(
                bars, (line - shift - 0.15, 0.3), facecolor=color, hatch=hatch, edgecolor="white"
            )
    ax.set_yticks(range(len(diagrams)), [f"{d.family.upper()}, {d.scene}" for d in diagrams])
    ax.invert_yaxis()
    ax.set_xlim(min(d.low for d in diagrams), diagrams[0].high)
    ax.set_xlabel(NAMES[diagrams[0].parameter])
    ax.grid(color="0.9", axis="x")
    ax.set_axisbelow(True)
    handles = [
        Patch(facecolor=color, hatch=hatch, edgecolor="white", label=f"a stable {name} orbit")
        for name, (color, hatch, _) in styles.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False)
    return figure


# The run


def survey(quick: bool) -> Iterator[Diagram]:
    configs = {
        (scene, family): load(f"configs/{family}.yaml", list(overrides))
        for scene, overrides in SCENES.items()
        for family in ("cic", "ee")
    }
    if quick:
        yield explore(
            "livelier", configs["livelier", "cic"], "speed_rpm", 3500, 4500, 1, STARTS[1:2]
        )
        return
    shipped = configs["shipped", "cic"]
    speeds = [
        (scene, config, "speed_rpm", SLOWEST[scene], 6000, 6, STARTS[:3])
        for (scene, _), config in configs.items()
    ]
    for plan in (
        *speeds,
        ("shipped", shipped, "torque_N_m", 0.5, 10.0, 2, STARTS[:2]),
        ("shipped", shipped, "backlash_mm", 0.02, 0.4, 4, STARTS[:2]),
        ("shipped", shipped, "involute_length_mm", 1.0, 9.0, 2, STARTS[:2]),
    ):
        yield explore(*plan)


def write(folder: files.ResultFolder, diagrams: list[Diagram], found: dict[str, Any]) -> None:
    folder.write_csv("bifurcation.csv", files.row_columns(point_rows(diagrams)))
    folder.write_csv("special_points.csv", files.row_columns(special_rows(diagrams)))
    folder.write_json("bifurcation.json", found)
    over_speed = [d for d in diagrams if d.parameter == "speed_rpm"]
    scenes = list(dict.fromkeys(d.scene for d in over_speed))
    columns = [[d for d in over_speed if d.scene == scene] for scene in scenes]
    folder.write_figure("bifurcation_speed.png", draw_grid(columns, [TITLES[s] for s in scenes]))
    others = [[d] for d in diagrams if d.parameter != "speed_rpm"]
    if others:
        figure = draw_grid(others, ["CIC, shipped scene, 3000 rpm"] * len(others))
        folder.write_figure("bifurcation_scene.png", figure)
    folder.write_figure("bifurcation_ranges.png", draw_ranges(over_speed))


def main() -> int:
    arguments = argparse.ArgumentParser(description="Quiet and noisy orbits, followed.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/bifurcation"))
    arguments.add_argument("--quick", action="store_true", help="a part, for a test")
    options = arguments.parse_args()
    folder = files.ResultFolder(options.output)
    began = time.perf_counter()
    diagrams, found = [], {}
    # Written after every diagram, so that a long run can be looked at.
    for diagram in survey(options.quick):
        diagrams.append(diagram)
        found = summary(diagrams, time.perf_counter() - began)
        write(folder, diagrams, found)
        print(f"{diagram.scene} {diagram.family} {diagram.parameter}: {ranges(diagram)}")
        print(f"  more than one stable orbit: {overlaps(diagram)}", flush=True)
    print(f"largest residual {found['largest_residual']}, {found['seconds']:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
