"""Tests of flanks that stay apart, `idle` with forces of zero: their reserve, the torque of the
gear that keeps them apart, verdict, advice, and objectives."""

import dataclasses
import functools
import json
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.shooting import differentiated
from rootsopt import (
    InputError,
    Scene,
    Status,
    load_config,
    optimize_design,
    steady_response,
)
from rootsopt.dynamics.window import Window
from rootsopt.optimize.problem import Problem
from rootsopt.response import evaluation, sensitivity
from rootsopt.response.attractors import Attractor, Basins
from rootsopt.response.evaluation import Evaluator, unsettled_status
from rootsopt.response.records import apart_message, fading_note, message_of, unsettled
from rootsopt.response.reducers import mean, over_speeds
from rootsopt.response.result import Evaluation, Part, Seed
from rootsopt.response.sensitivity import touching
from tests.response.test_speeds import config_of
from tests.standins import evaluation_of

APART = ["contact.clearance_mm=0.15", "scene.timing_gear.backlash_mm=0.04"]
QUICK = [
    *(*APART, "optimizer.starts=1", "optimizer.screening=0"),
    "objective={mean_weight: 0, peak_weight: 0, terms: {flow_ripple: 1}}",
]
RESERVES = "contact_reserve_um", "backlash_reserve_mm"


@functools.cache
def evaluator():
    """Return the evaluator of a pair of CIC rotors whose flanks stay apart."""
    return Evaluator.of(load_config("cic_drawn", APART)).at_tolerance(1e-10)


@functools.cache
def apart():
    return evaluator()()


@pytest.mark.parametrize("clearance", [0.15, 0.02])
def test_gradients_are_those_of_differences(clearance):
    """This holds for flanks that stay apart, and for flanks that touch.

    The instant of the least gap is known to the root of its rounding only, where the derivative
    with respect to the involute length changes quickly."""
    one = Evaluator.of(load_config("cic_drawn", [*APART, f"contact.clearance_mm={clearance}"]))
    one = one.at_tolerance(1e-11)
    here, way = one(), np.array([1.0, -0.7, 0.8])
    expected = (Status.IDLE, True) if clearance > 0.1 else (Status.PERIODIC, False)
    assert (here.status, here.response["contact_reserve_um"] > 0) == expected
    design = np.array([*here.design.values()])
    # The torque of a gear that carries a constant load does not depend on the design.
    names = [*RESERVES] + ["gear_force_N", "rms_gear_torque_N_m"] * (clearance < 0.1)

    def values(change):
        found = one(design + change * way, start=here.start)
        return np.array([found.response[name] for name in names])

    for name, slope in zip(names, differentiated(values, 4e-3)[0], strict=True):
        row = np.array([*here.gradient[name].values()])
        assert row @ way == pytest.approx(slope, abs=2e-4 * np.max(np.abs(row)))


def test_torque_of_a_gear_that_carries_a_constant_load():
    config = evaluator().config
    load_N_m = config.scene.load.torque_N_m
    torques = dict.fromkeys((f"{x}gear_torque_N_m" for x in ("", "mean_", "rms_")), load_N_m)
    expected = torques | {"gear_force_N": load_N_m / config.profile.pitch_radius_mm * 1e3}
    assert {name: apart().response[name] for name in expected} == pytest.approx(expected, rel=1e-6)


def test_torque_of_a_gear_of_flanks_that_strike():
    config = load_config("cic_drawn")
    found = Evaluator.of(config).at_tolerance(1e-10)()
    gear = config.scene.timing_gear
    inertia = float(evaluator().pair(config.design).inertia) / 2
    damping = 2 * gear.damping_ratio * np.sqrt(gear.stiffness_N_m_per_rad * inertia)
    beyond = np.abs(found.series.relative) - gear.backlash_mm / 2 / config.profile.pitch_radius_mm
    spring = gear.stiffness_N_m_per_rad * np.sign(found.series.relative) * np.maximum(beyond, 0)
    torque = np.abs(spring + damping * found.series.rate * (beyond > 0))
    assert np.mean(beyond > 0) < 1
    expected = torque.mean(), torque.max(), np.sqrt(np.mean(torque**2))
    said = [found.response[f"{which}gear_torque_N_m"] for which in ("mean_", "", "rms_")]
    assert said == pytest.approx(expected, rel=5e-3)


