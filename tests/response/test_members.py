"""Averages of an ensemble's members and columns of a series, from motions made up for the test."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.dynamics.flanks import FlankForce
from rootsopt.dynamics.flow import Period
from rootsopt.dynamics.integrator import Integrator
from rootsopt.response import ensemble, records, together
from rootsopt.response.together import Members
from rootsopt.view import files
from tests.standins import oscillator


def told_flow(state, means):
    """Return a mesh period whose force has the mean `means[k]`; k, the first state, grows by 1."""
    at = jnp.round(state[0]).astype(int)
    mean = jnp.asarray(means)[at]
    return Period(
        end=state.at[0].add(1.0).at[1].set(at % 3 + 0.001 * at),
        response=jnp.stack([mean, 2 * mean**2, 3 * mean + at % 2]),
        states=jnp.stack([state, -2 * state]),
        depth=-mean,
        solved=jnp.asarray(True),
        duration=jnp.ones(()),
    )


def test_averages_of_a_member(monkeypatch):
    """Means, greatest values and drift of a window after `settle` periods agree with NumPy.

    The drift is positive where the force rises. The middle of an odd window belongs to neither
    half."""
    settle = 3
    means = np.random.default_rng(0).uniform(1, 2, 20) + np.arange(20)
    monkeypatch.setattr(together, "one_period", lambda pair, state, *rest: told_flow(state, means))
    monkeypatch.setattr(
        together,
        "strobe",
        lambda pair, state, *rest: types.SimpleNamespace(
            states=state[None].at[0, 0].add(1.0), solved=jnp.asarray(True)
        ),
    )
    averages = averages_from(jnp.zeros(2))
    for periods in (1, 2, 7, 12):
        found = averages(settle, periods)
        at = settle + np.arange(periods)
        window = means[at]
        peaks = 3 * window + at % 2
        expected = [np.mean(window), np.mean(2 * window**2), np.mean(peaks)]
        np.testing.assert_allclose(found.means, expected, rtol=1e-12)
        half = periods // 2
        drift = np.mean(window[-half:]) - np.mean(window[:half]) if half else 0.0
        assert float(found.drift) == pytest.approx(drift, rel=1e-12)
        extremes = float(found.greatest), float(found.depth), float(found.states[0])
        assert extremes == pytest.approx((np.max(peaks), np.max(-window), settle + periods))
        flags = bool(np.any(found.repeats)), bool(found.stalled), bool(found.solved)
        assert flags == (False, False, True)


def averages_from(state):
    """Return a function (settle, periods) → averages of a member that starts from `state`."""
    pair, how = oscillator(), Integrator("tsit5", jnp.asarray(1e-6), 64)
    run = jax.jit(lambda *counts: together.member(pair, state, *counts, how))
    return lambda settle, periods: run(jnp.asarray(settle), jnp.asarray(periods))


def test_a_member_repeats_after_its_period(monkeypatch):
    """The last states of a motion of three mesh periods repeat after 3 and 6, not after others."""

    def step(state):
        return jnp.array([0.5, 0.0]).at[1].set((jnp.round(state[1]) + 1) % 3)

    blank = told_flow(jnp.zeros(2), [1.0])
    monkeypatch.setattr(
        together, "one_period", lambda pair, state, *rest: blank._replace(end=step(state))
    )
    averages = averages_from(jnp.zeros(2))
    # A cycle of k counts once the last k + 1 states have been there k mesh periods before.
    for periods, seen in ((40, [2, 5]), (13, [2, 5]), (12, [2]), (7, [2]), (6, [])):
        assert np.flatnonzero(averages(0, periods).repeats).tolist() == seen


def of_means(means) -> Members:
    """Return members of which only the means are given."""
    zero, no = np.zeros(len(means)), np.zeros(len(means), bool)
    return Members(means, zero, zero, zero, zero[:, None], no[:, None], no, no, ~no)


def test_standard_errors_of_members_are_their_scatter():
    """Mean, peak and RMS of 4000 ensembles of independent members scatter as stated."""
    rng, size = np.random.default_rng(7), (4000, 24)
    level = 5 + rng.normal(size=size)
    square = level**2 + rng.gamma(4.0, 1.5, size=size)
    peak = 20 + 3 * rng.normal(size=size)
    every = np.stack([level, square, peak], axis=-1)
    values, errors = np.moveaxis([of_means(one).responses for one in every], -1, 0)
    np.testing.assert_allclose(values[0, :2], [np.mean(level[0]), np.mean(peak[0])])
    np.testing.assert_allclose(values[0, 2], np.sqrt(np.mean(square[0])))
    stated = np.sqrt(np.mean(errors**2, axis=0))
    np.testing.assert_allclose(stated, np.std(values, axis=0, ddof=1), rtol=0.05)
    assert of_means(np.zeros((3, 3))).responses.tolist() == np.zeros((3, 2)).tolist()


def test_slopes_and_errors_per_config_unit():
    """Slopes in the unit box become slopes per config unit, with the stated mean and scatter.

    dR/dp = dR/dx (dp/dx)⁻¹, with a Jacobian that is far from symmetric."""
    rng = np.random.default_rng(11)
    jacobian = np.array([[2.0, 0.0, 0.0], [1.5, 0.5, 0.0], [-4.0, 1.0, 3.0]])
    slope, roots = (rng.normal(size=size) for size in ((2, 3), (2, 3, 3)))
    covariance = roots @ roots.transpose(0, 2, 1)
    found, errors = ensemble.per_config_unit(slope, covariance, jacobian)
    for k in range(2):
        drawn = rng.multivariate_normal(slope[k], covariance[k], size=40_000)
        # One solution for each: x jacobian = drawn.
        moved = np.linalg.solve(jacobian.T, drawn.T)
        scatter = np.std(moved, axis=1)
        np.testing.assert_allclose(errors[k], scatter, rtol=0.03)
        assert np.all(np.abs(found[k] - np.mean(moved, axis=1)) < 5 * scatter / 200)


# Series


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
