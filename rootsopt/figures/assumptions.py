"""Figure of an optimum over the spread of what is assumed about the scene."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes

from rootsopt.figures.style import BLUE, GREY, VERMILION, figure, write
from rootsopt.output.assumptions import label_of, named
from rootsopt.output.names import brief, name_and_unit

if TYPE_CHECKING:
    from rootsopt.output.files import ResultFolder

_OBJECTIVE = "objective (baseline in the same scene = 1)"


def plot_ranges(ax: Axes, keys: Sequence[Mapping[str, Any]], own: float) -> Axes:
    """Draw the objective at both ends of the range of each quantity, one row per quantity.

    `keys`: rows of the result file; `own`: objective in the config's own scene. Return `ax`."""
    for k, row in enumerate(keys):
        low, high = (np.nan if row[f"objective_{end}"] is None else row[f"objective_{end}"]
                     for end in ("low", "high"))  # fmt: skip
        ax.plot([low, own, high], [k] * 3, "-", color=GREY, linewidth=1)
        ax.plot(low, k, "o", mfc="white", mec=BLUE, label="low end" if k == 0 else None)
        ax.plot(high, k, "o", color=BLUE, label="high end" if k == 0 else None)
    names = [
        f"{named(row['key'])}\n{brief(row['low'], 3)} … {brief(row['high'], 3)} "
        f"{name_and_unit(row['key'])[1]}".rstrip()
        for row in keys
    ]
    ax.set_yticks(range(len(keys)), names)
    ax.axvline(own, color=BLUE, linewidth=0.8, linestyle=":", label="as given")
    ax.axvline(1, color="black", linewidth=0.8)
    ax.invert_yaxis()
    ax.set_xlabel(_OBJECTIVE)
    return ax


def plot_scenes(ax: Axes, key: str, columns: Mapping[str, Sequence[Any]]) -> Axes:
    """Draw the objective of all designs in the random scenes over the quantity `key`.

    `columns`: those of `assumptions.csv`. Return `ax`."""
    names = [name for name in columns if name.startswith("objective_")]
    values = np.array(columns[key], float)
    drawn = np.array([name.startswith("random") for name in columns["scene"]])
    looks = {"objective_optimized": (BLUE, "o"), "objective_design_1": (VERMILION, "x")}
    for name in names:
        color, mark = looks.get(name, (GREY, "+"))
        if name != "objective_baseline":
            word = name.removeprefix("objective_").replace("_", " ").replace("ized", "ised")
            ax.plot(
                values[drawn], np.array(columns[name], float)[drawn], mark, color=color, label=word
            )
    ax.axhline(1, color="black", linewidth=0.8)
    ax.set(xlabel=f"{label_of(key)}, all else random, too", ylabel=_OBJECTIVE)
    return ax


def spread_figure(
    folder: "ResultFolder", record: Mapping[str, Any], columns: Mapping[str, Sequence[Any]]
) -> None:
    """Write `figures/assumptions.png`.

    `record`: entry `assumptions` of the result file; `columns`: those of `assumptions.csv`."""
    rows, rivals = record["keys"], record["rivals"]
    made, ((left, right),) = figure(11, 1.6 + 0.5 * max(5, len(rows)), 1, 2)
    plot_ranges(left, rows, columns["objective_optimized"][0])
    plot_scenes(right, rivals[0]["key"] if rivals else record["decides"], columns)
    entries = [x for ax in (left, right) for x in ax.get_legend_handles_labels()[0]]
    write(folder, "assumptions", made, "The optimum where the pump may run", entries, 6)


__all__ = ["plot_ranges", "plot_scenes", "spread_figure"]
