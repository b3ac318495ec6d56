"""Ripple, contact force and bearing load of EE rotors over twist and number of lobes.

The scene is that of `configs/ee.yaml` with gas instead of a constant torque, and with bearings. All
rotors have its pitch radius and length. The number of slices is fixed, so that all twists of one
number of lobes share a compiled program; straight rotors are those with a twist of a millionth of a
degree.
"""

from collections.abc import Callable
from typing import Any

from experiments._common.scenes import shipped
from rootsopt.config import Config
from rootsopt.pump.sheet import sheet
from rootsopt.response.evaluation import Evaluator
from rootsopt.scene import Scene, design_vector

Row = dict[str, Any]
LOBES = 2, 3, 4
TWISTS = 1e-6, 10.0, 20.0, 30.0, 45.0, 60.0, 75.0, 90.0
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


def config_of(lobes: int, twist: float, slices: int = _SLICES) -> Config:
    """Return the config of EE rotors with `lobes` and a `twist` (°)."""
    return shipped(
        "ee",
        f"profile.lobes={lobes}",
        "scene.load={pressure_difference_Pa: 6.0e4}",
        "scene.bearings={}",
        f"rotor.helix_deg={twist!r}",
        f"solver.slices={slices}",
    )


def evaluated(lobes: int, twist: float, slices: int) -> Row:
    """Return the row of one pair: ripple, forces and loads. Without an orbit, forces are `None`."""
    config = config_of(lobes, twist, slices)
    found = Evaluator.of(config)()
    rows = sheet(Scene.from_config(config), design_vector(config))
    row: Row = {"lobes": lobes, "twist_deg": round(twist, 3), "flow_ripple": rows["flow_ripple"]}
    row |= {name: found.response.get(name) for name in _FORCES}
    return row | {"status": found.status.label}


def run(quick: bool, say: Callable[[str], None] = lambda text: None) -> list[Row]:
    """Evaluate every number of lobes at every twist.

    A reduced run has three lobes, two twists and two slices."""
    lobes, twists, slices = ((3,), (1e-6, 30.0), 2) if quick else (LOBES, TWISTS, _SLICES)
    rows: list[Row] = []
    for number in lobes:
        for twist in twists:
            rows.append(evaluated(number, twist, slices))
            say(f"{number} lobes, {twist:.3g}°: {rows[-1]['status']}")
    return rows
