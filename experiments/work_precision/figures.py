"""Figure of error against run time."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments._common.style import COLORS, MARKS, grid_below, plain_ticks, sheet
from experiments.work_precision.study import FLOOR, FORCES, Curve, Results, Row

TITLES = {
    "contact": "CIC: contact (tsit5)",
    "solver": "CIC: solver and precision",
    "ee": "EE: contact (tsit5)",
    "lively": "lively CIC: contact (tsit5)",
}
CLOSED = {
    "closing cic": "CIC: how orbits are closed",
    "closing ee": "EE: how orbits are closed",
    "closing lively": "lively CIC: how orbits are closed",
}


def panels_of(results: Results, titles: dict[str, str]) -> list[str]:
    """Return those panels in `titles` for which there are curves."""
    return [p for p in titles if any(p in curve.panels for curve, _ in results.measured)]


def errors(results: Results, titles: dict[str, str]) -> Figure:
    """Draw the error of mean (above) and peak (below) over run time, a column for each panel.

    `titles`: of the panels to draw, `TITLES` or `CLOSED`. Panels without curves are left out."""
    measured, references = results.measured, results.references
    panels = panels_of(results, titles)
    width, columns = 4.2 * len(panels) + 0.4, len(panels)
    figure, axes = sheet(width, 9.6, 2, columns, sharex="col", sharey="row")
    for column, panel in enumerate(panels):
        drawn = [(curve, rows) for curve, rows in measured if panel in curve.panels]
        own = references[drawn[0][0].scene].error
        for row, name in enumerate(FORCES):
            ax: Axes = axes[row, column]
            for number, (curve, rows) in enumerate(drawn):
                style = style_of(curve) if panel in ("contact", "ee", "lively") else number
                draw_curve(ax, style, curve.label(panel), rows, name)
            ax.axhspan(FLOOR / 3, max(own[name], FLOOR), color="0.88", lw=0)
            ax.axhline(1e-3, color="0.5", lw=0.8, ls=":")
            ax.set(xscale="log", yscale="log")
            ax.set_ylim(FLOOR / 3, 0.5)
            plain_ticks(ax.xaxis)
            grid_below(ax, which="major", color="0.9")
            if row == 0:
                ax.set_title(titles[panel], fontsize=11)
            else:
                ax.set_xlabel("one evaluation with gradient, warm (ms)")
                below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.14)}
                ax.legend(fontsize=8, frameon=False, **below)
    for row, name in enumerate(FORCES):
        axes[row, 0].set_ylabel(f"relative error of the {name} force")
    figure.suptitle(
        "Each mark is a tolerance, ten times finer from one to the next; grey: error of the "
        "reference itself; dotted: 1e-3; not shown: runs that end elsewhere (table)",
        fontsize=10,
    )
    return figure


STYLES = ("search", "map 384x16", "map 192x12", "map 768x24", "linear", "nodes 100", "nodes 400")


def style_of(curve: Curve) -> int:
    """Return the number of the colour and mark of a curve, which depend on its contact.

    Search with dopri8 has the same number as nodes 100, which is never in the same panel.
    """
    return STYLES.index(curve.contact if curve.method == "tsit5" else "nodes 100")


def draw_curve(ax: Axes, number: int, label: str, rows: list[Row], name: str) -> None:
    """Draw one curve: error over run time. Omit runs that did not end on the reference's orbit."""
    good = [row for row in rows if row["status"] == "periodic"]
    ax.plot(
        [1e3 * row["seconds"] for row in good],
        [max(row[f"{name}_error"], FLOOR) for row in good],
        marker=MARKS[number % len(MARKS)],
        color=COLORS[number % len(COLORS)],
        lw=1.4,
        ms=5,
        label=label if len(good) == len(rows) else f"{label} ({len(rows) - len(good)} not shown)",
    )
