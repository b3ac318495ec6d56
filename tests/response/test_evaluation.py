"""Columns of an evaluation agree with numbers made up for the test."""

import numpy as np

from rootsopt.dynamics.flanks import FlankForce
from rootsopt.response import records
from rootsopt.view import files
from tests.standins import oscillator


def test_series_has_drive_and_coast_where_they_belong(monkeypatch):
    """The drive flank's force of the contact is in the file's drive column."""
    count = 5
    tau, states = np.arange(count) / count, np.zeros((count, 2))
    one = np.arange(1.0, count + 1)
    contact = FlankForce(
        drive=one, coast=10 * one, depth=2 * one, lever2=5 * one, torque1=6 * one, torque2=7 * one,
    )  # fmt: skip
    physical = 0.2 * one, 0.3 * one
    monkeypatch.setattr(
        records, "contact_series", lambda *args: (0.02, np.ones(count), physical, contact)
    )
    columns = files.response_columns(records.series_of(oscillator(), tau, states))
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
