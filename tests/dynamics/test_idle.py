"""Tests of scenes and designs whose flanks never touch: `idle`, with forces of zero."""

import dataclasses
import json
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.commands.table import optimize
from rootsopt.config import load
from rootsopt.dynamics.steady import window_status
from rootsopt.dynamics.window import Window
from rootsopt.errors import InputError
from rootsopt.optimize.problem import Problem
from rootsopt.response.attractors import Attractor, Basins
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.records import apart_message, fading_note, message_of, unsettled
from rootsopt.response.reducers import mean, over_speeds
from rootsopt.response.result import Evaluation, Part, Seed
from rootsopt.scene import Scene, design_vector
from rootsopt.status import Status
from tests.standins import evaluation_of

CIC = "configs/cic_drawn.yaml"
FORCES = {"mean_force_N": 50.0, "peak_force_N": 200.0, "rms_force_N": 80.0}
NONE = dict.fromkeys(FORCES, 0.0)
LINE = "line_1_force_N"


def config_of(*overrides):
    return load(CIC, overrides)


def made_up(response, status=Status.PERIODIC, state=(0.1, 0.0)) -> Evaluation:
    """Return an evaluation of the shipped design with made-up forces."""
    design = {"pressure_angle_deg": 36.43, "involute_length_mm": 9.0, "tip_arc_angle_deg": 4.0}
    slope = 0.0 if status is Status.IDLE else 1.0
    return dataclasses.replace(
        evaluation_of(status=status),
        design=design,
        geometry={"area_efficiency": 0.43},
        response=dict(response),
        gradient={name: dict.fromkeys(design, slope) for name in response if status.usable},
        steady_state={"kind": "periodic", "period": 1, "floquet_multiplier": 0.5},
        start=None if state is None else Seed(np.array(state)),
    )


def problem_of(config, baseline):
    return Problem.of(config, Scene.from_config(config), baseline)


# Whole scenes; the program is that of the shipped one


@pytest.fixture(scope="module")
def held():
    """Return a pair whose timing gear holds the flanks apart."""
    return Evaluator.of(config_of("contact.clearance_mm=0.3"))()


def test_a_pair_held_by_its_gear_is_idle(held):
    assert (held.status, held.usable) == (Status.IDLE, True)
    assert held.steady_state["kind"] == "idle"
    assert held.steady_state["floquet_multiplier"] < 0.1
    assert NONE.items() <= held.response.items()
    assert not any(np.any([*held.gradient[name].values()]) for name in NONE)
    assert np.all(held.series.force == 0)
    assert np.max(held.series.depth) < 0
    json.dumps(held.record(), allow_nan=False)


@pytest.mark.parametrize(("key", "name"), [
    ("contact.clearance_mm", "contact_reserve_um"),
    ("scene.timing_gear.backlash_mm", "backlash_reserve_mm"),
])  # fmt: skip
def test_flanks_touch_where_the_reserve_is_used_up(held, key, name):
    unit, sign = (-1e-3, -1) if name.endswith("um") else (1.0, 1)
    end = held.response[name] * unit + config_of("contact.clearance_mm=0.3").value(key)
    for step, status in ((-2e-4, Status.IDLE), (2e-4, Status.PERIODIC)):
        config = config_of("contact.clearance_mm=0.3", f"{key}={end + sign * step}")
        found = Evaluator.of(config)(series=False)
        assert found.status is status
    assert 0 < found.response["mean_force_N"] < 5


