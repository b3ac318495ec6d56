"""Optimises a free form from the best CIC, and measures what it gains and where it departs.

The baseline of the config is the projection of the best CIC. Both designs are measured by the
objective of `configs/cic_drawn.yaml`, relative to the paper's CIC.
"""

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments._common.driver import NoResultError, Run
from experiments._common.scenes import CIC, shipped
from experiments._common.simulation import evaluate, objective, profile_of
from experiments._common.style import BLUE, sheet
from experiments._common.tables import print_record, show
from rootsopt.config import load
from rootsopt.optimize.search import Search
from rootsopt.profiles import Profile, outline
from rootsopt.profiles.geometry import departure, flank_points
from rootsopt.scene.resemblance import likenesses
from rootsopt.view.figures.designs import plot_departure

MM, UM = 1e-3, 1e-6


def comparison(start: Profile, found: Profile) -> Figure:
    """Draw flanks, pressure angle, rate at which the pressure angle falls, and departure."""
    made, axes = sheet(11, 7, 2, 2)
    styles = {"best CIC": (start, "black", "--"), "free form from it": (found, BLUE, "-")}
    for name, (profile, color, dashes) in styles.items():
        line = {"color": color, "linestyle": dashes, "linewidth": 1.8, "label": name}
        nu = jnp.linspace(0.0, profile.pitch_normal, 2001)
        point = profile.addendum(nu)
        axes[0, 0].plot(*(flank_points(profile) / MM).T, **line)
        axes[0, 1].plot(np.degrees(point.beta), np.degrees(point.psi), **line)
        axes[1, 0].plot(np.degrees(nu), 1 - np.asarray(profile.roll_rate(nu)), **line)
    before, after = (np.asarray(outline(one)) / MM for one in (start, found))
    plot_departure(axes[1, 1], before, after, start.lobes, float(start.pitch_radius) / MM)
    axes[0, 0].set(xlabel="x (mm)", ylabel="y (mm)", title="Flank, tip to root", aspect="equal")
    axes[0, 1].set(
        xlabel="roll angle β (°)", ylabel="pressure angle ψ (°)", ylim=(0, 95),
        title="Pressure angle",
    )  # fmt: skip
    axes[1, 0].set(
        xlabel="normal angle ν (°)", ylabel="share τ = -dψ/dν",
        title="The share τ that the coefficients set",
    )  # fmt: skip
    entries = axes[0, 0].get_legend_handles_labels()
    made.legend(*entries, loc="outside lower center", ncols=2, frameon=False)
    return made


def run(job: Run) -> None:
    """Optimise the free form, and compare it with its baseline and the paper's CIC.

    Writes the config with the optimised design. Raises `NoResultError` if the search finds no
    better design.
    """
    config = shipped("free", *(["optimizer.iterations=4"] if job.quick else []))
    paper = evaluate(load(CIC))
    result = Search(config).run()
    if result.optimized is None:
        raise NoResultError("the search found nothing better; raise optimizer.iterations")
    start, found = (
        profile_of(config, list(one.design.values())) for one in (result.baseline, result.optimized)
    )
    profile = config.profile.with_design([*result.optimized.design.values()])
    job.folder.write_text("freeform.yaml", config.model_copy(update={"profile": profile}).to_yaml())
    designs = {"paper": paper, "best CIC": result.baseline, "free form": result.optimized}
    record = {
        "designs": {
            name: {"objective": objective(one, paper.response), **one.response, **one.geometry}
            for name, one in designs.items()
        },
        "evaluations": len(result.history),
        "optimality": {} if result.optimality is None else result.optimality.record(),
        "departure_um": departure(found, start) / UM,
        "resembles": [] if job.quick else [one.record() for one in likenesses(found)],
    }
    job.json("freeform.json", record)
    job.figure("freeform.png", comparison(start, found))
    show("Designs", [{"design": name, **row} for name, row in record["designs"].items()])
    print_record({key: record[key] for key in record if key != "designs"})
