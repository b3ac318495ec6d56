"""Figure of the bias of forces and of the gradient errors over the smoothing length."""

import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import BLUE, GREEN, VERMILION, grid_below, sheet
from experiments.smoothing.study import DEFAULT, LIMIT, WIDTHS, Measured

ORDER = (BLUE, VERMILION, GREEN)
COLORS: dict[str, str] = {"cic": BLUE, "ee": VERMILION, "pump": GREEN}
NAMES = {"cic": "CIC", "ee": "EE", "pump": "pump"}
MARKS = {"cic": "o", "ee": "s", "pump": "^"}


def lengths(found: list[Measured]) -> Figure:
    """Draw the bias of the forces and the error of the gradients over the smoothing length."""
    made, axes = sheet(12, 6, 1, 2)
    (left, right) = axes[0]
    for measured in found:
        kind, color = measured.kind, COLORS[measured.kind]
        widths = np.array(sorted(set(measured.orbits) - {DEFAULT}))
        beyond = widths[1:]
        known = [measured.bias(width) for width in beyond]
        for share, style in ((1.0, "-"), (0.5, ":")):
            level = [np.nanquantile(values, share) for values in known]
            name = "greatest" if share == 1 else "median"
            left.loglog(
                beyond, np.maximum(level, 1e-13), style, marker=MARKS[kind], color=color,
                label=f"{NAMES[kind]}: {name} of {len(measured.configs)}",
            )  # fmt: skip
        own = [config.contact.rounding_mm for config in measured.configs]
        left.loglog(
            own, np.maximum(measured.bias(DEFAULT), 1e-13), MARKS[kind], color=color, mfc="none",
            ms=5, label=f"{NAMES[kind]}: default, each scene",
        )  # fmt: skip
        for number, name in enumerate(("mean", "peak", "RMS")):
            for width, off in measured.gradients.items():
                values = off[:, number]
                places = np.array(own[: len(values)]) if width == DEFAULT else width
                right.loglog(
                    places * 1.25 ** (number - 1) * np.ones_like(values),
                    np.maximum(values, 1e-12),
                    "os^"[number],
                    color=ORDER[number],
                    mfc="none",
                    ms=4,
                    label=name if width == DEFAULT else None,
                )
    left.axhline(LIMIT, color="black", linestyle="--", linewidth=1, label="limit")
    left.set_ylabel(f"relative bias of the forces, against {WIDTHS[0]:g} mm")
    right.set_ylabel("relative error of the gradient (CIC scenes)")
    for ax in axes[0]:
        ax.set_xlabel("contact.smoothing_mm (mm)")
        grid_below(ax)
        ax.legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    return made
