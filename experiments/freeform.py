"""A free form beside the best CIC: what it gains in force, and where it departs.

    python experiments/freeform.py [configs/free.yaml] [-o DIR] [--quick]

Optimises the config, whose baseline is the projection of the best CIC, and measures both by the
objective of `configs/cic.yaml`, relative to the paper's CIC. `--quick` takes a few steps. Writes
freeform.json, freeform.yaml (the config with the design found) and freeform.png.
"""

import argparse
import sys
from pathlib import Path

from rootsopt.cli import use_cache, use_float64

use_float64()

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from experiments.families import objective  # noqa: E402
from rootsopt import files  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.evaluate import Evaluation, Evaluator  # noqa: E402
from rootsopt.families import with_design  # noqa: E402
from rootsopt.model import Model  # noqa: E402
from rootsopt.optimize.search import Search  # noqa: E402
from rootsopt.plot import BLUE, figure  # noqa: E402
from rootsopt.profiles import Profile  # noqa: E402
from rootsopt.profiles.departure import departure, flank_points  # noqa: E402
from rootsopt.resemblance import likenesses  # noqa: E402

PAPER = "configs/cic.yaml"
MM, UM = 1e-3, 1e-6


def profile_of(config: Config, evaluation: Evaluation) -> Profile:
    """The profile of a design that was simulated."""
    return Model.of(config).profile(jnp.asarray(list(evaluation.design.values())))


def draw(start: Profile, found: Profile) -> Figure:
    """Flanks, pressure angle, its share of every turn of the normal, departure."""
    made, axes = figure(11, 7, 2, 2)
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
    axes[1, 0].set_title("What the coefficients shape")
    axes[1, 1].set(xlabel="radius (mm)", ylabel="normal distance from the best CIC (µm)")
    axes[1, 1].set_title("Departure, positive outwards")
    for ax in axes.ravel():
        ax.grid(color="0.92", linewidth=0.6)
        ax.set_axisbelow(True)
    handles, names = axes[0, 0].get_legend_handles_labels()
    made.legend(handles, names, loc="outside lower center", ncols=2, frameon=False)
    return made


def signed_departures(profile: Profile, other: Profile) -> tuple[np.ndarray, np.ndarray]:
    """Radius (mm) along the flank of `other`, and the distance (µm) along its normal at which
    the flank of `profile` lies there."""
    points = flank_points(other) / MM @ [1, 1j]
    line = flank_points(profile) / MM @ [1, 1j]
    along = np.gradient(points)
    normal = -1j * along / np.abs(along)
    away = np.full(len(points), np.nan)
    for k, (place, outward) in enumerate(zip(points, normal, strict=True)):
        local = (line - place) * np.conj(outward)
        cross = np.flatnonzero((local.imag[:-1] <= 0) != (local.imag[1:] <= 0))
        if len(cross):
            share = local.imag[cross] / (local.imag[cross] - local.imag[cross + 1])
            height = local.real[cross] + share * (local.real[cross + 1] - local.real[cross])
            away[k] = height[np.argmin(np.abs(height))] * MM / UM
    return np.abs(points), away


def main() -> int:
    arguments = argparse.ArgumentParser(description="A free form beside the best CIC.")
    arguments.add_argument("config", nargs="?", default="configs/free.yaml")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/freeform"))
    arguments.add_argument("--quick", action="store_true", help="a few steps, linear contact")
    options = arguments.parse_args()
    use_cache()
    fast = ["solver.fidelity=linear"] if options.quick else []
    few = ["optimizer.iterations=4"] if options.quick else []
    folder = files.ResultFolder(options.output)
    config = load(options.config, fast + few)
    paper = Evaluator(load(PAPER, fast))(series=False)
    result = Search(config).run()
    if result.optimized is None:
        raise SystemExit("the search found nothing better; raise optimizer.iterations")
    start, found = (profile_of(config, one) for one in (result.baseline, result.optimized))
    profile = with_design(config.profile, list(result.optimized.design.values()))
    best = config.model_copy(update={"profile": profile})
    folder.write_text("freeform.yaml", best.to_yaml())
    designs = {"paper": paper, "best CIC": result.baseline, "free form": result.optimized}
    data = {
        "designs": {
            name: {"objective": objective(one, paper.response), **one.response, **one.geometry}
            for name, one in designs.items()
        },
        "evaluations": len(result.history),
        "departure_um": departure(found, start) / UM,
        "resembles": [] if options.quick else [one.record() for one in likenesses(found)],
        "versions": files.versions(),
    }
    folder.write_json("freeform.json", data)
    folder.write_figure("freeform.png", draw(start, found))
    for name, row in data["designs"].items():
        print(f"{name:10s}", *(f"{key} {value:.5g}" for key, value in row.items()))
    print(f"{data['evaluations']} designs, {data['departure_um']:.1f} um from the best CIC")
    for row in data["resembles"]:
        print(f"{row['family']:18s} {row['departure_um']:8.1f} um  {row['design']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
