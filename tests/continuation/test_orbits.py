"""Tests of steps and gaps of a continued orbit, from made-up integrations."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.continuation import orbits
from rootsopt.continuation.arclength import StepSizes
from rootsopt.dynamics.flow import Flow
from rootsopt.dynamics.measures import Measures


def test_long_steps_of_an_orbit_are_divided():
    """No step of a continued orbit is longer than 1/256 mesh period and a quarter.

    Existing step ends are kept. No step end is added within a quarter of another one, or beyond the
    orbit."""
    given = np.array([0.3 / 256, 2.1 / 256, 0.1, 0.1001, 1.0, 1.5])
    grid = np.concatenate([given, np.full(1024 - len(given), np.inf)])
    made = np.asarray(orbits._without_long(jnp.asarray(grid), jnp.asarray(1.5)))
    assert len(made) == 1024
    ends = made[np.isfinite(made)]
    assert np.all(np.isin(given, ends))
    steps = np.diff(ends, prepend=0.0)
    assert np.max(steps) <= 1.25 / 256 + 1e-15
    added = ends[~np.isin(ends, given)]
    np.testing.assert_allclose(256 * added, np.round(256 * added), atol=1e-12)
    assert np.min(np.abs(added[:, None] - np.append(given, 0.0))) > 0.25 / 256
    assert np.max(added) < 1.5


@pytest.mark.parametrize("period", [1, 3])
def test_longest_gap_of_an_orbit_is_in_mesh_periods(monkeypatch, period):
    """A quarter of an orbit of k mesh periods without a touch lasts k/4 mesh periods."""
    touching = np.ones(504, bool)
    touching[100:226] = False
    out = Flow.empty(2, 1, 4, 4, Measures(), jnp.zeros(0).dtype)._replace(
        solved=np.asarray(True), depth=np.asarray(1e-6), mean_square=np.asarray(25.0),
        mean=np.asarray(3.0), peak=np.asarray(9.0), end=np.array([0.4, -0.2]),
        states=np.array([[0.4, -0.2], [0.6, 0.1], [-0.7, 0.3], [0.2, 0.2]]),
    )  # fmt: skip
    shot = orbits._Shot(out, np.zeros(4), np.asarray(False), touching, np.asarray(2e-3))
    subject = object.__new__(orbits.OrbitFamily)
    subject.period, subject.unit, subject.width = period, 1e-3, 200.0
    subject.limits = StepSizes(100.0, 300.0)
    subject.scene = types.SimpleNamespace(pitch_radius=0.033)
    monkeypatch.setattr(orbits.OrbitFamily, "_check_design", lambda self, value: None)
    monkeypatch.setattr(orbits.OrbitFamily, "_shot", lambda self, *args, **options: shot)
    look = subject(np.array([0.4, -0.2, 0.5 * orbits.SPAN]) / orbits.SPAN, None, False)
    seen = look.data
    assert seen.gap_time == pytest.approx(period / 4)
    np.testing.assert_allclose(seen.statistics, [3.0, 9.0, 5.0])
    # In the units of a config whose angle scale is twice that of the curve.
    np.testing.assert_allclose(seen.state, [0.2, -0.1])
    assert seen.reach == pytest.approx(0.7e-3)
    assert seen.half_way == pytest.approx(1.1 / orbits.SPAN)
    assert seen.residual == pytest.approx(0, abs=1e-15)
    point = subject.point(orbits.Spot(np.array([0.02, -0.01, 0.5]), np.eye(3)[-1], look, 2))
    assert (point.value, point.period, point.gap_time) == (200.0, period, seen.gap_time)
    np.testing.assert_allclose(np.sort(np.abs(point.multipliers)), [0, 0])