@pytest.mark.long
def test_pure_response_has_a_reserve_with_derivatives():
    """With a constant load, the motion only moves: all derivatives have closed forms."""
    config = load_config("cic_drawn", [*APART, "response.reserve=true"])
    scene, design = Scene.from_config(config), jnp.asarray(config.design)

    @eqx.filter_jit
    def both(scene):
        found = steady_response(scene, design)
        return jnp.stack([found.contact_reserve, found.backlash_reserve, found.peak]), found

    slopes, found = eqx.filter_jacfwd(both, has_aux=True)(scene)
    assert (Status.of(found.status), int(found.period)) == (Status.IDLE, 1)
    assert np.all(np.abs(found.multipliers) < 1)
    width = 2 * config.profile.pitch_radius_mm
    said = found.contact_reserve * 1e6, found.backlash_reserve * width
    assert said == pytest.approx([apart().response[name] for name in RESERVES], rel=1e-6)
    by_play, by_load = (np.asarray(x) for x in (slopes.gear.half_backlash, slopes.load_torque))
    assert np.asarray(slopes.clearance)[::2] == pytest.approx([1, 0], abs=1e-9)
    # Less stiffness or more load uses up the reserve as more backlash does.
    assert by_play[1:] == pytest.approx([-1, 0], abs=1e-6)
    stiffness = config.scene.timing_gear.stiffness_N_m_per_rad
    assert by_load * stiffness == pytest.approx(by_play, rel=1e-6)


def test_share_of_machines_that_touch_has_a_closed_form(monkeypatch):
    """The reserve is linear in clearance and backlash, each of which is as likely as any other.

    The narrower of two uniform distributions does not change the share of the wider one's tail."""
    over = "contact.clearance_mm: {uniform: 0.14}, scene.timing_gear.backlash_mm: {uniform: 0.01}"
    config = load_config("cic_drawn", [*APART, f"tolerances={{over: {{{over}}}}}"])
    monkeypatch.setattr(sensitivity, "SIMULATED", 8)
    found = touching(config)
    clearance, backlash = found["keys"]
    reserve = found["contact_reserve_um"]
    # The longest lever is that of the involute, at the pressure angle.
    lever = config.profile.pitch_radius_mm * np.cos(np.deg2rad(config.design[0]))
    # |ε| (rad) at which the gear carries a constant load.
    gear = config.scene.timing_gear
    swing = gear.backlash_mm / (2 * config.profile.pitch_radius_mm)
    swing += config.scene.load.torque_N_m / gear.stiffness_N_m_per_rad
    assert reserve == pytest.approx(150 - 1e3 * lever * swing, rel=1e-3)
    assert clearance["contact_reserve_um_per_unit"] == pytest.approx(1e3, rel=1e-6)
    share = (140 - reserve) / 280
    error = np.sqrt(share * (1 - share) / found["machines"])
    assert 0.02 < share < 0.2
    assert backlash["lost_at_most_um"] < 140 - reserve
    shares = found["touching_share"], found["touching_share_first_order"]
    assert shares == pytest.approx([share, share], abs=4 * error)
    assert clearance["key"] == "contact.clearance_mm"
    assert found["simulated_touching"] == found["model_touching"] > 0


