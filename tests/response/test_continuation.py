"""Tests of periodic orbits of the rotor pair, followed through folds and period doublings."""

import types
from unittest import mock

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import InputError, Status, load_config
from rootsopt.continuation import End, Kind, StepSizes, follow, follow_doubled
from rootsopt.response.continuation.arclength import StoppedError
from rootsopt.response.continuation.branch import OrbitFamily
from rootsopt.response.evaluation import Evaluator
from rootsopt.scene import Scene, design_vector

SPEED, BACKLASH = "scene.speed_rpm", "scene.timing_gear.backlash_mm"
ECCENTRICITY = "scene.timing_gear.eccentricity_um"
TORQUE, INVOLUTE = "scene.load.torque_N_m", "profile.involute_length_mm"
SCENE = (
    "scene.load.torque_N_m=4.775",
    "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.2, backlash_mm: 0.2}",
)
# Steps up to 70 rpm. Near folds and grazing contacts, turns of the curve limit them.
RANGE = StepSizes(3600, 4300, greatest=0.1)
START = (-0.235, -1.809)


def config_at(speed):
    return load_config("configs/cic_drawn.yaml", [*SCENE, f"scene.speed_rpm={speed!r}"])


@pytest.fixture(scope="module")
def branch():
    """Return orbits over speed, beginning with a stable one at 4000 rpm."""
    config = config_at(4000.0)
    found = Evaluator.of(config)(start=np.array(START), series=False)
    assert (found.status, found.steady_state["period"]) == (Status.PERIODIC, 1)
    return follow(config, SPEED, found.state, 1, RANGE)


@jax.jit
def _ends(scene, design, states):
    """Return the states (m, n) after one mesh period from each of the scaled `states` (m, n).

    A step of any length could miss a short touch in free flight."""
    pair = scene.pair(design)
    term = diffrax.ODETerm(lambda tau, state, _: pair.derivative(tau, state)[0])
    control = diffrax.PIDController(rtol=1e-11, atol=1e-11, dtmax=1 / 256)

    def end(state):
        return diffrax.diffeqsolve(
            term, diffrax.Dopri8(scan_kind="lax"), 0.0, 1.0, 1e-3, state,
            stepsize_controller=control, max_steps=100_000,
        ).ys[-1]  # fmt: skip

    return jax.lax.map(end, states)


def by_integration(point):
    """Return the end of a motion over one mesh period, and its derivative (n, n) with respect to
    the start, by central differences.

    Noise of the integration, 1e-9, and curvature both stay below 1e-4 of it."""
    config = config_at(point.value)
    states = point.state + 1e-4 * np.vstack([np.zeros(2), np.eye(2), -np.eye(2)])
    ends = np.asarray(_ends(Scene.from_config(config), design_vector(config), states))
    return ends[0], (ends[1:3] - ends[3:]).T / 2e-4


def test_points_agree_with_orbits_closed_for_themselves(branch):
    """Forces, greatest multiplier and state of stable points agree with those of an `Evaluator`
    started nearby.

    Next to a grazing touch, such as near a fold, a multiplier changes with the square root of the
    state's error; these points are far from any."""
    points = [*branch.at(3700.0), *branch.at(3950.0)]
    assert [point.stable for point in points] == [True, True, False, True]
    for point in (point for point in points if point.stable):
        alone = Evaluator.of(config_at(point.value))(start=0.999 * point.state, series=False)
        assert alone.status is Status.PERIODIC
        found = {f"{name}_force_N": getattr(point, name) for name in ("mean", "peak", "rms")}
        assert found == pytest.approx(alone.response, rel=1e-6)
        largest = np.max(np.abs(point.multipliers))
        assert largest == pytest.approx(alone.steady_state["floquet_multiplier"], rel=1e-5)
        np.testing.assert_allclose(point.state, alone.state, atol=1e-6, rtol=0)


def test_points_are_orbits_of_an_integration(branch):
    """Stable or not, the motion returns, and its monodromy is that of central differences."""
    points = branch.points[::8]
    assert {point.stable for point in points} == {True, False}
    assert max(point.residual for point in branch.points) < 1e-9
    for point in points:
        end, monodromy = by_integration(point)
        np.testing.assert_allclose(end, point.state, atol=1e-6)
        line = point.made.line
        moved = line.to_state @ line.monodromy @ np.linalg.inv(line.to_state)
        np.testing.assert_allclose(moved, monodromy, atol=5e-4 * np.max(np.abs(monodromy)))
        np.testing.assert_allclose(
            np.sort_complex(point.multipliers), np.sort_complex(np.linalg.eigvals(moved))
        )


