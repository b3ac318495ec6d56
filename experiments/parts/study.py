"""Measures what each part of a scene costs.

The smallest scene is contact alone, driven at constant speed. The study adds each part on its own,
then all parts. It counts states, and times one right-hand side inside a compiled loop. Ratios are
relative to the smallest scene in the same run.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp

from experiments._common.driver import Run
from experiments._common.scenes import CIC, shipped
from experiments._common.simulation import pair_of_model
from experiments._common.tables import Row, show
from experiments._common.timing import ready, times_of
from rootsopt.config import Config, load
from rootsopt.scene import Scene, design_vector

# The flanks alone hold a light load at high speed. At lower speed, the lobes pass each other.
BARE = (
    "scene.timing_gear=null",
    "scene.speed_rpm=6000",
    "scene.load.torque_N_m=0.1",
    "profile.involute_length_mm=6",
)
GEAR = "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.5, backlash_mm: 0.1}"
PARTS = {
    "smallest": (),
    "timing gear": (GEAR,),
    "gear with phase error": (GEAR, "scene.phase_error_mrad=0.4"),
    "motor": ("scene.drive=torque", "scene.motor={slope_N_m_s_per_rad: 0.1}"),
    "gas load": ("scene.load={pressure_difference_Pa: 1000}",),
    "friction": ("contact.friction={}",),
    "centre distance error": ("scene.center_distance_error_mm=0.02",),
    "supports": ("scene.supports={stiffness_N_per_mm: 2.0e5, damping_N_s_per_mm: 5}",),
}


def right_hand_side(config: Config, calls: int) -> dict[str, float]:
    """Measure states, and time (µs) of a right-hand side along a slowly moving state."""
    pair = pair_of_model(Scene.from_config(config), design_vector(config))

    @eqx.filter_jit
    def many(pair, state):
        def call(k, y):
            return y + 1e-9 * pair.derivative(k / calls, y)[0]

        return jax.lax.fori_loop(0, calls, call, state)

    work = functools.partial(many, pair, jnp.full(pair.states, 0.05))
    ready(work())
    times, _ = times_of(lambda: ready(work()), 5)
    return {"states": pair.states, "rhs_us": 1e6 * min(times) / calls}


def run(job: Run) -> None:
    """Measure every part on its own, and all together; write and print a row for each.

    A reduced run measures three scenes, with few calls.
    """
    scenes = {name: load(CIC, [*BARE, *more]) for name, more in PARTS.items()}
    scenes["all of them"] = shipped("pump")
    if job.quick:
        scenes = {name: scenes[name] for name in ("smallest", "timing gear", "all of them")}
    rows: list[Row] = []
    for name, config in scenes.items():
        row: Row = {"part": name} | right_hand_side(config, 500 if job.quick else 20000)
        rows.append(row | {"rhs_ratio": row["rhs_us"] / (rows[0] if rows else row)["rhs_us"]})
        job.say(name)
    job.csv("parts.csv", rows)
    show("Parts of a scene", rows)
