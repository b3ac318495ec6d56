"""Configs and names that several studies use."""

from rootsopt.config import Config, load

# The shipped CIC pair with flanks as drawn, relative to the repository root.
CIC = "configs/cic_drawn.yaml"

# The same pair with a clearance, and with limits that make every design pump and seal as it does.
FAIR = "configs/cic.yaml"

# Names of the forces that most studies compare, and of all forces with a gradient.
FORCES = ("mean_force_N", "peak_force_N")
MEASURES = (*FORCES, "rms_force_N")

# Overrides that give a stable orbit of two mesh periods which is sensitive to changes.
SHAKY = (
    "scene.speed_rpm=1700",
    "scene.load.torque_N_m=3",
    "scene.timing_gear.backlash_mm=0.25",
    "scene.timing_gear.damping_ratio=0.3",
    "scene.timing_gear.stiffness_N_m_per_rad=9000",
    "profile.pressure_angle_deg=30.7",
    "profile.involute_length_mm=4",
    "profile.tip_arc_angle_deg=1.5",
)


def shipped(name: str, *overrides: str) -> Config:
    """Load `configs/NAME.yaml` with overrides, each `dotted.key=value`; `cic`: flanks as drawn."""
    return load(f"configs/{name}.yaml" if name != "cic" else CIC, list(overrides))
