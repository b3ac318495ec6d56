"""Figure of a free form compared with the best CIC."""

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments._common.style import BLUE, grid_below, sheet
from experiments.freeform.study import MM, Results, signed_departures
from rootsopt.profiles.departure import flank_points


def comparison(results: Results) -> Figure:
    """Draw flanks, pressure angle, rate at which the pressure angle falls, and departure."""
    start, found = results.start, results.found
    made, axes = sheet(11, 7, 2, 2)
    styles = {"best CIC": (start, "black", "--"), "free form from it": (found, BLUE, "-")}
    for name, (profile, color, dashes) in styles.items():
        line = {"color": color, "linestyle": dashes, "linewidth": 1.8, "label": name}
        nu = jnp.linspace(0.0, profile.pitch_normal, 2001)
        point = profile.addendum(nu)
        axes[0, 0].plot(*(flank_points(profile) / MM).T, **line)
        axes[0, 1].plot(np.degrees(point.beta), np.degrees(point.psi), **line)
        axes[1, 0].plot(np.degrees(nu), 1 - np.asarray(profile.roll_rate(nu)), **line)
    away = signed_departures(found, start)
    axes[1, 1].plot(*away, color=BLUE, linewidth=1.8)
    axes[1, 1].axhline(0, color="black", linewidth=0.9, linestyle="--")
    pitch = float(start.pitch_radius) / MM
    axes[1, 1].axvline(pitch, color="0.5", linewidth=0.9, linestyle=":")
    axes[1, 1].annotate(
        "pitch circle", (pitch, 0.02), (3, 0), xycoords=("data", "axes fraction"),
        textcoords="offset points", fontsize=9,
    )  # fmt: skip
    axes[0, 0].set(xlabel="x (mm)", ylabel="y (mm)", title="Flank, tip to root", aspect="equal")
    axes[0, 1].set(xlabel="roll angle β (°)", ylabel="pressure angle ψ (°)", ylim=(0, 95))
    axes[0, 1].set_title("Pressure angle")
    axes[1, 0].set(xlabel="normal angle ν (°)", ylabel="share τ = -dψ/dν")
    axes[1, 0].set_title("The share τ that the coefficients set")
    axes[1, 1].set(xlabel="radius (mm)", ylabel="normal distance (µm)")
    axes[1, 1].set_title("Departure from the best CIC, positive outwards")
    for ax in axes.ravel():
        grid_below(ax)
    handles, names = axes[0, 0].get_legend_handles_labels()
    made.legend(handles, names, loc="outside lower center", ncols=2, frameon=False)
    return made
