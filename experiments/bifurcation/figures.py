"""Figures of the branches, and of the ranges of quiet and noisy orbits."""

import itertools

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter

from experiments._common.style import BLUE, GREEN, ORANGE, VERMILION, sheet
from experiments.bifurcation.study import Diagram, beside, ranges
from rootsopt.continuation import Bifurcation, Kind
from rootsopt.status import Status

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
TITLES = {
    "shipped": "shipped scene: backlash 0.1 mm, gear damping 0.5",
    "livelier": "livelier scene: backlash 0.2 mm, gear damping 0.2",
}
COLORS = {"cic": BLUE, "ee": VERMILION}


def draw_branches(ax, diagram: Diagram, quantity: str, color: str) -> None:
    """Draw the branches of a diagram: stable parts solid, unstable parts dashed, special points
    marked.

    `quantity`: force to draw, a field of `BranchPoint`."""
    for branch in diagram.branches:
        pairs = itertools.pairwise(branch.points)
        for stable, part in itertools.groupby(pairs, lambda pair: all(p.stable for p in pair)):
            (first, second), *rest = part
            line = [first, second, *(pair[1] for pair in rest)]
            ax.plot(
                [p.value for p in line],
                [getattr(p, quantity) for p in line],
                color=color,
                linestyle="-" if stable else (0, (3, 2)),
                linewidth=2.2 if stable else 0.9,
                alpha=1.0 if stable else 0.75,
            )
    for special in drawn_specials(diagram):
        marker, _ = MARKS[special.kind]
        ax.plot(
            special.point.value, getattr(special.point, quantity), marker, color=color, ms=5.5,
            mfc="white", mew=1.3, zorder=4,
        )  # fmt: skip
    unsettled = chaotic(diagram)
    height = [0.03 if diagram.names["family"] == "cic" else 0.07] * len(unsettled)
    ax.plot(unsettled, height, "*", color=color, ms=9, transform=ax.get_xaxis_transform())


def drawn_specials(diagram: Diagram) -> list[Bifurcation]:
    """Return the bifurcations and corners at which a stable part of a branch begins or ends."""
    return [
        special
        for branch in diagram.branches
        for special in branch.bifurcations
        if any(point.stable for point in beside(branch, special))
    ]


def chaotic(diagram: Diagram) -> list[float]:
    """Return the values of the parameter at which a simulation was chaotic."""
    return sorted({v for v, status in diagram.seeds if status == Status.CHAOTIC.label})


def legend_handles(diagrams: list[Diagram]) -> list:
    """Return legend entries for the content of the diagrams."""
    families = dict.fromkeys(diagram.names["family"] for diagram in diagrams)
    drawn = {special.kind for diagram in diagrams for special in drawn_specials(diagram)}
    styles = [
        {"lw": 2.2, "label": "stable"},
        {"lw": 0.9, "ls": (0, (3, 2)), "label": "unstable"},
        *(
            {"marker": marker, "ls": "", "mfc": "white", "label": label}
            for kind, (marker, label) in MARKS.items()
            if kind in drawn
        ),
    ]
    if any(map(chaotic, diagrams)):
        label = "on the lower axis: chaotic when simulated there"
        styles.append({"marker": "*", "ls": "", "ms": 9, "label": label})
    patches = [Patch(color=COLORS[name], label=name.upper()) for name in families]
    return [*patches, *(Line2D([], [], color="black", **style) for style in styles)]


def pictures(diagrams: list[Diagram]) -> dict[str, Figure]:
    """Draw all figures. Return them by name: over speed, over other parameters (if any), ranges."""
    over_speed = [d for d in diagrams if d.names["parameter"] == "speed_rpm"]
    scenes = list(dict.fromkeys(d.scene for d in over_speed))
    columns = [[d for d in over_speed if d.scene == scene] for scene in scenes]
    found = {"speed": draw_grid(columns, [TITLES[scene] for scene in scenes])}
    others = [[d] for d in diagrams if d.names["parameter"] != "speed_rpm"]
    if others:
        found["scene"] = draw_grid(others, ["CIC, shipped scene, 3000 rpm"] * len(others))
    return found | {"ranges": draw_ranges(over_speed)}


def draw_grid(columns: list[list[Diagram]], titles: list[str]) -> Figure:
    """Draw peak force above and mean force below, one column per list of diagrams."""
    count = len(columns)
    figure, axes = sheet(1.5 + 5.2 * count, 7.4, 2, count, sharey="row", sharex="col")
    for place, (diagrams, title) in enumerate(zip(columns, titles, strict=True)):
        for ax, quantity in zip(axes[:, place], ("peak", "mean"), strict=True):
            for diagram in diagrams:
                draw_branches(ax, diagram, quantity, COLORS[diagram.names["family"]])
            few = FuncFormatter(lambda x, _: f"{x:g}" if f"{x:.0e}"[0] in "1235" else "")
            ax.set(yscale="log", xlim=(diagrams[0].low, diagrams[0].high))
            ax.yaxis.set(major_formatter=few, minor_formatter=few)
            ax.grid(color="0.92", linewidth=0.6, which="both")
        axes[0, place].set_title(title)
        axes[1, place].set_xlabel(NAMES[diagrams[0].names["parameter"]])
    axes[0, 0].set_ylabel("peak contact force (N)")
    axes[1, 0].set_ylabel("mean contact force (N)")
    handles = legend_handles([diagram for diagrams in columns for diagram in diagrams])
    figure.legend(handles=handles, loc="outside lower center", ncols=3 * count, frameon=False)
    return figure


def draw_ranges(diagrams: list[Diagram]) -> Figure:
    """Draw bars where a stable quiet and a stable noisy orbit exist."""
    figure, ((ax,),) = sheet(10, 1.2 + 0.75 * len(diagrams), 1, 1)
    styles = {"quiet": (GREEN, "", 0.17), "noisy": (ORANGE, "//", -0.17)}
    lowest = min(diagram.low for diagram in diagrams)
    for line, diagram in enumerate(diagrams):
        if diagram.low > lowest:
            unknown = {"facecolor": "0.93", "hatch": "xx", "edgecolor": "0.8", "linewidth": 0}
            ax.broken_barh([(lowest, diagram.low - lowest)], (line - 0.32, 0.64), **unknown)
            ax.text(
                (lowest + diagram.low) / 2, line, f"not followed below {diagram.low:g}",
                ha="center", va="center", fontsize=9,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 2},
            )  # fmt: skip
        found = ranges(diagram)
        for name, (color, hatch, shift) in styles.items():
            bars = [(low, high - low) for low, high in found[name]]
            ax.broken_barh(
                bars, (line - shift - 0.15, 0.3), facecolor=color, hatch=hatch, edgecolor="white"
            )
    ax.set_yticks(
        range(len(diagrams)), [f"{d.names['family'].upper()}, {d.scene}" for d in diagrams]
    )
    ax.invert_yaxis()
    ax.set(xlim=(lowest, diagrams[0].high), xlabel=NAMES[diagrams[0].names["parameter"]])
    handles = [
        Patch(facecolor=color, hatch=hatch, edgecolor="white", label=f"a stable {name} orbit")
        for name, (color, hatch, _) in styles.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False)
    return figure
