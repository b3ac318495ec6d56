"""Figure of a measured rotor compared with its design."""

import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import BLUE, GREY, grid_below, sheet
from experiments.measured.study import Results, complex_points, off_um
from rootsopt.figures.profiles import plot_conjugacy
from rootsopt.measured.conjugacy import gaps_um


def deviations(results: Results) -> Figure:
    """Draw the deviation from the design over the radius, and the gap in rolling."""
    design, pitch = results.design, results.config.profile.pitch_radius_mm
    made, axes = sheet(11, 4.2, 1, 2)
    left, right = axes[0]
    left.plot(
        np.abs(results.points),
        off_um(results.points, design),
        ".",
        color=GREY,
        ms=2,
        label="points",
    )
    fitted = complex_points(results.profile, 240)
    fitted = fitted[(np.angle(fitted) >= 0) & (np.angle(fitted) <= np.pi / design.lobes)]
    left.plot(np.abs(fitted), off_um(fitted, design), color=BLUE, label="flank that is simulated")
    left.axvline(pitch, color="black", ls="--", lw=0.9)
    left.annotate(
        "pitch circle", (pitch, 0.97), (3, 0), ha="left", va="top",
        xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=9,
    )  # fmt: skip
    left.set(xlabel="radius (mm)", ylabel="deviation, outwards (µm)", title="From the design")
    grid_below(left)
    left.legend(frameon=False, loc="upper left")
    plot_conjugacy(right, {name: gaps_um(one) for name, one in results.gaps.items()})
    right.legend(frameon=False)
    return made
