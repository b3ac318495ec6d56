"""Tables of a record: what columns hold, what is refused; estimates and errors from values."""

import numpy as np
import pandas
import pytest
import xarray
from scipy.optimize import brentq, curve_fit, least_squares

from rootsopt import load_config
from rootsopt.identification import squares
from rootsopt.identification.answer import Spread, combinations, profile, structure
from rootsopt.identification.model import Fitted, Point, Predicted, fitted
from rootsopt.identification.record import Observed, observed
from rootsopt.identification.squares import Problem
from rootsopt.scene.space import bounds_of
from rootsopt.status import Status
from tests.standins import refusal

CIC = load_config("cic")


def points_of(text, folder):
    (folder / "record.csv").write_text(text)
    return observed(CIC, str(folder / "record.csv"))


def test_a_table_holds_samples_or_averages_at_several_operating_points(tmp_path):
    text = (
        "# from the encoders\ncontact_force_N;scene.speed_rpm;rotation_deg;contact_force_N_sd\n"
        "1,5;1000;720;0,1\n;1000;725;0,1\n2;2000;3;0,2\nn/a;2000;4;0,2\n"
    )
    one, two = points_of(text, tmp_path)
    assert (one.values, two.values) == ({"scene.speed_rpm": 1000}, {"scene.speed_rpm": 2000})
    assert (one.names, one.sampled) == (("contact_force_N",), True)
    assert (one.column().tolist(), one.measured.tolist()) == ([720.0], [[1.5]])
    assert two.rows().given.tolist() == [0.2]
    text = "profile.family,profile.pressure_angle_deg,mean_force_N\ncic,36,100\nee,,1e3\n"
    one, two = points_of(text, tmp_path)
    assert two.values == {"profile.family": "ee", "profile.pressure_angle_deg": None}
    assert (one.sampled, one.measured.tolist()) == (False, [[100.0]])


def test_rotation_follows_from_time_and_state_from_the_samples(tmp_path):
    """ε = 1e-3 sin(t / 1 ms) at 3000 rpm, from a rotation that is no start of a mesh period."""
    time = np.linspace(0.002, 0.03, 1000)
    (one,) = observed(CIC, {"time_s": time, "relative_rotation_rad": 1e-3 * np.sin(1e3 * time)})
    assert one.timed
    np.testing.assert_allclose(one.column(), 18_000 * time)
    relative, rate = one.state(3, 1, 120 / 18_000, 0.0)
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


def test_bounds_follow_from_the_key():
    keys = "scene.timing_gear.backlash_mm", "scene.phase_error_mrad", "profile.pressure_angle_deg"
    _, (backlash, phase, angle) = fitted(CIC, keys, [])
    assert (backlash.low, backlash.high, backlash.begin, backlash.own) == (0, 50, 0.02, 0.1)
    assert (phase.low, phase.high, phase.own) == (-100, 100, 0)
    assert (angle.low, angle.high) == tuple(bounds_of(CIC)[0])
    _, (one,) = fitted(CIC, ["scene.timing_gear.stiffness_N_m_per_rad=1e3:1e6"], [])
    assert one.log
    assert [one.value(0.5), one.value(one.scaled(2e4))] == pytest.approx([10**4.5, 2e4])
    assert one.slope(10**4.5) == pytest.approx(
        (one.value(0.5 + 1e-6) - one.value(0.5 - 1e-6)) / 2e-6, rel=1e-6
    )


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
    assert said in refusal(
        fitted, CIC, key if isinstance(key, dict) else [key], ["scene.speed_rpm"]
    )


# Estimates, errors and intervals of models that are known in closed form, against SciPy


X = np.linspace(0, 3, 80)
NAME = "contact_force_N"


def problem_of(model, data, monkeypatch, deviation=None, count=2, gains=(), constants=()):
    """Return the problem of fitting `model(θ, x)` to `data`, with difference quotients as slopes.

    The scale of a quantity is the quantity itself."""
    given = {} if deviation is None else {f"{NAME}_std": deviation}
    seen = Observed(
        "test", {}, pandas.DataFrame({"rotation_deg": X, NAME: data} | given), (NAME,), True
    )
    quantities = [Fitted(f"q{k}", -50.0, 50.0, 0.0, 1.0, 0.5, False) for k in range(count)]

    def predict(points, quantities, values, begins):
        steps = 1e-6 * np.eye(count)
        slopes = [(model(values + h, X) - model(values - h, X)) / 2e-6 for h in steps]
        value, slope = model(values, X)[:, None], np.stack(slopes, axis=-1)[:, None]
        return [Predicted(Status.PERIODIC, value, slope, 0.0 * value)]

    monkeypatch.setattr(squares, "predict", predict)
    return Problem.of([Point(CIC, seen)], quantities, gains, constants)


