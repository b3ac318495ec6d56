"""Colours and line styles of all figures, and figures that need no display."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import LayoutEngine
from matplotlib.spines import Spine
from matplotlib.transforms import Bbox, BboxTransformFrom, BboxTransformTo
from numpy.typing import NDArray

from rootsopt.output.files import ResultFolder

# Okabe and Ito's palette: distinguishable with any colour vision, and in grey.
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, PURPLE, GREY = "#E69F00", "#56B4E9", "#CC79A7", "#808080"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
"""Colours of the curves in a figure, used in this order."""
DASHES = ("-", (0, (5, 1.5)), (0, (1, 1)), "-.")
"""Line styles of the curves in a figure, used in this order."""


_PAD = 0.06
"""Distance (inches) between the labels of a figure's panels, and of all labels from its edges."""
_LEAST = 0.3
"""Least share of a figure's width and height that its panels take, however long their labels are.
"""


class Margins(LayoutEngine):
    """Margins of a figure and gaps between its panels that leave room for their labels.

    The panels must be the cells of one grid; colour bars share the cell of their panel. Labels are
    measured again only where a panel's new size changes its ticks. Matplotlib's constrained layout
    measures everything twice, which took a quarter of the time of a figure."""

    _adjust_compatible, _colorbar_gridspec = True, True

    def execute(self, fig: Figure) -> None:
        """Place the panels, the title and the legend of a figure; called when it is drawn."""
        edges = _edges(fig)
        cells = [(ax, spec) for ax in fig.axes if (spec := ax.get_subplotspec()) is not None]
        measured: dict[Axes, tuple[Any, ...]] = {}
        for _ in range(2):
            for ax, spec in cells:
                # A panel of another size may get other ticks, with longer labels.
                ticks = [min(axis.get_tick_space(), 9) for axis in (ax.xaxis, ax.yaxis)]
                if ax not in measured or measured[ax][0] != ticks:
                    measured[ax] = ticks, _labels(ax, spec)
            _place(fig, [(ax, spec, measured[ax][1]) for ax, spec in cells], edges)


def _place(fig: Figure, cells: list, edges: NDArray[np.float64]) -> None:
    """Place the panels of a figure.

    `cells`: panel, its cell, and the room of its labels (`_labels`); `edges`: room beside all."""
    grid = cells[0][1].get_topmost_subplotspec().get_gridspec()
    across, down = np.zeros((2, grid.ncols)), np.zeros((2, grid.nrows))
    for _, spec, (left, right, below, above) in cells:
        top = spec.get_topmost_subplotspec()
        for needs, span, before, after in (
            (across, top.colspan, left, right),
            (down, top.rowspan, above, below),
        ):
            needs[0, span.start] = max(needs[0, span.start], before)
            needs[1, span.stop - 1] = max(needs[1, span.stop - 1], after)
    pad, (width, height) = _PAD * fig.dpi, fig.bbox.size
    x = _places(across, grid.get_width_ratios(), edges[:2] + pad, width, pad)
    y = 1 - _places(down, grid.get_height_ratios(), edges[:1:-1] + pad, height, pad)
    for ax, spec, _ in cells:
        top = spec.get_topmost_subplotspec()
        low, high = top.rowspan.stop - 1, top.rowspan.start
        first, last = top.colspan.start, top.colspan.stop - 1
        cell = Bbox([[x[0, first], y[1, low]], [x[1, last], y[0, high]]])
        within = BboxTransformFrom(top.get_position(fig)) + BboxTransformTo(cell)
        ax.set_position(within.transform_bbox(spec.get_position(fig)))


def _places(needs: NDArray, ratios, outside: NDArray, size: float, pad: float) -> NDArray:
    """Return start and end (2, n) of each row or column of panels, as shares of a figure's `size`.

    `needs` (2, n): room that labels need before and after each; `ratios`: their relative sizes;
    `outside` (2,): room beside all panels. Lengths are in pixels."""
    gaps = np.append(needs[0], 0) + np.insert(needs[1], 0, 0)
    gaps[1:-1] += 2 * pad
    gaps[[0, -1]] += outside
    gaps *= min(1.0, (1 - _LEAST) * size / np.sum(gaps))
    sizes = (size - np.sum(gaps)) * np.asarray(ratios) / np.sum(ratios)
    ends = np.cumsum(gaps[:-1] + sizes)
    return np.stack([ends - sizes, ends]) / size


