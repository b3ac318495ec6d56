"""Tests of curves of orbits closed by collocation, against orbits closed by integration."""

import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.continuation import collocated
from rootsopt.continuation.arclength import End, StepSizes, StoppedError, _orientation, corrected
from rootsopt.continuation.branch import _family, follow
from rootsopt.continuation.collocated import CollocatedFamily, _Memory
from rootsopt.continuation.orbits import OrbitFamily
from rootsopt.response.evaluation import Evaluator

LIVELIER = (
    "scene.load.torque_N_m=4.775",
    "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.2, backlash_mm: 0.2}",
    "scene.speed_rpm=4000.0",
)
MOTOR = (
    "scene.drive=torque",
    "scene.motor={slope_N_m_s_per_rad: 0.1, inertia_kg_m2: 1.0e-3}",
)
CASES = {
    "cic, speed": ("cic", LIVELIER, "speed_rpm", (3740, 5000), (-0.235, -1.809)),
    "cic, involute": ("cic", (), "involute_length_mm", (5, 9), None),
    "ee, backlash": ("ee", (), "backlash_mm", (0.02, 0.4), None),
    "pump, pressure": ("pump", (), "pressure_difference_Pa", (1e4, 4e4), None),
    "motor, torque": ("cic", MOTOR, "torque_N_m", (1, 10), None),
}


def _started(name, overrides, parameter, ends, state):
    """Return the family of orbits of a case, and its first spot."""
    config = load(f"configs/{name}.yaml", list(overrides))
    start = None if state is None else np.array(state)
    found = Evaluator.of(config)(start=start, series=False)
    assert found.usable
    period = found.steady_state["period"]
    family = _family(config, parameter, period, StepSizes(*ends))
    assert isinstance(family, CollocatedFamily)
    place = family.place(found.state, family.values[family.index])
    fixed = np.eye(len(place))[-1]
    return family, corrected(family, place, fixed, fixed)


@pytest.fixture(scope="module")
def started():
    return _started(*CASES["cic, speed"])


def _compare(family, start):
    """Compare spots a little away from `start` with those by integration."""
    assert isinstance(start.look.memory, _Memory)
    by_integration = OrbitFamily(family.config, family.parameter, family.period, family.limits)
    near = start
    for step in (0.002, 0.005):
        guess = start.place + step * start.tangent
        near = corrected(family, guess, start.tangent, start.tangent, near)
        assert isinstance(near.look.memory, _Memory)
        other = corrected(by_integration, guess, start.tangent, start.tangent)
        np.testing.assert_allclose(near.place, other.place, atol=1e-7)
        np.testing.assert_allclose(near.tangent, other.tangent, atol=2e-5)
        assert _orientation(near) == _orientation(other)
        one, two = near.look.data, other.look.data
        np.testing.assert_allclose(one.statistics, two.statistics, rtol=2e-6)
        np.testing.assert_allclose(one.state, two.state, rtol=1e-5, atol=1e-6)
        first, second = (np.sort(np.abs(np.linalg.eigvals(data.monodromy))) for data in (one, two))
        np.testing.assert_allclose(first, second, atol=2e-5)
        assert one.depth == pytest.approx(two.depth, rel=1e-4)
        assert one.reach == pytest.approx(two.reach, rel=1e-4)
        assert one.gap_time == pytest.approx(two.gap_time, abs=family.period / 200)
        assert one.residual < 1e-9
        moved = one.to_state @ one.monodromy @ np.linalg.inv(one.to_state)
        largest = np.max(np.abs(two.monodromy))
        np.testing.assert_allclose(moved, two.monodromy, atol=5e-4 * largest)


def test_orbits_are_those_by_integration(started):
    _compare(*started)


@pytest.mark.long
@pytest.mark.parametrize("case", list(CASES)[1:])
def test_orbits_of_other_pairs_are_those_by_integration(case):
    _compare(*_started(*CASES[case]))


def test_plane_holds_the_place(started):
    """The orbit lies in the plane that was asked for, at a fixed parameter or across the curve."""
    family, start = started
    guess = start.place + 0.008 * start.tangent
    for across in (start.tangent, np.eye(3)[-1], np.eye(3)[1]):
        spot = corrected(family, guess, across, start.tangent, start)
        assert across @ (spot.place - guess) == pytest.approx(0, abs=1e-10)
        assert np.linalg.norm(spot.tangent) == pytest.approx(1)
        assert spot.tangent @ start.tangent > 0.99


def test_tangent_is_the_derivative_along_the_curve(started):
    family, start = started
    step = 1e-4
    ends = [
        corrected(
            family, start.place + s * step * start.tangent, start.tangent, start.tangent, start
        )
        for s in (1, -1)
    ]
    chord = ends[0].place - ends[1].place
    np.testing.assert_allclose(chord / np.linalg.norm(chord), start.tangent, atol=1e-5)


def test_orbit_that_collocation_misses_is_integrated_close_by(started, monkeypatch):
    """Far from the known orbit, a shorter step is asked for instead; other ends are final."""
    family, start = started
    ends = [End.STEP_TOO_SMALL]

    def fails(*args):
        raise StoppedError(ends[0])

    monkeypatch.setattr(family, "_followed", fails)
    integrated = start._replace(looks=99)
    monkeypatch.setattr(collocated, "by_newton", lambda *args: integrated)
    way = start.tangent
    near, far = start.place + 1e-3 * way, start.place + 1e-2 * way
    assert corrected(family, near, way, way, start) is integrated
    with pytest.raises(StoppedError, match="Newton"):
        corrected(family, far, way, way, start)
    ends[0] = End.TOO_DEEP
    with pytest.raises(StoppedError, match="too deep"):
        corrected(family, near, way, way, start)


def test_first_orbit_is_kept_if_collocation_disagrees(started, monkeypatch):
    family, start = started
    data = start.look.data
    wrong = start._replace(
        look=start.look._replace(data=data._replace(statistics=1.001 * data.statistics))
    )
    monkeypatch.setattr(collocated, "by_newton", lambda *args: start)
    monkeypatch.setattr(family, "_followed", lambda *args: wrong)
    fixed = np.eye(3)[-1]
    assert corrected(family, start.place, fixed, fixed) is start


def test_shooting_follows_where_it_is_asked_for():
    config = load("configs/cic.yaml", ["solver.orbit=shooting"])
    assert type(_family(config, "speed_rpm", 1, StepSizes(2000, 4000))) is OrbitFamily


def test_branch_over_a_design_stops_where_no_profile_is_left(started):
    """The check of the profile is made before the orbit and after it."""
    family, start = started
    config = family.config
    limits = StepSizes(5.0, 30.0, points=200)
    found = follow(config, "involute_length_mm", start.look.data.state, 1, limits, ways=(1,))
    assert found.ends[1] is End.NO_GEOMETRY
    assert max(point.residual for point in found.points) < 1e-9