def wave(values, x):
    return values[0] * np.exp(-values[1] * x)


def noisy(size, values=(1.5, 0.8)):
    return wave(values, X) + size * np.random.default_rng(0).standard_normal(len(X))


def solved(problem, *start, **settings):
    """Return a problem, and the end of a local fit from a place, by default (1, 1)."""
    begin = np.array(start or (1.0, 1.0))
    return problem, problem.fitted(begin, [None], problem.estimated(), **settings)


def test_errors_are_those_of_known_standard_deviations(monkeypatch):
    deviation = 0.02 + 0.02 * X
    data = noisy(deviation)
    problem, best = solved(problem_of(wave, data, monkeypatch, deviation))
    values, covariance = curve_fit(
        lambda x, *v: wave(v, x), X, data, [1.0, 1.0], sigma=deviation, absolute_sigma=True
    )
    np.testing.assert_allclose(best.values, values, rtol=1e-5)
    spread = Spread.of(problem, best)
    np.testing.assert_allclose(spread.covariance, covariance, rtol=1e-3)
    assert spread.width == pytest.approx(1.96, abs=0.01)
    assert abs(structure(problem, best)) < 3


def test_errors_without_standard_deviations_are_those_of_leaving_out_one_value(monkeypatch):
    """HC3 is the sum over all values of what leaving one out changes, to first order."""
    problem, best = solved(problem_of(wave, noisy(0.05 * (X > 1.5)), monkeypatch), turn=1e9)
    kept = [np.arange(len(X)) != k for k in range(len(X))]
    moved = np.array([np.linalg.lstsq(best.slopes[k], -best.residual[k], None)[0] for k in kept])
    np.testing.assert_allclose(Spread.of(problem, best).covariance, moved.T @ moved, rtol=2e-3)


def test_gain_and_constant_are_eliminated(monkeypatch):
    data = 7.0 * noisy(0.02, (1.0, 0.8)) - 2.0
    problem, best = solved(
        problem_of(lambda values, x: wave([1.0, values[0]], x), data, monkeypatch, 0.3 + 0 * X, 1,
                   [[NAME]], [NAME]),
        0.3,
    )  # fmt: skip
    whole = least_squares(lambda v: (v[1] * wave([1.0, v[0]], X) + v[2] - data) / 0.3, [1, 1, 0])
    np.testing.assert_allclose([*best.values, *best.gains], whole.x, rtol=1e-5)
    assert Spread.of(problem, best).covariance[0, 0] == pytest.approx(
        np.linalg.inv(whole.jac.T @ whole.jac)[0, 0], rel=1e-3
    )


def test_outliers_hardly_count(monkeypatch):
    data = noisy(0.02)
    data[::20] += 3.0
    problem, best = solved(problem_of(wave, data, monkeypatch), turn=1.0)
    for _ in range(3):
        deviation = problem.estimated(best.fit - problem.rows.measured.to_numpy())
        best = problem.fitted(best.place, [None], deviation)
    plain, _ = curve_fit(lambda x, *v: wave(v, x), X, data, [1.0, 1.0])
    assert np.abs(best.values - [1.5, 0.8]).max() < 0.1 * np.abs(plain - [1.5, 0.8]).max()
    assert 0.015 < deviation[0] < 0.05


def test_an_interval_ends_where_the_loss_has_risen(monkeypatch):
    data = noisy(0.2)
    problem, best = solved(problem_of(wave, data, monkeypatch, 0.2 + 0 * X))
    found = profile(problem, best, Spread.of(problem, best), 1, fine=True)

    def rise(b):
        shape = np.exp(-b * X)
        a = shape @ data / (shape @ shape)
        return np.sum(((a * shape - data) / 0.2) ** 2) - 2 * best.cost - 1.96**2

    np.testing.assert_allclose(
        found["interval_95"], [brentq(rise, end, best.values[1]) for end in (0.1, 3.0)], rtol=0.04
    )
    assert len(found["points"]) > 8


@pytest.mark.parametrize("count", [1, 80])
def test_what_the_record_cannot_tell_is_named(count, monkeypatch):
    """A sum of two quantities, from many values or from a single one."""
    data = np.where(np.arange(80) < count, 1 + X + 0.01 * np.sin(1e3 * X), np.nan)
    problem, best = solved(problem_of(lambda v, x: v[0] + v[1] + x, data, monkeypatch), 0.1, 0.2)
    assert np.sum(best.values) == pytest.approx(1.0, abs=0.01)
    spread = Spread.of(problem, best)
    first, second = combinations(problem, spread)
    assert (first["determined"], second["words"]) == (False, "q0 and q1 together")
    assert first["words"] in ("q0, against q1", "q1, against q0")
    assert np.isinf(spread.errors).all()
    assert profile(problem, best, spread, 0, fine=False)["interval_95"] == [-50, 50]
