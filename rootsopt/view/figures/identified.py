"""Figure of a fit to a record: record and fit, orders, and regions of the quantities."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from rootsopt.view.comparison import label_of
from rootsopt.view.figures.style import BLUE, GREY, VERMILION, figure, write
from rootsopt.view.names import label, name_and_unit

if TYPE_CHECKING:
    from rootsopt.identification.answer import Identification
    from rootsopt.view.files import ResultFolder

# Maximum number of measured columns that are drawn.
_MOST = 3

# Highest order of the rotation that is drawn.
_ORDERS = 24

# Least amplitude that is drawn, as a share of the greatest sample.
_FLOOR = 1e-5

# Half axes of the region of two quantities that holds the true ones with 95 %, in standard
# deviations: root of the quantile of χ².
_INSIDE = 2.448


def plot_record(ax: Axes, place: NDArray, measured: NDArray, fitted: NDArray) -> Axes:
    """Draw the measured and the fitted values over their `place`. Return `ax`."""
    order = np.argsort(place, kind="stable")
    ax.plot(place, measured, ".", color=GREY, markersize=3, label="record")
    ax.plot(place[order], fitted[order], color=BLUE, linewidth=1, label="fit")
    return ax


def plot_orders(ax: Axes, turned: NDArray, measured: NDArray, fitted: NDArray) -> Axes:
    """Draw the amplitudes of samples at rotations `turned` (°) over their order, the number of
    cycles in a turn. Return `ax`."""
    orders = np.arange(1, _ORDERS + 1)
    waves = np.exp(-1j * np.radians(turned) * orders[:, None])
    for values, color, mark in ((measured, GREY, "o"), (fitted, BLUE, "x")):
        sizes = 2 * np.abs(waves @ (values - np.mean(values))) / len(turned)
        ax.plot(orders, sizes, mark, color=color)
    ax.set_yscale("log")
    ax.set_ylim(bottom=_FLOOR * np.max(np.abs(measured)))
    ax.set_xlabel("order (cycles per turn)")
    return ax


def plot_region(ax: Axes, found: "Identification", first: int, second: int) -> Axes:
    """Draw the region of two quantities that holds the true ones with 95 %. Return `ax`."""
    keys, one = [*found.parameters], found.covariance[np.ix_([first, second], [first, second])]
    sizes, axes = np.linalg.eigh(one)
    middle = [found.parameters[keys[k]]["value"] for k in (first, second)]
    wide, tall = 2 * _INSIDE * np.sqrt(np.maximum(sizes, 0.0))
    turned = np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
    ax.add_patch(
        Ellipse((middle[0], middle[1]), wide, tall, angle=turned, color=VERMILION, alpha=0.3)
    )
    ax.plot(*middle, "+", color=VERMILION)
    ax.autoscale_view()
    ax.locator_params(nbins=5, steps=[1, 2, 2.5, 5, 10])
    ax.ticklabel_format(useOffset=False, style="plain")
    ax.set(xlabel=label_of(keys[first]), ylabel=label_of(keys[second]), title="95 % region")
    return ax


def drawn(found: "Identification") -> Figure:
    """Return the figure of a fit: columns of the record, orders of the first, and a region."""
    table = {key: np.asarray(column) for key, column in found.residuals.items()}
    turned = table["rotation_deg"].astype(float)
    names = [*dict.fromkeys(table["column"].tolist())][:_MOST]
    count = len(names) + 1 + (len(found.parameters) > 1)
    made, axes = figure(4.2 * count, 4.2, 1, count)
    for ax, name in zip(axes[0], names, strict=False):
        mine = table["column"] == name
        sampled = bool(np.isfinite(turned[mine]).all())
        place = turned[mine] if sampled else table["line"][mine]
        plot_record(ax, place, table["measured"][mine], table["fitted"][mine])
        ax.set(xlabel="rotation (°)" if sampled else "line of the record", title=label(name))
        if name == names[0]:
            made.legend(loc="outside lower left", ncols=2, frameon=False)
            beside, (called, unit) = axes[0, len(names)], name_and_unit(name)
            if sampled:
                plot_orders(beside, place, table["measured"][mine], table["fitted"][mine])
                beside.set(title=f"orders of the {called}", ylabel=f"amplitude ({unit})")
            else:
                beside.plot(table["line"], table["residual"], "o", color=GREY)
                beside.set(xlabel="line of the record", title="difference / its error")
    if len(found.parameters) > 1:
        away = np.abs(np.triu(found.correlation, 1))
        plot_region(axes[0, -1], found, *divmod(int(np.argmax(away)), len(away)))
    return made


def identified_figure(folder: "ResultFolder", found: "Identification") -> None:
    """Write `figures/identified.png` into `folder`."""
    write(folder, "identified", drawn(found), "Record and fit")