def test_branch_turns_back_at_folds(branch):
    """At a fold, a multiplier is +1 and stability is lost; several orbits have the same speed."""
    assert branch.ends == (End.RANGE_END, End.RANGE_END)
    folds = [one for one in branch.bifurcations if one.kind is Kind.FOLD]
    for fold in folds:
        assert np.min(np.abs(fold.point.multipliers - 1)) < 1e-3
        assert abs(fold.spot.tangent[-1]) < 1e-4
        before, after = branch.spots[fold.after : fold.after + 2]
        assert before.tangent[-1] * after.tangent[-1] < 0
        assert before.data.stable != after.data.stable
    assert sorted(fold.point.value for fold in folds) == pytest.approx(
        [3804.646, 4133.342], abs=0.01
    )
    orbits = branch.at(4000.0)
    assert sorted(orbit.stable for orbit in orbits) == [False, True, True]
    assert [orbit.value for orbit in orbits] == pytest.approx([4000] * 3)
    assert np.min(np.diff(sorted(orbit.peak for orbit in orbits))) > 10
    assert branch.at(9000.0) == []


def test_plane_holds_the_place(branch):
    """The orbit lies in the plane that was asked for, at a fixed parameter or across the curve."""
    # The orbit at which the branch began, far from any grazing contact.
    start = min(branch.spots, key=lambda spot: np.max(np.abs(spot.data.state - START)))
    guess = start.place + 0.008 * start.tangent
    for across in (start.tangent, np.eye(3)[-1], np.eye(3)[1]):
        spot = branch.family(guess, across, start)
        assert across @ (spot.place - guess) == pytest.approx(0, abs=1e-10)
        assert np.linalg.norm(spot.tangent) == pytest.approx(1)
        assert abs(spot.tangent @ start.tangent) > 0.99
        assert spot.along(start.tangent).orientation == start.orientation


@pytest.mark.parametrize("wrong", [True, False])
def test_orbit_to_which_its_neighbour_does_not_lead(branch, monkeypatch, wrong):
    """It is closed from an integration, whether its neighbour leads to none or to a wrong one.

    Other reasons to stop are final."""
    family, start = branch.family, branch.spots[0]
    way, guess = start.tangent, start.place + 1e-3 * start.tangent
    right = family(guess, way, start)
    aside = right._replace(place=right.place + 1e-4 * np.cross(way, [0.0, 0.0, 1.0]))
    first = aside if wrong else StoppedError(End.STEP_TOO_SMALL)
    misled = [first, mock.DEFAULT, StoppedError(End.TOO_DEEP)]
    closed = mock.Mock(wraps=family._closed, side_effect=misled)
    monkeypatch.setattr(family, "_closed", closed)
    again = family(guess, way, start)
    asked = [float(call.args[0][2]) for call in closed.call_args_list]
    assert asked == [pytest.approx(1e-3, abs=1e-9), 0.0]
    np.testing.assert_allclose(again.place, right.place, atol=1e-9)
    np.testing.assert_allclose(np.abs(again.tangent @ right.tangent), 1, atol=1e-9)
    with pytest.raises(StoppedError, match="too deep"):
        family(guess, way, start)


TWISTED = ("rotor.helix_deg=20", "solver.slices=2")
MOTOR = (
    "scene.drive=torque",
    "scene.motor={slope_N_m_s_per_rad: 0.1, inertia_kg_m2: 1.0e-3}",
)


@pytest.mark.parametrize(
    ("name", "changes", "key", "ends"),
    [
        ("cic_drawn", (f"{ECCENTRICITY}=5",), ECCENTRICITY, (1, 20)),
        ("free", (), "profile.coefficients_2", (0.2, 0.4)),
        ("ee", (), "contact.clearance_mm", (0.0, 0.01)),
        ("pump", (), "scene.load.pressure_difference_Pa", (1e4, 4e4)),
        ("cic_drawn", MOTOR, TORQUE, (1, 10)),
        ("ee", (*TWISTED, "optimizer.bounds.helix_deg=[0, 90]"), "rotor.helix_deg", (5, 40)),
    ],
)
def test_scenes_along_a_curve_are_those_of_the_configs(monkeypatch, name, changes, key, ends):
    """Scene and design at 30 % of the range are those of a config with this value."""
    pair = types.SimpleNamespace(
        angle_scale=jnp.asarray(1e-3),
        contact=types.SimpleNamespace(smooth=True),
        repeats=1,
        whole=lambda periods: periods,
    )
    monkeypatch.setattr("rootsopt.response.continuation.branch._pair", lambda *scene: pair)
    config = load_config(f"configs/{name}.yaml", list(changes))
    family = OrbitFamily(config, key, 1, StepSizes(*ends))
    value = 0.7 * ends[0] + 0.3 * ends[1]
    assert family.value(0.3) == pytest.approx(value)
    own, there = (config.moved({key: x}) for x in (family.value(family.share), value))
    np.testing.assert_allclose(own.design, config.design, rtol=1e-9)
    scenes = [Scene.from_config(config).renewed(one) for one in (own, config, there)]
    change = jax.tree.map(lambda x: 0.3 * x, family.range.change)
    scene, design = eqx.apply_updates(family.range.low, change)
    np.testing.assert_allclose(design, there.design, rtol=1e-12)
    for one, other in ((scene, scenes[2]), (scenes[0], scenes[1])):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-9), one, other)


