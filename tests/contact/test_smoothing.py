"""Rounding the corners of contact law and timing gear does not change the forces."""

from pathlib import Path

import numpy as np
import pytest

from experiments._common.scenes import SHAKY
from rootsopt import Status, load_config
from rootsopt.response.evaluation import Evaluator

FORCES = ("mean_force_N", "peak_force_N", "rms_force_N")
STIFF = (
    "scene.speed_rpm=2965",
    "scene.load.torque_N_m=2.09",
    "scene.timing_gear.stiffness_N_m_per_rad=4.2e5",
    "scene.timing_gear.damping_ratio=0.38",
    "scene.timing_gear.backlash_mm=0.07",
)
SCENES = {
    "shipped": ("cic_drawn", ()),
    "period two": ("cic_drawn", SHAKY),
    "the paper's": ("paper_cic", ()),
    "stiff gear, little load": ("cic_drawn", STIFF),
}


def forces(name, *changes):
    path, own = SCENES[name]
    config = load_config(f"configs/{path}.yaml", [*own, *changes])
    found = Evaluator.of(config)(series=False)
    assert found.status is Status.PERIODIC
    return np.array([found.response[key] for key in FORCES]), config.contact.rounding_mm


@pytest.mark.parametrize("name", SCENES)
def test_default_smoothing_does_not_change_the_forces(name):
    """Mean, peak and RMS force change by less than 1e-4.

    Half the length removes at least half of a bias that falls in proportion or faster."""
    default, length = forces(name)
    half, _ = forces(name, f"contact.smoothing_mm={length / 2!r}")
    np.testing.assert_allclose(half, default, rtol=1e-4 / 2)


def length_of(*changes):
    return load_config("configs/cic_drawn.yaml", changes).contact.rounding_mm


def test_smoothing_length_follows_the_scene():
    """The length is 1e-4 mm in all shipped scenes, and less where gear or flanks deflect little.

    A given length is kept, and the resolved config contains the number."""
    shipped = sorted(Path("configs").glob("*.yaml"))
    assert len(shipped) >= 6
    assert {load_config(path).contact.rounding_mm for path in shipped} == {1e-4}
    assert length_of(*STIFF) == pytest.approx(0.05 * 2.09 / 4.2e5 * 33, rel=0.05)
    depth = (4.775 / 0.033 / 1e7) ** (1 / 2.2)
    for changes, found, within in (
        ("contact.stiffness_N_per_mm_e=1e7", min(1e-4, 0.02 * depth), 0.05),
        ("contact.full_damping_depth_mm=2e-4", 2e-5, 1e-6),
        ("scene.load.torque_N_m=0", 1e-6, 1e-6),
        ("contact.smoothing_mm=auto", 1e-4, 0),
        ("contact.smoothing_mm=3e-5", 3e-5, 0),
        ("contact.smoothing_mm=0", 0.0, 0),
    ):
        assert length_of(changes) == pytest.approx(found, rel=within, abs=0)
    assert f"smoothing_mm: {length_of(*STIFF)!r}" in load_config("cic_drawn", STIFF).to_yaml()
