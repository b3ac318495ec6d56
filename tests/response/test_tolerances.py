"""Scatter of scene and design: config, samples, scenes, evaluator, combined objectives."""

import dataclasses
import pickle
from unittest import mock

import jax
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats.mstats import hdquantiles

from rootsopt import Scene, Status
from rootsopt.config import parse
from rootsopt.config.tolerances import TolerancesConfig, scatterable
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.journal import plain_evaluation, read_evaluation
from rootsopt.response.reducers import combine
from rootsopt.response.scatter import draw, quantiles, shifts
from tests.response.test_speeds import CIC, config_of
from tests.standins import evaluation_of, programs, refusal

PLAY = "contact.clearance_mm=0.01"
CLEARANCE = "tolerances.over.contact.clearance_mm.normal=0.002"
BACKLASH = "tolerances.over.scene.timing_gear.backlash_mm.uniform=0.02"
SPREAD = (
    PLAY,
    CLEARANCE,
    BACKLASH,
    "tolerances.over.scene.load.torque_N_m.relative_triangular=0.05",
    "tolerances.over.profile.tip_arc_angle_deg.normal=0.02",
)


def test_config_names_distributions_in_two_ways():
    """Dotted overrides and a mapping with dotted keys mean the same.

    The resolved config can be read again."""
    config = config_of(*SPREAD)
    over = (
        "{contact.clearance_mm: {normal: 0.002}, scene.timing_gear.backlash_mm: {Uniform: 0.02}, "
        "scene.load.torque_N_m: {relative-triangular: 0.05}, "
        "profile.tip_arc_angle_deg: {normal: 0.02}}"
    )
    assert config_of(PLAY, f"tolerances.over={over}") == config == parse(config.to_yaml())
    widths = [(one.kind, one.width, one.half) for one in config.scatters]
    assert widths[:3] == [
        ("normal", 0.002, 0.008),
        ("uniform", 0.02, 0.02),
        ("triangular", pytest.approx(0.23875), pytest.approx(0.23875)),
    ]
    later = config_of(*SPREAD, "tolerances.over.contact.clearance_mm={uniform: 0.001}")
    assert later.scatters[0].kind == "uniform"
    assert (config_of().tolerances, config_of().scatters) == (None, ())


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ([CLEARANCE], ["reach -0.008", "at least 0", "narrow"]),
        ([PLAY, "tolerances.over.contact.clearence_mm.normal=1"], ["mean `contact.clearance_mm`"]),
        ([PLAY, "tolerances.over.contact.clearance_mm.nomal=1"], ["normal`?"]),
        ([PLAY, "tolerances.over.contact.clearance_mm.normal=0"], ["greater than 0"]),
        (["tolerances.over.contact.friction.kinetic.normal=1"], ["give", "nominal value"]),
        (
            ["tolerances.over.centre_distance.normal=0.01"],
            ["mean `scene.center_distance_error_mm`"],
        ),
        (["tolerances.over.friction.normal=0.01"], ["mean `contact.friction.kinetic`"]),
        (["tolerances.over.solver.rtol.normal=1"], ["solver.rtol", "cannot vary"]),
        (["tolerances.over.profile.lobes.normal=1"], ["profile.lobes", "design parameters"]),
        (["tolerances.over.contact.smoothing_mm.normal=1"], ["cannot vary"]),
        (["tolerances.over={}"], ["tolerances.over", "at least one"]),
        (["tolerances.over={contact.clearance_mm: 3}"], ["keys with values"]),
        (
            ["tolerances.over={contact.clearance_mm: {normal: 1, uniform: 2}}"],
            ["one distribution"],
        ),
        (["tolerances.over.contact.clearance_mm.relative_normal=1"], ["normal, not relative"]),
        ([BACKLASH, "objective.motion=ensemble"], ["tolerances", "ensemble"]),
        (
            ["tolerances.over.scene.speed_rpm.normal=9", "objective.speeds_rpm=[2000]"],
            ["scene.speed_rpm", "speeds_rpm"],
        ),
    ],
)
def test_refusals_name_the_key(overrides, words):
    message = refusal(config_of, *overrides)
    assert [word for word in words if word not in message] == []


@pytest.mark.parametrize("key", ["center_distance_error_mm", "phase_error_mrad"])
def test_errors_of_mounting_scatter_about_zero(key):
    """Also where the config does not give them; one that it gives keeps its value."""
    width = f"tolerances.over.scene.{key}.uniform=0.02"
    configs = config_of(width), config_of(width, f"scene.{key}=0.1")
    assert [config.scatters[0].nominal for config in configs] == [0.0, 0.1]
    assert getattr(configs[0].scene, key) == 0.0
    assert getattr(config_of(PLAY).scene, key) is None


