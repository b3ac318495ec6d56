"""Rounding the corners of contact law and timing gear does not change the forces."""

from pathlib import Path

import numpy as np
import pytest

from experiments.smoothing import DEFAULT, LIMIT, SHAKY
from rootsopt.config import load
from rootsopt.config.scene import ContactConfig
from rootsopt.evaluate import Evaluator
from rootsopt.status import Status

FORCES = ("mean_force_N", "peak_force_N", "rms_force_N")
SCENES = {
    "shipped": ("cic", ()),
    "period two": ("cic", SHAKY),
    "the paper's": ("paper_cic", ()),
    "stiff gear, little load": (
        "cic",
        (
            "scene.speed_rpm=1313",
            "scene.load.torque_N_m=1.05",
            "scene.timing_gear.stiffness_N_m_per_rad=7.6e5",
            "scene.timing_gear.damping_ratio=0.11",
            "scene.timing_gear.backlash_mm=0.077",
        ),
    ),
}
SHARPER = 3e-7
"""Smoothing length (mm) of the reference: the bias falls faster than in proportion."""


def forces(name, *changes):
    path, own = SCENES[name]
    found = Evaluator(load(f"configs/{path}.yaml", [*own, *changes]))(series=False)
    assert found.status is Status.PERIODIC
    return np.array([found.response[key] for key in FORCES])


@pytest.mark.parametrize("name", SCENES)
def test_default_smoothing_does_not_change_the_forces(name):
    """Mean, peak and RMS force by less than 1e-4 (experiments/smoothing.py looks at many more
    scenes). A rounding that lacks damping changes those of the period-two orbit by 4e-4."""
    sharp = forces(name, f"contact.smoothing_mm={SHARPER}")
    np.testing.assert_allclose(forces(name), sharp, rtol=LIMIT)


def test_shipped_configs_have_the_default():
    """The length that was measured is the one that is used."""
    assert ContactConfig.model_fields["smoothing_mm"].default == DEFAULT
    shipped = sorted(Path("configs").glob("*.yaml"))
    assert len(shipped) >= 6
    assert {load(path).contact.smoothing_mm for path in shipped} == {DEFAULT}
