"""Tables of a record: what each column holds, and what is refused."""

import numpy as np
import pytest
import xarray

from rootsopt import load_config
from rootsopt.identification.model import fitted
from rootsopt.identification.record import observed
from rootsopt.scene.space import bounds_of
from tests.standins import refusal

CIC = load_config("cic")


def points_of(text, folder):
    (folder / "record.csv").write_text(text)
    return observed(CIC, str(folder / "record.csv"))


def test_a_table_holds_samples_at_several_operating_points(tmp_path):
    text = (
        "# from the encoders\ncontact_force_N;scene.speed_rpm;rotation_deg;contact_force_N_sd\n"
        "1,5;1000;720;0,1\n;1000;725;0,1\n2;2000;3;0,2\nn/a;2000;4;0,2\n"
    )
    one, two = points_of(text, tmp_path)
    assert (one.values, two.values) == ({"scene.speed_rpm": 1000}, {"scene.speed_rpm": 2000})
    assert (one.names, one.sampled) == (("contact_force_N",), True)
    assert (one.column().tolist(), one.measured.tolist()) == ([720.0], [[1.5]])
    assert two.rows().given.tolist() == [0.2]


def test_a_table_holds_averages_with_a_row_per_point(tmp_path):
    text = "profile.family,profile.pressure_angle_deg,mean_force_N\ncic,36,100\nee,,1e3\n"
    one, two = points_of(text, tmp_path)
    assert two.values == {"profile.family": "ee", "profile.pressure_angle_deg": None}
    assert (one.sampled, one.measured.tolist()) == (False, [[100.0]])


def test_rotation_follows_from_time_and_state_from_the_samples(tmp_path):
    """ε = 1e-3 sin(t / 1 ms) at 3000 rpm, from a rotation that is no start of a mesh period."""
    time = np.linspace(0.002, 0.03, 1000)
    data = {"time_s": time, "relative_rotation_rad": 1e-3 * np.sin(1e3 * time)}
    (one,) = observed(CIC, data)
    np.testing.assert_allclose(one.column(), 18_000 * time)
    relative, rate = one.state(3, 1, 120 / 18_000, 0.0)
    assert one.timed
    assert abs(rate) == pytest.approx(np.cos(np.arcsin(relative / 1e-3)), abs=1e-3)
    starts = np.arange(1, 5) * 120 / 18_000
    assert np.min(np.abs(relative - 1e-3 * np.sin(1e3 * starts))) < 3e-5
    assert observed(CIC, xarray.Dataset({"mean_force_N": 76.0}))[0].measured.tolist() == [[76.0]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "must have a measured column"),
        ("mean_force_N\n", "must hold measured values"),
        ("meanforce_N\n1\n", "did you mean mean_force_N?"),
        ("rotation_deg,mean_force_N\n0,1\n", "must be a sample"),
        ("angle,contact_force_N\n0,1\n", "need a column rotation_deg or time_s"),
        ("time_s\n0\n1\n", "must have a measured column"),
        ("rotation_deg,contact_force_N\n0,\n1,nan\n", "must hold measured values"),
        ("scene.sped_rpm,mean_force_N\n1,1\n", "did you mean scene.speed_rpm?"),
        ("scene.speed_rpm,mean_force_N\n-5,1\n", "`scene.speed_rpm` must be greater than 0"),
        ("mean_force_N\n1\nx\n", "line 3: mean_force_N must be a number, but is 'x'"),
        ("mean_force_N,mean_force_N_std\n1,0\n", "mean_force_N_std must be a number greater"),
        ("mean_force_N,mean_force_N\n1,2\n", "must name each column once"),
        ("line_0.001_force_N\n1\n", "an order from 0.01 to 1000"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused(text, said, tmp_path):
    assert said in refusal(points_of, text, tmp_path)


def test_a_file_that_cannot_be_read_is_refused():
    assert "must be a file that can be read" in refusal(observed, CIC, "none.csv")


def test_bounds_follow_from_the_key():
    keys = "scene.timing_gear.backlash_mm", "scene.phase_error_mrad", "profile.pressure_angle_deg"
    _, (backlash, phase, angle) = fitted(CIC, keys, [])
    assert (backlash.low, backlash.high, backlash.begin, backlash.own) == (0, 50, 0.02, 0.1)
    assert (phase.low, phase.high, phase.own) == (-100, 100, 0)
    assert (angle.low, angle.high) == tuple(bounds_of(CIC)[0])
    _, (one,) = fitted(CIC, ["scene.timing_gear.stiffness_N_m_per_rad=1e3:1e6"], [])
    assert one.log
    values = one.value(0.5), one.value(one.scaled(2e4))
    assert values == pytest.approx((10**4.5, 2e4))
    step = one.value(0.5 + 1e-6) - one.value(0.5 - 1e-6)
    assert one.slope(10**4.5) == pytest.approx(step / 2e-6, rel=1e-6)


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("backlash=0:1", "did you mean `scene.timing_gear.backlash_mm`?"),
        ("profile.lobes=2:3", "which cannot vary"),
        ("scene.timing_gear.backlash_mm=0:60", "must be at most 50"),
        ("scene.timing_gear.backlash_mm=0.1", "must have two bounds"),
        ("scene.timing_gear.backlash_mm=0.4:0.1", "a lower bound below the upper one"),
        ("rotation_offset_deg=10:-10", "a lower bound below the upper one"),
        ("scene.supports.stiffness_N_per_mm", "has no value in the config"),
        ("scene.supports.stiffness_N_per_mm=1e3:1e5", "damping_N_s_per_mm` is missing"),
        ("scene.speed_rpm=1:2", "the record has a column of its values"),
        ({"scene.load.torque_N_m": (1, np.inf)}, "must have two finite bounds, but has (1, inf)"),
        ({"scene.load.torque_N_m": 3}, "must have two finite bounds, but has 3"),
        ({}, "no quantity to fit is named"),
    ],
)
def test_a_key_that_cannot_be_fitted_is_refused(key, said):
    keys = key if isinstance(key, dict) else [key]
    assert said in refusal(fitted, CIC, keys, ["scene.speed_rpm"])
