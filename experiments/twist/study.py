"""Ripple, contact force and bearing load of EE rotors over twist and number of lobes.

The scene is that of `configs/ee.yaml` with gas instead of a constant torque, and with bearings. All
rotors have its pitch radius and length. The number of slices is fixed, so that all twists of one
number of lobes share a compiled program; straight rotors are those with a twist of a billionth
of a degree, whose slices have their events at one instant.
"""

import itertools

import numpy as np
from matplotlib.artist import setp
from matplotlib.figure import Figure

from experiments._common.driver import Run
from experiments._common.scenes import shipped
from experiments._common.style import COLORS, MARKS, sheet
from experiments._common.tables import Row, show
from rootsopt.pump.sheet import sheet as pump_sheet
from rootsopt.response.evaluation import Evaluator
from rootsopt.scene import Scene, design_vector

LOBES = 2, 3, 4
TWISTS = 1e-9, 10.0, 20.0, 30.0, 45.0, 60.0, 75.0, 90.0
_SLICES = 6
_FORCES = (
    "mean_force_N",
    "rms_force_N",
    "peak_force_N",
    "bearing_load_equivalent_N",
    "bearing_load_max_N",
    "axial_force_max_N",
    "tilting_moment_max_N_m",
)


def evaluated(lobes: int, twist: float, slices: int) -> Row:
    """Return the row of EE rotors with `lobes` and a `twist` (°): ripple, forces and loads.

    Without an orbit, forces are `None`."""
    config = shipped(
        "ee",
        f"profile.lobes={lobes}",
        "scene.load={pressure_difference_Pa: 6.0e4}",
        "scene.bearings={}",
        f"rotor.helix_deg={twist!r}",
        f"solver.slices={slices}",
    )
    found = Evaluator.of(config)()
    ripple = pump_sheet(Scene.from_config(config), design_vector(config))["flow_ripple"]
    row: Row = {"lobes": lobes, "twist_deg": round(twist, 3), "flow_ripple": ripple}
    return row | {k: found.response.get(k) for k in _FORCES} | {"status": found.status.label}


_PANELS = {
    "flow_ripple": ("flow ripple (%)", 100.0),
    "mean_force_N": ("mean contact force (N)", 1.0),
    "peak_force_N": ("peak contact force (N)", 1.0),
    "bearing_load_equivalent_N": ("equivalent bearing load (N)", 1.0),
    "axial_force_max_N": ("greatest axial force (N)", 1.0),
    "tilting_moment_max_N_m": ("greatest tilting moment (N m)", 1.0),
}


def over_twist(rows: list[Row]) -> Figure:
    """Draw each quantity over the twist, one line per number of lobes."""
    figure, axes = sheet(11, 6.6, 2, 3, sharex=True)
    numbers = sorted({row["lobes"] for row in rows})
    for ax, (key, (label, factor)) in zip(axes.ravel(), _PANELS.items(), strict=True):
        for lobes, color, mark in zip(numbers, COLORS, MARKS, strict=False):
            own = [row for row in rows if row["lobes"] == lobes]
            values = [np.nan if row[key] is None else factor * row[key] for row in own]
            twists = [row["twist_deg"] for row in own]
            ax.plot(twists, values, color=color, marker=mark, ms=4, label=f"{lobes} lobes")
        ax.set(ylabel=label, ylim=(0, None))
    setp(axes[-1], xlabel="twist over the length (°)")
    entries = axes[0, 0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", ncols=3, frameon=False)
    return figure


def run(job: Run) -> None:
    """Evaluate every number of lobes at every twist; write and print the table.

    A reduced run has three lobes, two twists and two slices."""
    lobes, twists, slices = ((3,), (1e-9, 30.0), 2) if job.quick else (LOBES, TWISTS, _SLICES)
    rows: list[Row] = []
    for number, twist in itertools.product(lobes, twists):
        rows.append(evaluated(number, twist, slices))
        job.say(f"{number} lobes, {twist:.3g}°: {rows[-1]['status']}")
    job.csv("twist.csv", rows)
    job.figure("twist.png", over_twist(rows))
    show("Twisted rotors", rows)
