"""Estimates, errors and intervals of models that are known in closed form, against SciPy."""

import numpy as np
import pandas
import pytest
from scipy.optimize import brentq, curve_fit, least_squares

from rootsopt import load_config
from rootsopt.identification import squares
from rootsopt.identification.answer import Spread, combinations, profile, structure
from rootsopt.identification.model import Fitted, Point, Predicted
from rootsopt.identification.record import Observed
from rootsopt.identification.squares import Problem
from rootsopt.status import Status

X = np.linspace(0, 3, 80)
NAME = "contact_force_N"


def problem_of(model, data, monkeypatch, deviation=None, count=2, gains=(), constants=()):
    """Return the problem of fitting `model(θ, x)` to `data`, with difference quotients as slopes.

    The scale of a quantity is the quantity itself."""
    given = {} if deviation is None else {f"{NAME}_std": deviation}
    columns = {"rotation_deg": X, NAME: data} | given
    seen = Observed("test", {}, pandas.DataFrame(columns), (NAME,), True)
    quantities = [Fitted(f"q{k}", -50.0, 50.0, 0.0, 1.0, 0.5, False) for k in range(count)]

    def predict(points, quantities, values, begins):
        steps = 1e-6 * np.eye(count)
        slopes = [(model(values + h, X) - model(values - h, X)) / 2e-6 for h in steps]
        value, slope = model(values, X)[:, None], np.stack(slopes, axis=-1)[:, None]
        return [Predicted(Status.PERIODIC, value, slope, 0.0 * value)]

    monkeypatch.setattr(squares, "predict", predict)
    return Problem.of([Point(load_config("cic"), seen)], quantities, gains, constants)


def wave(values, x):
    return values[0] * np.exp(-values[1] * x)


def noisy(size, values=(1.5, 0.8)):
    return wave(values, X) + size * np.random.default_rng(0).standard_normal(len(X))


def solved(problem, *start, **settings):
    """Return the end of a local fit from a place, by default (1, 1)."""
    return problem.fitted(np.array(start or (1.0, 1.0)), [None], problem.estimated(), **settings)


def test_errors_are_those_of_known_standard_deviations(monkeypatch):
    deviation = 0.02 + 0.02 * X
    data = noisy(deviation)
    problem = problem_of(wave, data, monkeypatch, deviation)
    best = solved(problem)
    values, covariance = curve_fit(
        lambda x, *v: wave(v, x), X, data, [1.0, 1.0], sigma=deviation, absolute_sigma=True
    )
    spread = Spread.of(problem, best)
    np.testing.assert_allclose(best.values, values, rtol=1e-5)
    np.testing.assert_allclose(spread.covariance, covariance, rtol=1e-3)
    assert spread.width == pytest.approx(1.96, abs=0.01)
    assert abs(structure(problem, best)) < 3


def test_errors_without_standard_deviations_are_those_of_leaving_out_one_value(monkeypatch):
    """HC3 is the sum over all values of what leaving one out changes, to first order."""
    problem = problem_of(wave, noisy(0.05 * (X > 1.5)), monkeypatch)
    best = solved(problem, turn=1e9)
    kept = [np.arange(len(X)) != k for k in range(len(X))]
    moved = np.array([np.linalg.lstsq(best.slopes[k], -best.residual[k], None)[0] for k in kept])
    np.testing.assert_allclose(Spread.of(problem, best).covariance, moved.T @ moved, rtol=2e-3)


def test_gain_and_constant_are_eliminated(monkeypatch):
    data = 7.0 * noisy(0.02, (1.0, 0.8)) - 2.0
    problem = problem_of(
        lambda values, x: wave([1.0, values[0]], x), data, monkeypatch, 0.3 + 0 * X, 1,
        [[NAME]], [NAME],
    )  # fmt: skip
    best = solved(problem, 0.3)
    whole = least_squares(lambda v: (v[1] * wave([1.0, v[0]], X) + v[2] - data) / 0.3, [1, 1, 0])
    np.testing.assert_allclose([*best.values, *best.gains], whole.x, rtol=1e-5)
    covariance = np.linalg.inv(whole.jac.T @ whole.jac)
    assert Spread.of(problem, best).covariance[0, 0] == pytest.approx(covariance[0, 0], rel=1e-3)


def test_outliers_hardly_count(monkeypatch):
    data = noisy(0.02)
    data[::20] += 3.0
    problem = problem_of(wave, data, monkeypatch)
    best = solved(problem, turn=1.0)
    for _ in range(3):
        deviation = problem.estimated(best.fit - problem.rows.measured.to_numpy())
        best = problem.fitted(best.place, [None], deviation)
    plain, _ = curve_fit(lambda x, *v: wave(v, x), X, data, [1.0, 1.0])
    assert np.abs(best.values - [1.5, 0.8]).max() < 0.1 * np.abs(plain - [1.5, 0.8]).max()
    assert 0.015 < deviation[0] < 0.05


def test_an_interval_ends_where_the_loss_has_risen(monkeypatch):
    deviation = 0.2 + 0 * X
    data = noisy(deviation)
    problem = problem_of(wave, data, monkeypatch, deviation)
    best = solved(problem)
    found = profile(problem, best, Spread.of(problem, best), 1, fine=True)

    def rise(b):
        shape = np.exp(-b * X)
        a = shape @ data / (shape @ shape)
        return np.sum(((a * shape - data) / 0.2) ** 2) - 2 * best.cost - 1.96**2

    ends = [brentq(rise, end, best.values[1]) for end in (0.1, 3.0)]
    np.testing.assert_allclose(found["interval_95"], ends, rtol=0.04)
    assert len(found["points"]) > 8


@pytest.mark.parametrize("count", [1, 80])
def test_what_the_record_cannot_tell_is_named(count, monkeypatch):
    """A sum of two quantities, from many values or from a single one."""
    data = np.where(np.arange(80) < count, 1 + X + 0.01 * np.sin(1e3 * X), np.nan)
    problem = problem_of(lambda v, x: v[0] + v[1] + x, data, monkeypatch)
    best = solved(problem, 0.1, 0.2)
    assert np.sum(best.values) == pytest.approx(1.0, abs=0.01)
    spread = Spread.of(problem, best)
    first, second = combinations(problem, spread)
    assert (first["determined"], second["words"]) == (False, "q0 and q1 together")
    assert first["words"] in ("q0, against q1", "q1, against q0")
    assert np.isinf(spread.errors).all()
    assert profile(problem, best, spread, 0, fine=False)["interval_95"] == [-50, 50]
