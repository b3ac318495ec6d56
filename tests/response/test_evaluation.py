"""Columns and map errors of an evaluation agree with numbers made up for the test."""

import jax.numpy as jnp
import numpy as np
import pytest
from rootsopt.contact.size import MapSize

from rootsopt.config import load
from rootsopt.dynamics.flanks import FlankForce
from rootsopt.output import files
from rootsopt.response import evaluation, series
from rootsopt.response.evaluation import Evaluator
from tests.standins import oscillator


def test_series_has_drive_and_coast_where_they_belong(monkeypatch):
    """The drive flank's force of the contact is in the file's drive column."""
    count = 5
    tau, states = np.arange(count) / count, np.zeros((count, 2))
    one = np.arange(1.0, count + 1)
    contact = FlankForce(
        drive=one, coast=10 * one, depth=2 * one, closing=3 * one, lever1=4 * one, lever2=5 * one,
        torque1=6 * one, torque2=7 * one,
    )  # fmt: skip
    physical = 0.2 * one, 0.3 * one
    monkeypatch.setattr(
        series, "contact_series", lambda *args: (0.02, np.ones(count), physical, contact)
    )
    columns = files.response_columns(series.series_of(oscillator(), tau, states))
    expected = {
        "time_s": 0.02 * tau,
        "rotation_deg": 120 * tau,  # three lobes
        "relative_rotation_rad": 0.2 * one,
        "relative_speed_rad_s": 0.3 * one,
        "drive_flank_force_N": one,
        "coast_flank_force_N": 10 * one,
        "contact_force_N": 11 * one,
    }
    assert list(columns) == list(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(columns[name], values, rtol=1e-14, err_msg=name)


def test_stated_error_of_a_map_is_relative_to_the_static_depth(monkeypatch):
    """`map_error` is the error of the penetration over the static depth: F = K δ^e."""
    config = load("configs/cic.yaml", ["solver.fidelity=map", "solver.map_error=2e-3"])
    evaluator = Evaluator.of(config)
    depth = 1e-3 * (4.775 / 33e-3 / 2e5) ** (1 / 2.2)
    asked = []

    def size_map(profile, deepest, error):
        asked.append(error)
        return MapSize(256, 24, 0.7 * error, True)

    monkeypatch.setattr(evaluation, "size_map", size_map)
    sized = evaluator._sized(jnp.array([36.43, 8.0, 4.0]))
    assert asked == pytest.approx([2e-3 * depth])
    assert sized.map_error == pytest.approx(1.4e-3)
    assert sized.scene.map_size == (256, 24)
    # The evaluator that was asked stays as it was.
    assert np.isnan(evaluator.map_error)