def test_quantiles_agree_with_scipy():
    levels = np.array([0.0, *np.linspace(0.001, 0.999, 41), 1.0])
    middle = config_of(PLAY).scene.load.torque_N_m
    expected = [
        scipy.stats.truncnorm(-4, 4, 0.01, 0.002),
        scipy.stats.uniform(0.08, 0.04),
        scipy.stats.triang(0.5, 0.95 * middle, 0.1 * middle),
    ]
    for one, truth in zip(config_of(*SPREAD).scatters, expected, strict=False):
        found = quantiles(one, levels)
        np.testing.assert_allclose(found, truth.ppf(levels), rtol=1e-12)
        ends = one.nominal + one.half * np.array([-1, 1])
        np.testing.assert_allclose(found[[0, -1]], ends, rtol=1e-14)


def test_samples_have_the_statistics_of_their_distributions():
    """Mean and standard deviation are right, and the same seed gives the same sample.

    A Sobol sample of 1024 is within 2 %, a random one within four standard errors."""
    config = config_of(*SPREAD)
    means, widths = np.transpose([(one.nominal, one.width) for one in config.scatters])
    sigmas = widths / np.sqrt([1, 3, 6, 1])
    for fresh, count, share in ((False, 1024, 0.02), (True, 20_000, 4 / np.sqrt(20_000))):
        sample = draw(config, count, fresh)
        np.testing.assert_array_less(np.abs(sample.mean(axis=0) - means), share * sigmas)
        np.testing.assert_allclose(sample.std(axis=0), sigmas, rtol=max(share, 0.02))
        np.testing.assert_array_equal(sample, draw(config, count, fresh))
        assert np.all(np.abs(np.corrcoef(sample.T) - np.eye(4)) < 0.05)
    other = config_of(*SPREAD, "optimizer.seed=1")
    for fresh in (False, True):
        assert not np.any(draw(other, 8, fresh) == draw(config, 8, fresh))
    assert not np.any(draw(config, 8, True) == draw(config, 8))


# Combined objectives of many scenes, against SciPy and differences


def rule(**settings) -> TolerancesConfig:
    over = {"contact.clearance_mm": {"normal": 0.002}}
    return TolerancesConfig.model_validate({"over": over, **settings})


VALUES = np.array([1.02, 0.71, 0.93, 1.41, 0.88, 1.07, 0.79])
RULES = {
    "mean + 2 sigma": (rule(), np.mean(VALUES) + 2 * np.std(VALUES)),
    "mean + 0.5 sigma": (rule(k=0.5), np.mean(VALUES) + 0.5 * np.std(VALUES)),
    "quantile": (rule(combine="quantile"), hdquantiles(VALUES, 0.95)[0]),
    "median": (rule(combine="quantile", quantile=0.5), hdquantiles(VALUES, 0.5)[0]),
    "worst": (rule(combine="worst"), 1.41),
}
"""Rules, and what NumPy and SciPy find by them."""


@pytest.mark.parametrize("name", RULES)
def test_weights_are_the_gradient(name):
    """The weights agree with central differences.

    The error of these is the third derivative times step²/6, about 1e-10, plus rounding 1e-16 /
    step."""
    one, expected = RULES[name]
    found = combine(one, VALUES)
    step = 1e-5
    assert found.value == pytest.approx(expected, rel=1e-12)
    for weight, moved in zip(found.weights, step * np.eye(len(VALUES)), strict=True):
        upper, lower = (combine(one, VALUES + sign * moved).value for sign in (1, -1))
        assert weight == pytest.approx((upper - lower) / (2 * step), abs=1e-8)


@given(st.lists(st.floats(0.1, 10), min_size=2, max_size=40))
def test_worst_quantile_median_in_order(values):
    worst, high, middle = (combine(RULES[k][0], values) for k in ("worst", "quantile", "median"))
    slack = 1e-12 * max(values)
    assert worst.value + slack >= high.value >= middle.value - slack
    for one, _ in RULES.values():
        assert np.sum(combine(one, values).weights) == pytest.approx(1, abs=1e-12)
        assert combine(one, [values[0]] * 5).value == pytest.approx(values[0], rel=1e-13)


# Scenes of a sample


@pytest.mark.parametrize("file", [CIC, "configs/pump.yaml"])
def test_shifted_scenes_are_the_scenes_of_moved_configs(file):
    """Each value that may scatter, moved by 1 %, gives the scene of the moved config."""
    config = config_of(PLAY, file=file)
    keys = [k for k, value in scatterable(config).items() if value and k[:8] != "profile."]
    assert len(keys) >= 10
    over = {key: {"relative_uniform": 0.01} for key in keys}
    config = config.replaced({"tolerances": {"over": over}})
    evaluator, sample = Evaluator.of(config), draw(config, 2)
    for row, shift in zip(sample, shifts(config, sample), strict=True):
        moved = Scene.from_config(config.moved(dict(zip(keys, map(float, row), strict=True))))
        found = evaluator.shifted(shift.scene).scene
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), found, moved)


@pytest.fixture(scope="module")
def spread():
    """Return an evaluator over three scenes, and its evaluation of the own design."""
    config = config_of(*SPREAD, "solver.rtol=1e-10", "tolerances.samples=3")
    evaluator = Evaluator.of(config).scattered()
    return evaluator, evaluator(series=False)


