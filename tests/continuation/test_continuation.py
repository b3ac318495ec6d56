"""Tests of curves followed through folds, and of periodic orbits of the rotor pair."""

import csv
import dataclasses
import itertools
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.continuation.arclength import (
    CORNER,
    End,
    Linearization,
    StepSizes,
    StoppedError,
    corrected,
    follow_curve,
    tangent,
)
from rootsopt.continuation.branch import (
    Kind,
    follow,
    follow_doubled,
    parameters,
    value_of,
    with_value,
)
from rootsopt.continuation.orbits import OrbitFamily, longest_gap
from rootsopt.errors import InputError
from rootsopt.response.evaluation import Evaluator
from rootsopt.status import Status

# Curves with a closed form


def curve_of(residual, jacobian):
    """Return a curve of one equation in (x, parameter)."""

    def look(place, memory, careful):
        return Linearization(np.array([residual(*place)]), np.array([jacobian(*place)]))

    return look


CIRCLE = curve_of(lambda x, p: x**2 + p**2 - 1, lambda x, p: [2 * x, 2 * p])
CUBIC = curve_of(lambda x, p: p - x + x**3, lambda x, p: [3 * x**2 - 1, 1.0])
FOLD = {"FOLD": lambda spot: float(spot.tangent[-1])}


def start_of(curve, x, p, way=1.0):
    return corrected(curve, np.array([x, p]), np.array([0.0, 1.0]), np.array([0.0, way]))


def test_circle_is_closed_with_a_fold_on_either_side():
    """Every point lies on the circle, the folds are at ±1, and the curve ends at its start."""
    path = follow_curve(CIRCLE, start_of(CIRCLE, 1.0, 0.0), StepSizes(-2, 2, 0.02, 1e-6, 0.1), FOLD)
    assert path.end is End.CLOSED
    places = np.array([spot.place for spot in path.spots])
    np.testing.assert_allclose(np.hypot(*places.T), 1, atol=1e-10)
    turned = np.unwrap(np.arctan2(places[:, 1], places[:, 0]))[-1]
    assert turned == pytest.approx(2 * np.pi, abs=0.2)
    assert [name for _, name, _ in path.crossings] == ["FOLD", "FOLD"]
    found = [spot.place for _, _, spot in path.crossings]
    np.testing.assert_allclose(found, [[0, 1], [0, -1]], atol=1e-8)


def test_cubic_passes_both_folds_to_the_end_of_the_range():
    """λ = x - x³ has folds at x = ±1/√3; three points at λ = 0 are on one curve."""
    path = follow_curve(CUBIC, start_of(CUBIC, -1.4, 1.3, -1), StepSizes(-1.5, 1.5), FOLD)
    assert path.end is End.RANGE_END
    assert path.spots[-1].place[-1] == -1.5
    x, p = np.array([spot.place for spot in path.spots]).T
    assert np.count_nonzero(np.diff(np.sign(p))) == 3
    folds = np.array([spot.place for _, _, spot in path.crossings])
    top = 1 / np.sqrt(3)
    np.testing.assert_allclose(folds, [[-top, -top + top**3], [top, top - top**3]], atol=1e-8)
    assert all(spot.tangent @ after.tangent > 0.9 for spot, after in itertools.pairwise(path.spots))
    for index, _, spot in path.crossings:
        assert x[index] <= spot.place[0] <= x[index + 1]


def test_steps_follow_the_rate_of_convergence():
    """Steps grow to the maximum on a straight stretch."""
    line = curve_of(lambda x, p: x - p, lambda x, p: [1.0, -1.0])
    path = follow_curve(line, start_of(line, 0.0, 0.0), StepSizes(-1, 1, 1e-3, 1e-6, 0.05))
    strides = [np.linalg.norm(b.place - a.place) for a, b in itertools.pairwise(path.spots)]
    np.testing.assert_allclose(strides[:3], [1e-3, 1.5e-3, 2.25e-3], rtol=1e-9)
    assert max(strides) == pytest.approx(0.05)