def test_units_of_the_state_are_those_of_each_config(branch):
    """States can be used as a start even if the scale of the angle changes with the parameter."""
    config = config_at(4000.0)
    limits = StepSizes(0.19, 0.21, first=0.1, greatest=0.25)
    other = follow(config, BACKLASH, branch.at(4000.0)[0].state, 1, limits)
    end = other.points[0]
    assert (end.value, other.points[-1].value) == (0.19, 0.21)
    assert other.ends == (End.RANGE_END, End.RANGE_END)
    alone = Evaluator.of(config.moved({BACKLASH: 0.19}))(start=end.state, series=False)
    np.testing.assert_allclose(alone.state, end.state, rtol=1e-6)
    assert alone.response["peak_force_N"] == pytest.approx(end.peak, rel=1e-6)


@pytest.fixture(scope="module")
def doubling(branch):
    """Return the period doubling at the lowest speed."""
    found = [one for one in branch.bifurcations if one.kind is Kind.PERIOD_DOUBLING]
    return min(found, key=lambda one: one.point.value)


def test_period_doubling_is_found(branch, doubling, monkeypatch):
    """Below 3651 rpm the orbit is unstable; a multiplier there is -1 by central differences, too.

    A doubled orbit is looked for on both sides; there may be none."""
    assert np.min(np.abs(doubling.point.multipliers + 1)) < 1e-6
    assert np.min(np.abs(np.linalg.eigvals(by_integration(doubling.point)[1]) + 1)) < 1e-3
    assert doubling.point.value == pytest.approx(3650.528, abs=0.01)
    assert [point.stable for point in branch.points[doubling.after :][:2]] == [False, True]
    none = mock.Mock(side_effect=StoppedError(End.STEP_TOO_SMALL))
    monkeypatch.setattr(OrbitFamily, "from_integration", none)
    assert follow_doubled(branch, doubling, points=6) is None
    first, second, *_ = (call.args[1] for call in none.call_args_list)
    assert np.linalg.norm(second) == pytest.approx(1)
    np.testing.assert_array_equal(second, -first)
    with pytest.raises(ValueError, match="period doubling"):
        follow_doubled(branch, next(one for one in branch.bifurcations if one.kind is Kind.FOLD))


@pytest.mark.long
def test_period_doubling_leads_to_the_doubled_orbit(branch, doubling):
    """An orbit of twice the period is born, which is another one than those of the single."""
    doubled = follow_doubled(branch, doubling, points=6)
    assert doubled.ends[1] is not End.HALVED
    assert doubled.family.period == 2
    assert max(point.residual for point in doubled.points) < 1e-9
    simple = branch.at(doubled.points[-1].value)
    assert all(abs(p.peak - doubled.points[-1].peak) > 1e-3 * p.peak for p in simple)


def test_wrong_input_is_explained(branch):
    config, state = config_at(4000.0), branch.points[0].state
    wrong = (
        ("scene.speed", RANGE, r"did you mean `scene\.speed_rpm`"),
        (
            SPEED,
            StepSizes(4100, 4200),
            "must lie in the range to follow, 4100 to 4200, but is 4000",
        ),
        (BACKLASH, StepSizes(-0.1, 0.3), r"backlash_mm` must be at least 0"),
        ("contact.exponent", StepSizes(2.0, 2.5), "`contact.exponent` must be a number on which"),
        ("solver.accuracy", StepSizes(1e-6, 1e-4), "`solver.accuracy` must be a number on which"),
        ("scene", RANGE, "`scene` must be a section"),
        ("profile.lobes", StepSizes(2, 4), "`profile.lobes` must be a whole number"),
        ("rotor.helix_deg", StepSizes(0, 40), "`rotor.helix_deg` must be a number on which"),
    )
    bare = load_config("configs/ee.yaml", ["scene.timing_gear=null"])
    for arguments, said in (
        *(((config, key, state, 1, limits), said) for key, limits, said in wrong),
        ((config, SPEED, state, 0, RANGE), "period"),
        ((bare, BACKLASH, state, 1, StepSizes(0.1, 0.3)), "timing_gear"),
        ((config, SPEED, [40.0, 300.0], 1, RANGE), "no orbit of 1 mesh periods"),
    ):
        with pytest.raises(InputError, match=said):
            follow(*arguments)


def test_a_design_ends_where_no_profile_can_be_made(branch):
    """The branch ends where the roll angle allows no longer involute."""
    path = follow(config_at(4000.0), INVOLUTE, branch.at(4000.0)[0].state, 1, StepSizes(8.98, 9.5))
    assert path.ends[1] is End.NO_GEOMETRY
    assert path.points[-1].value == pytest.approx(9.071, abs=2e-3)
    assert max(point.residual for point in path.points) < 1e-9