def test_parts_are_the_evaluations_of_moved_configs(spread):
    """Each scene, started from rest, equals the evaluation of its config, by one program."""
    evaluator, found = spread
    before = programs()
    assert found.status is Status.PERIODIC
    assert found.response == found.nominal.response == found.scenes[0].evaluation.response
    assert len(found.samples) == 3
    for part in found.samples[:2]:
        moved = evaluator.config.moved(part.values)
        assert moved.design[2] == part.values["profile.tip_arc_angle_deg"]
        single = Evaluator.of(moved)(series=False)
        assert part.evaluation.response == pytest.approx(single.response, rel=1e-9)
        for name, slopes in single.gradient.items():
            assert part.evaluation.gradient[name] == pytest.approx(slopes, rel=1e-5, abs=1e-6)
    assert programs() == before
    rows = found.record()["samples"]
    assert [row["status"] for row in rows] == ["periodic"] * 3
    assert rows[0]["contact.clearance_mm"] == found.samples[0].values["contact.clearance_mm"]


def test_scenes_begin_on_their_own_orbits(spread):
    evaluator, found = spread
    with mock.patch.object(
        Evaluator, "reached", autospec=True, side_effect=Evaluator.reached
    ) as spy:
        again = evaluator(start=found.start, series=False)
    asked = {id(call.args[2]) for call in spy.call_args_list}
    assert asked == {id(part.evaluation.start) for part in found.scenes}
    assert again.response["mean_force_N"] == pytest.approx(found.response["mean_force_N"], 1e-8)


@dataclasses.dataclass(frozen=True)
class Told(Evaluator):
    """Stand in for an evaluator: its force is the clearance in µm, and fails above 12 µm."""

    def reached(self, design=None, start=None, series=True):
        clearance = 1e6 * float(self.scene.clearance)
        status = Status.PERIODIC if clearance < 12 else Status.NOT_SETTLED
        start = np.array([clearance, float(self.scene.speed)])
        return evaluation_of(clearance, status, start=start)


def told(*overrides):
    return Told.of_objective(config_of(PLAY, *overrides)).scattered()


def test_a_scene_without_steady_state_is_a_status():
    """The status names the first scene that does not settle, and how many do not.

    There is neither gradient nor start."""
    found = told(CLEARANCE, "tolerances.samples=16")()
    lost = [p for p in found.samples if not p.evaluation.usable]
    assert 0 < len(lost) < 16
    assert (found.status, found.start) == (Status.NOT_SETTLED, None)
    assert found.message.startswith(f"In {len(lost)} of the 16 scenes")
    assert f"contact.clearance_mm = {lost[0].values['contact.clearance_mm']:.6g}: " in found.message
    assert found.response["mean_force_N"] == pytest.approx(10)
    found = told(CLEARANCE, "contact.clearance_mm=0.02")()
    assert (found.status, found.samples) == (Status.NOT_SETTLED, ())


class Away:
    """Runs points as if in another process: what a point refers to must travel."""

    slots = 2

    def __init__(self):
        self.asked = []

    def evaluated(self, point):
        self.asked.append(point)
        evaluator, *rest = pickle.loads(pickle.dumps(point))
        return evaluator(*rest)


def test_scatter_over_several_speeds():
    """Each scene is evaluated at every speed, where `runs` says, and as in this process.

    Methods that return another evaluator keep the sample."""
    narrow = "tolerances.over.contact.clearance_mm.uniform=0.001"
    evaluator = told(narrow, "objective.speeds_rpm=[2000, 3000]", "tolerances.samples=2")
    runs = Away()
    found = evaluator.surveying().scattered(runs)()
    assert [point.series for point in runs.asked] == [False, False]
    rows = [[part.evaluation.response for part in one.scenes] for one in (found, evaluator())]
    assert rows[0] == rows[1]
    assert [len(start) for start in found.start] == [2, 2, 2]
    for part in found.samples:
        assert [p.speed_rpm for p in part.evaluation.speeds] == [2000, 3000]
        forces = [p.evaluation.response["mean_force_N"] for p in part.evaluation.speeds]
        assert forces == pytest.approx([1e3 * part.values["contact.clearance_mm"]] * 2, rel=1e-12)
        speeds = [p.evaluation.start[1] for p in part.evaluation.speeds]
        np.testing.assert_allclose(speeds, [200 * np.pi / 3, 100 * np.pi])
    again = read_evaluation(plain_evaluation(found))
    assert again.samples[1].evaluation.speeds[0].speed_rpm == 2000
    lone = evaluator.at_speed(2500.0)
    for other in (
        evaluator.surveying(),
        evaluator.with_maxima(),
        evaluator.at_tolerance(1e-6),
        evaluator.relative_to(found),
        evaluator.without_gradient(),
        lone,
    ):
        assert other.shifts == evaluator.shifts
    speeds = [part.evaluation.start[1] for part in lone().scenes]
    np.testing.assert_allclose(speeds, 2500 * np.pi / 30)