def test_ends_are_named():
    """A curve ends after too many points, where it stops, and if its start leaves the range at
    once."""
    few = follow_curve(CIRCLE, start_of(CIRCLE, 1.0, 0.0), StepSizes(-2, 2, points=7))
    assert (few.end, len(few.spots)) == (End.MAX_POINTS, 7)

    def until(place, memory, careful):
        if place[-1] > 0.5:
            raise StoppedError(End.TOO_DEEP)
        return CIRCLE(place, memory, careful)

    path = follow_curve(until, start_of(CIRCLE, 1.0, 0.0), StepSizes(-2, 2))
    assert path.end is End.TOO_DEEP
    assert path.spots[-1].place[-1] == pytest.approx(0.5, abs=1e-4)
    outward = follow_curve(CIRCLE, start_of(CIRCLE, 1.0, 0.0), StepSizes(-1, 0))
    assert (outward.end, len(outward.spots)) == (End.RANGE_END, 1)
    nowhere = curve_of(lambda x, p: x**2 + 1, lambda x, p: [2 * x, 0.0])
    with pytest.raises(StoppedError):
        start_of(nowhere, 0.7, 0.0)


def test_a_corner_is_passed():
    """λ = -|x| turns by a right angle; the curve is found again beyond the corner, which is
    recorded."""
    roof = curve_of(lambda x, p: p + abs(x), lambda x, p: [np.sign(x), 1.0])
    path = follow_curve(roof, start_of(roof, -1.0, -1.0), StepSizes(-2, 1), FOLD)
    assert path.end is End.RANGE_END
    assert path.spots[-1].place == pytest.approx([2.0, -2.0])
    assert [name for _, name, _ in path.crossings] == [CORNER, "FOLD"]
    assert path.crossings[1][2].place == pytest.approx([0, 0], abs=1e-3)


def test_tangent_is_normal_to_the_equations():
    jacobian = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 1.0]])
    along = np.array([0.0, 0.0, -1.0])
    found = tangent(jacobian, along)
    np.testing.assert_allclose(jacobian @ found, 0, atol=1e-14)
    assert np.linalg.norm(found) == pytest.approx(1)
    assert found[-1] < 0


@pytest.mark.parametrize(
    ("wrong", "word"),
    [({"low": 3.0}, "low"), ({"least": 0.1}, "least"), ({"points": 0}, "points")],
)
def test_steps_are_checked(wrong, word):
    with pytest.raises(ValueError, match=word):
        dataclasses.replace(StepSizes(0.0, 1.0), **wrong)


# Orbits

SCENE = (
    "scene.load.torque_N_m=4.775",
    "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.2, backlash_mm: 0.2}",
)
RANGE = StepSizes(3740, 5000)
START = (-0.235, -1.809)


def config_at(speed):
    return load("configs/cic.yaml", [*SCENE, f"scene.speed_rpm={speed!r}"])


@pytest.fixture(scope="module")
def branch():
    """Return orbits over speed, beginning with a stable one at 4000 rpm."""
    config = config_at(4000.0)
    found = Evaluator.of(config)(start=np.array(START), series=False)
    assert found.status is Status.PERIODIC
    assert found.steady_state["period"] == 1
    return follow(config, "speed_rpm", found.state, 1, RANGE)