def _labels(ax: Axes, spec: SubplotSpec) -> tuple[float, float, float, float]:
    """Return the room (pixels) that labels need left, right, below and above a panel.

    `spec`: cell of the panel. In a cell with a colour bar, sides that face inwards need none."""
    # Spines are four artists of no width, and cost as much to measure as all labels of an axis.
    others = [a for a in ax.get_default_bbox_extra_artists() if not isinstance(a, Spine)]
    box = ax.get_tightbbox(bbox_extra_artists=others, for_layout_only=True)
    if box is None:
        return 0.0, 0.0, 0.0, 0.0
    at, (rows, columns) = ax.bbox, spec.get_gridspec().get_geometry()
    whole = spec is spec.get_topmost_subplotspec()
    outer = spec.colspan.start == 0, spec.colspan.stop == columns
    outer += spec.rowspan.stop == rows, spec.rowspan.start == 0
    needs = at.x0 - box.x0, box.x1 - at.x1, at.y0 - box.y0, box.y1 - at.y1
    left, right, below, above = (
        max(0.0, need) * (whole or side) for need, side in zip(needs, outer, strict=True)
    )
    return left, right, below, above


def _edges(fig: Any) -> NDArray[np.float64]:
    """Place the title and the common labels of a figure at its edges, inside its legends.

    Return the room (pixels) that these and the legends take left, right, below and above. The text
    of a legend wider than the figure is made smaller."""
    room, (width, height) = np.zeros(4), fig.bbox.size
    pad, sides = _PAD * fig.dpi, {"left": 0, "right": 1, "lower": 2, "upper": 3}
    for legend in fig.legends:
        side = sides.get(getattr(legend, "_outside_loc", None) or "")
        if side is not None:
            while legend.get_tightbbox().width > width - 2 * pad and _shrunk(legend):
                pass
            room[side] = legend.get_tightbbox().size[side // 2] + 2 * pad
    for text, side in ((fig._supylabel, 0), (fig._supxlabel, 2), (fig._suptitle, 3)):
        if text is not None:
            depth = room[side] + pad
            up = 1 - depth / height if side == 3 else depth / height
            text.set_position((depth / width, 0.5) if side == 0 else (0.5, up))
            room[side] = depth + text.get_tightbbox().size[side // 2]
    return room


def _shrunk(legend: Any) -> bool:
    """Make the text of a legend a tenth smaller; return whether it is still legible."""
    sizes = [text.get_fontsize() for text in legend.get_texts()]
    for text, size in zip(legend.get_texts(), sizes, strict=True):
        text.set_fontsize(0.9 * size)
    return min(sizes) > 5


def figure(
    width: float, height: float, rows: int = 1, columns: int = 1, grid: bool = True, **options: Any
) -> tuple[Figure, NDArray]:
    """Return a figure that needs no display, and its array of axes of shape (rows, columns).

    `width`, `height`: size in inches; `grid`: whether the panels have one; `options`: keyword
    arguments of `Figure.subplots`."""
    made = Figure(figsize=(width, height), layout=Margins())
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
    """Yield colour, line style and label of the curve of each name."""
    for name, color, dashes in zip(names, cycle(COLORS), cycle(DASHES)):
        yield {"color": color, "linestyle": dashes, "label": name}


def write(
    folder: ResultFolder, name: str, made: Figure, title: str,
    entries: Sequence[Any] = (), columns: int = 4,
) -> str:  # fmt: skip
    """Write a figure with its `title` and a legend below all panels; return the file's name.

    `entries`: entries of the legend, in at most so many `columns`."""
    if entries:
        made.legend(handles=entries, loc="outside lower center", ncols=min(len(entries), columns),
                    frameon=False)  # fmt: skip
    made.suptitle(title)
    file = f"figures/{name}.png"
    folder.write_figure(file, made)
    return file


def beside(ax: Axes) -> None:
    """Place the legend of a panel at its right."""
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)
