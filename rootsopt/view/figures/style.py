"""Colours and line styles of all figures, and figures that need no display."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rootsopt.view.files import ResultFolder

# Okabe and Ito's palette: distinguishable with any colour vision, and in grey.
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, PURPLE, GREY = "#E69F00", "#56B4E9", "#CC79A7", "#808080"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
"""Colours of the curves in a figure, used in this order."""
DASHES = ("-", (0, (5, 1.5)), (0, (1, 1)), "-.")
"""Line styles of the curves in a figure, used in this order."""


def figure(
    width: float, height: float, rows: int = 1, columns: int = 1, grid: bool = True, **options: Any
) -> tuple[Figure, NDArray]:
    """Return a figure that needs no display, and its array of axes of shape (rows, columns).

    `width`, `height`: size in inches; `grid`: whether the panels have one; `options`: keyword
    arguments of `Figure.subplots`. Matplotlib's constrained layout leaves room for labels. Margins
    of our own took as long, since figures are drawn only once."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    axes = made.subplots(rows, columns, squeeze=False, **options)
    if grid:
        lay_grid(axes)
    return made, axes


def lay_grid(axes: NDArray) -> None:
    """Draw a light grid behind everything else on `axes`."""
    for ax in axes.flat:
        ax.grid(color="0.92", linewidth=0.6)
        ax.set_axisbelow(True)


def looks(names: Iterable[str]) -> Iterator[dict[str, Any]]:
    """Yield (colour, line style, label) of each named curve."""
    for name, color, dashes in zip(names, cycle(COLORS), cycle(DASHES)):
        yield {"color": color, "linestyle": dashes, "label": name}


def write(
    folder: "ResultFolder", name: str, made: Figure, title: str,
    entries: Sequence[Any] = (), columns: int = 4,
) -> None:  # fmt: skip
    """Write a figure with its `title` and a legend below all panels as figures/NAME.png.

    `entries`: entries of the legend; `columns`: maximum number of its columns."""
    for count in range(min(len(entries), columns), 0, -1):
        legend = made.legend(handles=entries, loc="outside lower center", ncols=count,
                             frameon=False)  # fmt: skip
        if count == 1 or legend.get_window_extent().width <= made.bbox.width:
            break
        legend.remove()
    made.suptitle(title)
    folder.write_figure(f"figures/{name}.png", made)


def beside(ax: Axes) -> None:
    """Place the legend of a panel to its right."""
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)
