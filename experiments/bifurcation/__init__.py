"""Which quiet and noisy orbits does a rotor pair have over speed, load, backlash and design?

Writes bifurcation.csv (all points), special_points.csv, bifurcation.json, bifurcation_speed.png,
bifurcation_scene.png and bifurcation_ranges.png, updated after every parameter.
"""

from experiments._common.driver import Study

STUDY = Study(
    quick="one start at one speed and one torque of one pair",
    published={
        f"bifurcation_{name}.png": f"bifurcation_{name}.png"
        for name in ("speed", "scene", "ranges")
    },
)