def test_points_agree_with_orbits_closed_for_themselves(branch):
    """Mean, peak and RMS of stable points agree with those of an `Evaluator` started nearby.

    The greatest multiplier agrees as well. Next to a grazing touch, such as near the fold, it
    changes with the square root of the state's error. There it must lie among those of the
    neighbouring points."""
    stable = [point for point in branch.points if point.stable]
    sizes = [np.max(np.abs(point.multipliers)) for point in stable]
    steady = 0
    for number in range(0, len(stable), len(stable) // 6):
        point, near = stable[number], sizes[max(number - 1, 0) : number + 2]
        alone = Evaluator.of(config_at(point.value))(start=0.999 * point.state, series=False)
        assert alone.status is Status.PERIODIC
        found = [alone.response[f"{name}_force_N"] for name in ("mean", "peak", "rms")]
        np.testing.assert_allclose([point.mean, point.peak, point.rms], found, rtol=1e-6)
        largest = alone.steady_state["floquet_multiplier"]
        if np.ptp(near) < 0.1 * largest:
            steady += 1
            assert sizes[number] == pytest.approx(largest, rel=1e-5)
        else:
            assert min(near) * (1 - 1e-5) < largest < max(near) * (1 + 1e-5)
        np.testing.assert_allclose(point.state, alone.state, atol=1e-6, rtol=0)
    assert steady >= 2


def test_every_point_is_closed(branch):
    assert max(point.residual for point in branch.points) < 1e-9
    assert branch.ends == (End.RANGE_END, End.RANGE_END)
    assert len(branch.points) > 20


def test_branch_turns_back_at_folds(branch):
    """At a fold, a multiplier is +1 and stability is lost; several orbits have the same speed."""
    folds = [one for one in branch.bifurcations if one.kind is Kind.FOLD]
    assert len(folds) == 2
    for fold in folds:
        near = np.min(np.abs(fold.point.multipliers - 1))
        assert near < 1e-3
        assert abs(fold.point.slope) < 1e-4
        before, after = branch.points[fold.after], branch.points[fold.after + 1]
        assert before.slope * after.slope < 0
        assert before.stable != after.stable
    assert sorted(fold.value for fold in folds) == pytest.approx([3804.646, 4133.342], abs=0.01)
    orbits = branch.at(4000.0)
    assert len(orbits) == 3
    assert [orbit.stable for orbit in orbits].count(True) == 2
    assert all(orbit.value == pytest.approx(4000) for orbit in orbits)
    peaks = sorted(orbit.peak for orbit in orbits)
    assert np.min(np.diff(peaks)) > 10
    assert branch.at(9000.0) == []


@pytest.mark.parametrize("parameter", ["speed_rpm", "torque_N_m", "backlash_mm", "damping_ratio",
                                       "involute_length_mm"])  # fmt: skip
def test_derivatives_are_those_of_finite_differences(branch, parameter):
    """The Jacobian with respect to state (monodromy matrix) and parameter agrees with differences.

    All are computed on repeated steps."""
    point = branch.at(4000.0)[0]
    config = config_at(4000.0)
    value = value_of(config, parameter)
    orbits = OrbitFamily(config, parameter, 1, StepSizes(0.9 * value, 1.0 * value + 1e-3))
    place = orbits.place(point.state, value)
    fixed = np.eye(3)[-1]
    spot = corrected(orbits, place, fixed, fixed)
    step = 1e-7
    for column in range(3):
        aside = step * np.eye(3)[column]
        ends = [orbits(spot.place + s * aside, spot.look.memory, False).residual for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(
            slope, spot.look.jacobian[:, column], rtol=1e-4, atol=1e-5 * np.max(np.abs(slope))
        )
    multipliers = np.linalg.eigvals(spot.look.jacobian[:, :2] + np.eye(2))
    np.testing.assert_allclose(
        np.sort_complex(multipliers), np.sort_complex(point.multipliers), rtol=1e-3
    )


def test_units_of_the_state_are_those_of_each_config(branch):
    """States can be used as a start even if the scale of the angle changes with the parameter."""
    point = branch.at(4000.0)[0]
    config = config_at(4000.0)
    other = follow(config, "backlash_mm", point.state, 1, StepSizes(0.19, 0.21), ways=(-1,))
    end = other.points[-1]
    assert (end.value, other.ends) == (0.19, (End.START, End.RANGE_END))
    there = with_value(config, "backlash_mm", 0.19)
    alone = Evaluator.of(there)(start=end.state, series=False)
    np.testing.assert_allclose(alone.state, end.state, rtol=1e-6)
    assert alone.response["peak_force_N"] == pytest.approx(end.peak, rel=1e-6)


def test_period_doubling_leads_to_the_doubled_orbit(branch, monkeypatch):
    """Below 3651 rpm the orbit is unstable, and one of twice the period is born.

    It is found on the other side if the first side gives none."""
    lowest = min((p for p in branch.at(3900.0) if p.stable), key=lambda p: p.peak)
    below = follow(
        config_at(3900.0), "speed_rpm", lowest.state, 1, StepSizes(3600, 4000), ways=(-1,)
    )
    (doubling,) = (one for one in below.bifurcations if one.kind is Kind.PERIOD_DOUBLING)
    assert np.min(np.abs(doubling.point.multipliers + 1)) < 1e-3
    assert doubling.value == pytest.approx(3650.23, abs=0.5)
    assert below.points[doubling.after].stable
    assert not below.points[doubling.after + 1].stable
    asked, sides = [], []

    def one_side(orbits, place, *rest):
        asked.append(orbits.period)
        sides.append(rest[0])
        if asked == [1, 2]:
            raise StoppedError(End.STEP_TOO_SMALL)
        return corrected(orbits, place, *rest)

    monkeypatch.setattr("rootsopt.continuation.branch.corrected", one_side)
    doubled = follow_doubled(below, doubling, StepSizes(3600, 4000, points=6))
    # The sign of the eigenvector depends on the machine; one side may fail at the first distance.
    assert asked[:3] == [1, 2, 2]
    assert set(asked[3:]) <= {2}
    assert np.linalg.norm(sides[1]) == pytest.approx(1)
    np.testing.assert_array_equal(sides[2], -sides[1])
    assert doubled is not None
    assert doubled.ends[1] is not End.HALVED
    assert doubled.period == 2
    assert max(point.residual for point in doubled.points) < 1e-9
    simple = below.at(doubled.points[-1].value)
    assert all(abs(p.peak - doubled.points[-1].peak) > 1e-3 * p.peak for p in simple)
    with pytest.raises(ValueError, match="period doubling"):
        follow_doubled(branch, next(one for one in branch.bifurcations if one.kind is Kind.FOLD))


def test_wrong_input_is_explained(branch):
    config, state = config_at(4000.0), branch.at(4000.0)[0].state
    with pytest.raises(InputError, match=r"speed_rpm.*torque_N_m.*backlash_mm"):
        follow(config, "speed", state, 1, RANGE)
    with pytest.raises(InputError, match="must lie in the range"):
        follow(config, "speed_rpm", state, 1, StepSizes(4100, 4200))
    with pytest.raises(InputError, match="backlash_mm"):
        follow(config, "backlash_mm", state, 1, StepSizes(-0.1, 0.3))
    with pytest.raises(InputError, match="period"):
        follow(config, "speed_rpm", state, 0, RANGE)
    bare = load("configs/ee.yaml", ["scene.timing_gear=null"])
    assert parameters(bare) == ("speed_rpm", "torque_N_m")
    with pytest.raises(InputError, match="no timing gear"):
        value_of(bare, "backlash_mm")


def test_a_design_ends_where_no_profile_can_be_made(branch):
    """The branch ends where the roll angle allows no longer involute."""
    config = config_at(4000.0)
    state = branch.at(4000.0)[0].state
    path = follow(config, "involute_length_mm", state, 1, StepSizes(8.9, 9.5), ways=(1,))
    assert path.ends[1] is End.NO_GEOMETRY
    assert path.points[-1].value == pytest.approx(9.071, abs=2e-3)


def test_longest_gap_goes_around():
    assert longest_gap(np.array([0, 1, 0, 0, 1, 0], bool)) == 2 / 6
    assert longest_gap(np.array([0, 0, 1, 0, 0, 1, 0], bool)) == 3 / 7
    assert longest_gap(np.zeros(4, bool)) == 1
    assert longest_gap(np.ones(4, bool)) == 0


@pytest.mark.long
def test_experiment(tmp_path):
    """The reduced run finds a fold with two stable orbits beside it, and writes its files."""
    command = [sys.executable, "-m", "experiments.bifurcation", "--quick", "-o", str(tmp_path)]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with open(tmp_path / "bifurcation.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["stable"] for row in rows} == {"true", "false"}
    assert all(float(row["residual"]) < 1e-9 for row in rows)
    assert all(
        (np.hypot(float(row["multiplier_1_real"]), float(row["multiplier_1_imag"])) < 1)
        for row in rows
        if row["stable"] == "true"
    )
    with open(tmp_path / "special_points.csv", newline="") as file:
        kinds = {row["kind"] for row in csv.DictReader(file)}
    assert "fold" in kinds
    result = json.loads((tmp_path / "bifurcation.json").read_text())
    (diagram,) = result["diagrams"]
    assert diagram["stable"]["noisy"]
    assert diagram["several_stable"]
    assert "rootsopt" in result["versions"]
    for name in ("speed", "ranges"):
        assert (tmp_path / f"bifurcation_{name}.png").read_bytes()[:4] == b"\x89PNG"