def test_a_search_without_forces_simulates_nothing(monkeypatch):
    for name in ("_motion", "build", "apart_program"):
        monkeypatch.delattr(evaluation, name)
    found = optimize_design(load_config("cic_drawn", [*QUICK, "optimizer.iterations=8"]))
    assert found.optimized.status is Status.GEOMETRY_ONLY
    assert found.optimized.response.keys() == {"flow_ripple"}
    assert 0.01 < found.improvement["flow_ripple"] == pytest.approx(found.improvement["objective"])


@pytest.mark.long
def test_a_reserve_limits_a_search():
    least = apart().response["contact_reserve_um"] + 1.0
    limit = f"constraints.terms={{contact_reserve_um: {{min: {least}}}}}"
    found = optimize_design(load_config("cic_drawn", [*QUICK, "optimizer.iterations=12", limit]))
    assert found.optimized.response["contact_reserve_um"] > least - 1e-3
    (row,) = [row for row in found.constraints if row["name"] == "contact reserve"]
    assert (row["satisfied"], row["baseline_satisfied"]) == (True, False)


FORCES = {"mean_force_N": 50.0, "peak_force_N": 200.0, "rms_force_N": 80.0}
NONE = dict.fromkeys(FORCES, 0.0)
LINE = "line_1_force_N"


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
        changes = "contact.clearance_mm=0.3", f"{key}={end + sign * step}"
        found = Evaluator.of(config_of(*changes))(series=False)
        assert found.status is status
    assert 0 < found.response["mean_force_N"] < 5


# Verdict and advice


@pytest.mark.parametrize("exponent", [0.5, 0.0])
def test_a_motion_without_contact_that_does_not_repeat_is_idle(exponent):
    """The exponent of a window of 16 mesh periods is known to about 0.01."""
    pair = evaluator().pair(evaluator().config.design)
    touching = (Status.CHAOTIC, "chaotic") if exponent else (Status.NOT_SETTLED, "transient")
    scatter = 0.04 * (-1.0) ** np.arange(16) * np.arange(16) / 16
    for peaks, expected in ((np.zeros(16), (Status.IDLE, "idle")), (np.eye(16)[2], touching)):
        seen = Window.empty(jnp.zeros(2), 16, jnp.asarray(1e-6))._replace(
            growth=jnp.asarray(scatter - np.mean(scatter) + exponent),
            response=jnp.asarray(np.column_stack([peaks, peaks**2, peaks])),
            depth=jnp.asarray(-1.0),
            done=jnp.asarray(16),
        )
        assert 1e-3 < float(seen.error) < 0.05
        status = Status.of(int(unsettled_status(pair, seen)))
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
    assert fading_note(0.998, 4) == fading_note(1.1, 1) == fading_note(np.inf, 1) == ""


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
    for gap in (-0.033, np.nan):
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
    ("overrides", "baseline", "words"),
    [
        ((), (NONE,), "mean_force_N is 0"),
        # What to minimise instead.
        ((), (NONE, Status.IDLE), "its flanks never touch.*terms: {leakage_fraction: 1}"),
        (("objective.mean_weight=0",), (FORCES | {"peak_force_N": 0.0},), "peak_force_N is 0"),
        (("objective.rms_weight=1",), (FORCES | {"rms_force_N": 0.0},), "rms_force_N is 0"),
        (
            ("objective.line_weights={1: 1}",),
            (FORCES | {LINE: 0.0},),
            r"line_weights.*order 1,.*has no such line \(its motion repeats every 1 mesh periods",
        ),
        (
            ("objective.peak_norm=8",),
            (FORCES | {"peak_norm_force_N": 0.0},),
            "peak_norm_force_N is 0",
        ),
    ],
)
def test_nothing_is_relative_to_a_force_of_zero(overrides, baseline, words):
    """There is one message for every measure with a weight; measures without a weight do not
    count."""
    with pytest.raises(InputError, match=words):
        problem_of(config_of(*overrides), made_up(*baseline))


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
    found = [one["objective"] for one in problem.by_speed(baseline)]
    assert found == pytest.approx([np.nan, 1], nan_ok=True)
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