def test_optimize_says_what_to_minimise_instead(tmp_path, capsys):
    arguments = [CIC, "-o", str(tmp_path / "out"), "--set", "contact.clearance_mm=0.3"]
    assert optimize.main([*arguments, "--no-figures"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "its flanks never touch" in said
    assert "terms: {leakage_fraction: 1}" in said


# Verdict and advice


def window(peak, exponent):
    """Return a window of 16 mesh periods with these peaks (N) and this exponent, known to about
    0.01."""
    scatter = 0.04 * (-1.0) ** np.arange(16) * np.arange(16) / 16
    return Window.empty(jnp.zeros(2), 16, jnp.asarray(1e-6))._replace(
        growth=jnp.asarray(scatter - np.mean(scatter) + exponent),
        response=jnp.asarray(np.column_stack([peak, peak**2, peak])),
        depth=jnp.asarray(-1.0),
        done=jnp.asarray(16),
    )


@pytest.mark.parametrize("exponent", [0.5, 0.0])
def test_a_motion_without_contact_that_does_not_repeat_is_idle(exponent):
    evaluator = Evaluator.of(config_of())
    pair = evaluator.pair(design_vector(evaluator.config))
    touching = (Status.CHAOTIC, "chaotic") if exponent else (Status.NOT_SETTLED, "transient")
    for peaks, expected in ((np.zeros(16), (Status.IDLE, "idle")), (np.eye(16)[2], touching)):
        seen = window(peaks, exponent)
        assert 1e-3 < float(seen.error) < 0.05
        status = Status.of(int(window_status(pair, seen)))
        steady, response, _ = unsettled(pair, status, jax.device_get(seen), False)
        assert (status, steady["kind"]) == expected
        assert response["peak_force_N"] == np.max(peaks)
        assert (response == NONE) == (not np.any(peaks))


@pytest.mark.parametrize(
    ("status", "overrides", "has", "lacks"),
    [
        (Status.PASSED_THROUGH, ["scene.timing_gear=null"], "dd a scene.timing_gear", "backlash"),
        (
            Status.PASSED_THROUGH,
            ["scene.timing_gear.backlash_mm=0", "scene.timing_gear.stiffness_N_m_per_rad=2000"],
            "Raise scene.timing_gear.stiffness_N_m_per_rad (2000), or lower scene.load.torque_N_m",
            "backlash|[Aa]dd",
        ),
        (Status.PASSED_THROUGH, ["scene.phase_error_mrad=9"], "scene.phase_error_mrad (9)", "add"),
        (
            Status.TOO_DEEP,
            ["scene.center_distance_error_mm=-0.5"],
            "Raise scene.center_distance_error_mm (-0.5)",
            "backlash",
        ),
        (Status.TOO_DEEP, [], "Raise contact.stiffness_N_per_mm_e", "center_distance|wear"),
        (Status.CHAOTIC, ["scene.timing_gear=null"], "contact.max_damping", "gear|backlash"),
        (Status.NOT_SETTLED, [], "solver.max_mesh_periods", "contact.max"),
        (Status.UNRESOLVED, [], "solver.accuracy", "rtol"),
        (Status.SOLVER_FAILED, ["solver.rtol=1e-7"], "loosen solver.rtol", "accuracy"),
    ],
)
def test_advice_names_what_the_scene_has(status, overrides, has, lacks):
    """The message advises nothing that the scene has already, and lowers nothing that is 0."""
    said = message_of(config_of(*overrides), status)
    assert has in said
    assert not re.search(lacks, said)


def test_slowly_fading_disturbances_are_named():
    """At a multiplier of 0.9999957 every four mesh periods, 1 % is left after 4.28e6 of them."""
    assert "4.28e+06 mesh periods" in fading_note(0.9999957, 4)
    assert 0.0099 < 0.9999957 ** (4.284e6 / 4) < 0.0101
    assert fading_note(0.998, 4) == fading_note(1.1, 1) == fading_note(math.inf, 1) == ""


def test_the_message_names_what_holds_the_flanks_apart():
    wide, tight = "contact.clearance_mm=0.3", "contact.clearance_mm=0.01"
    most = config_of().scene.timing_gear.backlash_mm + 0.25
    held, above = "The timing gear keeps the flanks apart", "scene.timing_gear.backlash_mm above"
    for changes, known, begin, end in (
        ([wide], [0.25], held, f"100 µm; they touch with {above} {most:.4g}."),
        ([wide], [], held, "contact.clearance_mm below 0.2."),
        ([tight], [], held, "100 µm."),
        ([tight, "scene.timing_gear=null"], [], "No flank touches", ""),
    ):
        said = apart_message(config_of(*changes), -0.1e-3, *known)
        assert said.startswith(begin)
        assert said.endswith(end)
    # Nothing was found where the gap is a pitch radius.
    for gap in (-0.033, math.nan):
        assert "gap" not in apart_message(config_of(wide), gap)


# Objectives


def test_a_design_that_never_touches_has_the_best_objective():
    """Without contact all forces are 0, and so is an objective of forces.

    It is finite down to the least number, whose inverse overflows; measures without a weight may
    be 0."""
    assert problem_of(config_of(), made_up(FORCES)).objective(made_up(NONE, Status.IDLE)) == 0
    weights = "objective.mean_weight=1", "objective.peak_weight=0"
    for changes, forces in (
        ((), FORCES),
        ((), {name: 1e-300 * value for name, value in FORCES.items()}),
        (weights, FORCES | {"peak_force_N": 0.0, LINE: 0.0}),
    ):
        found = made_up(forces)
        assert problem_of(config_of(*changes), found).objective(found) == pytest.approx(1)


@pytest.mark.parametrize(
    ("overrides", "response", "words"),
    [
        ((), NONE, "mean_force_N is 0"),
        (("objective.mean_weight=0",), FORCES | {"peak_force_N": 0.0}, "peak_force_N is 0"),
        (("objective.rms_weight=1",), FORCES | {"rms_force_N": 0.0}, "rms_force_N is 0"),
        (("objective.line_weights={1: 1}",), FORCES | {LINE: 0.0}, "has no such line"),
        (
            ("objective.peak_norm=8",),
            FORCES | {"peak_norm_force_N": 0.0},
            "peak_norm_force_N is 0",
        ),
    ],
)
def test_nothing_is_relative_to_a_force_of_zero(overrides, response, words):
    """There is one message for every measure with a weight; measures without a weight do not
    count."""
    with pytest.raises(InputError, match=words):
        problem_of(config_of(*overrides), made_up(response))


# Several speeds


def several(*responses, shares=(0.0, 1.0)):
    """Return an evaluation at two speeds, idle where the response is zero."""
    parts = []
    for k, (share, response) in enumerate(zip(shares, responses, strict=True), 1):
        one = made_up(response, Status.PERIODIC if any(response.values()) else Status.IDLE)
        parts.append(Part({"speed_rpm": 1000.0 * k}, one, share))
    return over_speeds(tuple(parts), 1000.0)


def test_an_idle_speed_counts_as_zero():
    found, both = (several(FORCES, other, shares=(0.5, 0.5)) for other in (NONE, FORCES))
    assert found.status is Status.PERIODIC
    problem = problem_of(config_of("objective.speeds_rpm=[1000, 2000]"), both)
    assert problem.objective(found) == pytest.approx(0.5)


def test_a_speed_without_share_has_nothing_to_be_relative_to():
    config = config_of("objective.speeds_rpm=[2000]", "objective.line_weights={1: 1}")
    with_line, without = FORCES | {LINE: 3.0}, FORCES | {LINE: 0.0}
    baseline = several(without, with_line)
    problem = problem_of(config, baseline)
    assert problem.objective(baseline) == pytest.approx(1)
    alone, counting = problem.by_speed(baseline)
    assert np.isnan(alone["objective"])
    assert counting["objective"] == pytest.approx(1)
    with pytest.raises(InputError, match="no such line at 2000 rpm"):
        problem_of(config, several(with_line, without))


# Motions that coexist


def basins_of(*evaluations):
    axis, none, share = np.zeros(1), np.zeros((1, 1), int), 1 / len(evaluations)
    motions = tuple(
        Attractor(e, share, k == 0, np.zeros((1, 2))) for k, e in enumerate(evaluations)
    )
    return Basins(axis, axis, none, motions, evaluations[0], {}, 1.0, 1.0)


def test_a_motion_without_contact_beside_others_counts_as_zero(monkeypatch):
    """A motion held by the gear counts like others; a floating pair does not count."""
    noisy, quiet = made_up(FORCES), made_up(NONE, Status.IDLE)
    floating = made_up(NONE, Status.IDLE, state=None)
    found = [basins_of(*them).status for them in ((noisy, quiet), (quiet,), (noisy, floating))]
    assert found == [Status.PERIODIC, Status.IDLE, Status.IDLE]
    averaged = mean(noisy, [noisy, quiet], [0.5, 0.5])
    assert averaged.response == pytest.approx({k: v / 2 for k, v in FORCES.items()})
    assert averaged.gradient["mean_force_N"]["tip_arc_angle_deg"] == 0.5
    monkeypatch.setattr(
        "rootsopt.response.attractors.find",
        lambda single, *rest: basins_of(quiet, noisy),
    )
    for motion, share in (("worst", 1.0), ("weighted", 0.5)):
        found = Evaluator.of_objective(config_of(f"objective.motion={motion}"))()
        assert found.status is Status.PERIODIC
        assert found.response["peak_force_N"] == pytest.approx(share * 200)
        assert found.start.shape == (2, 2)
