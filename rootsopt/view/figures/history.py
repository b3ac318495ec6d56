"""Figures of a search: its history, and the designs that the limits leave."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from numpy.typing import NDArray

from rootsopt.config import DESIGN_KEYS
from rootsopt.config.families import is_list
from rootsopt.view.figures.force import number
from rootsopt.view.figures.style import COLORS, GREY, VERMILION, beside
from rootsopt.view.names import brief, label

_MARKERS = "os^Dvp"


def plot_history(
    axes: Sequence[Axes] | NDArray,
    history: Sequence[Mapping[str, Any]],
    keys: Sequence[str] = DESIGN_KEYS,
) -> Sequence[Axes] | NDArray:
    """Draw the objective, its best value so far and the design parameters over the evaluations.

    `keys`: names of the design parameters; `axes`: a panel for the objective, followed by one for
    each key. `history`: one row per evaluation. A row whose `start` is absent or negative belongs
    to the screening. The entries of a list-valued parameter share one panel, which omits the
    screening. Crosses at the top mark unusable designs, whose objective is not finite. Return
    `axes`.
    """
    keys = ("objective", *keys)
    for ax, key in zip(axes, keys, strict=True):
        for rows, style in _starts(history):
            if is_list(key):
                _traces(ax, rows, key)
            else:
                _trace(ax, rows, key, style)
        ax.set_ylabel("objective / baseline" if key == "objective" else label(key))
    axes[0].axhline(1, color="black", linewidth=0.8, linestyle=":", label="baseline")
    _best(axes, keys, history)
    _outside(axes[0], history)
    beside(axes[0])
    axes[-1].set_xlabel("evaluation")
    return axes


def _traces(ax, rows, key):
    """Draw each entry of the list-valued parameter `key` over the evaluations of a local search.

    `rows`: rows of the history. If they belong to the screening, nothing is drawn."""
    rows = [row for row in rows if _start(row) >= 0]
    if not rows:
        return
    names = [name for name in rows[0] if name.startswith(key)]
    x = _values(rows, "evaluation")
    for k, name in enumerate(names):
        shade = colormaps["cividis"](k / max(len(names) - 1, 1))
        end = {0: "first, at the tip", len(names) - 1: "last, at the pitch circle"}.get(k)
        ax.plot(x, _values(rows, name), color=shade, linewidth=1.2, label=end)
    if not ax.get_legend():
        beside(ax)


def _starts(history) -> Iterator[tuple[list[Mapping[str, Any]], dict[str, Any]]]:
    """Yield (rows, line style) for the screening, then for the local search from each start."""
    groups: dict[Any, list] = {}
    for row in history:
        groups.setdefault(_start(row), []).append(row)
    for i, (start, rows) in enumerate(sorted(groups.items())):
        if start < 0:
            style = {"color": GREY, "marker": ".", "linestyle": "", "label": "screening"}
        else:
            color = COLORS[start % len(COLORS)]
            marker = _MARKERS[(start // len(COLORS) + start) % len(_MARKERS)]
            style = {"color": color, "marker": marker, "linestyle": "-", "linewidth": 1}
            style["label"] = f"start {start}" if i < 10 else None
        yield rows, style


def _start(row) -> int:
    start = row.get("start")
    return int(start) if isinstance(start, int | np.integer) else -1


def _trace(ax, rows, key, style):
    """Draw the values of `key` over the evaluations in `rows`.

    A marker is hollow if the design violates a constraint. `style`: style of the line."""
    x, y = _values(rows, "evaluation"), _values(rows, key)
    met = np.asarray([bool(row.get("feasible", True)) for row in rows])
    ax.plot(x, y, **(style | {"marker": "", "label": None}), alpha=0.6)
    dots = style | {"linestyle": "", "markersize": 5}
    ax.plot(x[met], y[met], **dots)
    ax.plot(x[~met], y[~met], **(dots | {"label": None}), markerfacecolor="white")


def _values(rows, key) -> NDArray[np.float64]:
    values = (row.get(key) for row in rows)
    return np.asarray([np.nan if value is None else value for value in values], dtype=float)


def _best(axes, keys, history):
    """Draw the best objective so far as a line, and mark the best design with a star in each panel.

    The panels of list-valued parameters have no star."""
    x, best = [row["evaluation"] for row in history], _values(history, "best_objective")
    axes[0].step(x, best, where="post", color="black", linewidth=1.8, label="best so far")
    if not np.isfinite(best).any():
        return
    last = best[np.isfinite(best)][-1]
    winner = [row for row in history if row["objective"] == last][:1]
    star = {"color": "black", "markerfacecolor": "#F0E442", "markersize": 14, "zorder": 5}
    for ax, key in zip(axes, keys, strict=True):
        if is_list(key):
            continue
        x, y = [row["evaluation"] for row in winner], _values(winner, key)
        ax.plot(x, y, "*", label=f"best, {number(last)}", **star)


def _outside(ax, history):
    """Set axis limits that exclude a few bad designs, and mark these designs at the top edge."""
    values = _values(history, "objective")
    x = _values(history, "evaluation")
    known = values[np.isfinite(values)]
    known = np.append(known, 1.0)
    high = known[known <= max(1.5, 2 * np.median(known))].max()
    low = known.min()
    margin = 0.12 * max(high - low, 0.02)
    ax.set_ylim(low - margin, high + 1.5 * margin)
    marks = ((values > high, "^", "above the axis"), (~np.isfinite(values), "x", "unusable design"))
    for mask, marker, name in marks:
        if np.any(mask):
            top = np.full(np.count_nonzero(mask), 0.96)
            over = {"transform": ax.get_xaxis_transform(), "linestyle": "", "color": "black"}
            ax.plot(x[mask], top, marker=marker, markersize=6, label=name, **over)
    if not all(bool(row.get("feasible", True)) for row in history):
        ax.plot([], [], "o", color=GREY, markerfacecolor="white", label="constraint not met")


# Columns of `feasible.csv` after the two parameters.
_FEASIBLE = "slack", "objective"


def plot_feasible(
    ax: Axes,
    columns: Mapping[str, Sequence[float]],
    design: Mapping[str, float],
    others: Sequence[Mapping[str, Any]],
) -> Axes:
    """Draw the objective where all limits of the geometry are met, over two parameters.

    `columns`: those of `feasible.csv`, the two parameters first; `design`: the optimum, whose other
    parameters hold in the whole figure; `others`: designs at other vertices of the limits, drawn
    where their projection lies. Return `ax`."""
    from scipy.interpolate import RBFInterpolator  # Slow import (0.3 s).

    one, two = [*columns][:2]
    x, y, slack, objective = (np.asarray(columns[k], float) for k in (one, two, *_FEASIBLE))
    places, known = np.column_stack([x, y]), np.isfinite(objective)
    sides, shape = np.ptp(places, axis=0), (-1, len(np.unique(x)))
    slack = np.where(np.isnan(slack), np.nanmin(slack), slack)  # No sound profile.
    at = places[known]
    if np.linalg.matrix_rank((at - at.mean(axis=0)) / sides, tol=1e-6) == 2:
        between = RBFInterpolator(at / sides, objective[known])(places / sides)
        low, high = np.min(objective[known]), np.max(objective[known])
        grid = [column.reshape(shape) for column in (x, y, np.clip(between, low, high))]
        shades = ax.pcolormesh(*grid, shading="gouraud", cmap="viridis")
        ax.figure.colorbar(shades, ax=ax, label="objective (baseline = 1)")
    grid = [column.reshape(shape) for column in (x, y, slack)]
    ax.contourf(*grid, levels=[-np.inf, 0], colors="white")
    ax.contour(*grid, levels=[0], colors="black", linewidths=1)
    ax.plot(*at.T, ".", color=GREY, markersize=3, label="simulated")
    ax.plot(design[one], design[two], "*", color=VERMILION, markersize=14, label="optimum")
    ax.set(xlim=(np.min(x), np.max(x)), ylim=(np.min(y), np.max(y)))
    for place, row in enumerate(others):
        name = None if place else "other vertices (projected)"
        ax.plot(row["design"][one], row["design"][two], "s", mfc="none", color="black", label=name)
    rest = [f"{label(key)} = {brief(x)}" for key, x in design.items() if key not in (one, two)]
    ax.set(xlabel=label(one), ylabel=label(two), title=", ".join(rest))
    return ax
