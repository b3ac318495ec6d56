"""Figures of contact force, objective and resonances over speed."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import setp
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments._common.style import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    sheet,
)
from experiments.speed.study import OPTIMISED, Row, Study
from rootsopt.view.figures.sweep import LABELS, legend_entries, plot_speeds

TITLES = {"shipped": "shipped scene", "light": "gear damping ratio 0.1"}


def over_speed(studies: dict[str, Study]) -> Figure:
    """Draw mean and peak force over speed, one column per scene."""
    made, axes = sheet(13, 7.4, 2, len(studies), sharex=True, sharey="row")
    *shown, _ = OPTIMISED
    labels = ["CIC", "EE", *(f"CIC, optimised {name}" for name in shown)]
    entries = {}
    for column, (scene, found) in enumerate(studies.items()):
        designs = {k: found.designs[k] for k in labels if k in found.designs}
        entries |= {entry.get_label(): entry for entry in legend_entries(designs)}
        for ax, force in zip(axes[:, column], LABELS, strict=True):
            plot_speeds(ax, designs, force)
        axes[0, column].set_title(TITLES[scene])
    for ax in axes.flat:
        ax.set_ylim(0, None)
    setp(axes[1], xlabel="speed (rpm)")
    made.legend(handles=list(entries.values()), loc="outside lower center", ncols=4, frameon=False)
    made.suptitle("Contact force over speed, from rest")
    return made


def objectives(studies: dict[str, Study], listed: Sequence[float]) -> Figure:
    """Draw the objective of the optimised designs over speed, relative to CIC at the same speed."""
    made, axes = sheet(13, 4.6, 1, len(studies), sharey=True)
    styles = dict(zip(OPTIMISED, ((GREEN, "-", "o"), (PURPLE, "--", "s"),
                                  (ORANGE, ":", "^")), strict=True))  # fmt: skip
    for ax, (scene, found) in zip(axes[0], studies.items(), strict=True):
        base = found.designs["CIC"]
        speeds = np.array([part.speed_rpm for part in base])
        for name, (color, dashes, marker) in styles.items():
            parts = found.designs.get(f"CIC, optimised {name}")
            if parts is None:
                continue
            values = found.over(parts)
            at = [3000.0] if name == "at 3000 rpm" else listed
            ax.plot(speeds, values, color=color, linestyle=dashes, label=f"optimised {name}")
            ax.plot(at, np.interp(at, speeds, values), marker, color=color, markersize=5)
            unsettled = np.array(
                [not (p.evaluation.usable and b.evaluation.usable)
                 for p, b in zip(parts, base, strict=True)]
            )  # fmt: skip
            ax.plot(speeds[unsettled], values[unsettled], "x", color=color, markersize=7)
        ax.axhline(1, color="black", linewidth=0.8, linestyle=":")
        ax.set(title=TITLES[scene], xlabel="speed (rpm)")
    axes[0, 0].set_ylabel("objective / CIC at the same speed")
    entries = axes[0, 0].get_legend_handles_labels()
    made.legend(*entries, loc="outside lower center", ncols=3, frameon=False)
    made.suptitle("Objective of each optimum at other speeds (markers: speeds of its objective)")
    return made


def resonances(studies: dict[str, Study], rows: list[Row], peaks: list[Row]) -> Figure:
    """Draw peak force over speed, with resonance crossings and maxima: shipped pairs, optimised
    CIC."""
    shown = {
        "CIC": BLUE,
        "EE": VERMILION,
        f"CIC, optimised {next(iter(OPTIMISED))}": SKY,
    }
    made, axes = sheet(13, 10.5, len(shown), len(studies), sharex=True)
    modes: dict[str, tuple[str, Any]] = {
        "contact": (GREEN, "--"), "gear": (PURPLE, ":"), "average": ("0.45", "-."),
    }  # fmt: skip
    for column, (scene, found) in enumerate(studies.items()):
        for ax, (name, color) in zip(axes[:, column], shown.items(), strict=True):
            if name not in found.designs:
                continue
            here = {"scene": scene, "design": name}.items()
            parts = found.designs[name]
            for line in plot_speeds(ax, {name: parts}, "peak_force_N").lines:
                line.set_color(color)
            ax.axhline(found.linear[name]["static_peak_N"], color="black", linewidth=0.9)
            top = 1.25 * max(part.evaluation.response.get("peak_force_N", 0) for part in parts)
            for row in rows:
                if not here <= row.items() or row["order"] > 3:
                    continue
                shade, dashes = modes[row["mode"]]
                ax.axvline(row["speed_rpm"], color=shade, linestyle=dashes, linewidth=1.1)
                height = 0.97 - 0.055 * list(modes).index(row["mode"])
                ax.text(row["speed_rpm"] + 30, height * top, str(row["order"]), color=shade,
                        va="center", fontsize=9)  # fmt: skip
            for peak in peaks:
                if here <= peak.items() and peak["force"] == "peak_force_N":
                    ax.plot(peak["speed_rpm"], 1.03 * peak["value_N"], "v", color="black", ms=5)
            ax.set(title=f"{name}, {TITLES[scene]}", ylim=(0, top))
    setp(axes[-1], xlabel="speed (rpm)")
    black: dict[str, Any] = {"color": "black", "linestyle": ""}
    made.legend(
        handles=[
            *(Line2D([], [], label=f"k × mesh frequency = {mode} frequency", color=c, linestyle=d)
              for mode, (c, d) in modes.items()),
            Line2D([], [], label="peak at standstill", color="black", linewidth=0.9),
            Line2D([], [], label="local maximum", marker="v", markersize=5, **black),
            Line2D([], [], label="chaotic, or not settled (+)", marker="x", **black),
        ],
        loc="outside lower center", ncols=3, frameon=False,
    )  # fmt: skip
    made.suptitle("Peak force over speed; lines: harmonic k meets a natural frequency")
    return made
