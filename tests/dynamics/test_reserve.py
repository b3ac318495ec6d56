"""Tests of the reserve of flanks that stay apart, of the torque of the gear that keeps them apart,
and of searches that simulate nothing.

`test_idle` finds where the reserve is used up."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rootsopt
from experiments._common.shooting import differentiated
from rootsopt import steady_response
from rootsopt.config import load
from rootsopt.response import evaluation, sensitivity
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.sensitivity import touching
from rootsopt.scene import Scene
from rootsopt.status import Status

APART = ["contact.clearance_mm=0.15", "scene.timing_gear.backlash_mm=0.04"]
QUICK = [
    *(*APART, "optimizer.starts=1", "optimizer.screening=0"),
    "objective={mean_weight: 0, peak_weight: 0, terms: {flow_ripple: 1}}",
]
RESERVES = "contact_reserve_um", "backlash_reserve_mm"


@functools.cache
def evaluator():
    """Return the evaluator of a pair of CIC rotors whose flanks stay apart."""
    return Evaluator.of(load("cic_drawn", APART)).at_tolerance(1e-10)


@functools.cache
def held():
    return evaluator()()


def swing(config):
    """Return |ε| (rad) at which the gear carries a constant load."""
    gear = config.scene.timing_gear
    half = gear.backlash_mm / (2 * config.profile.pitch_radius_mm)
    return half + config.scene.load.torque_N_m / gear.stiffness_N_m_per_rad


@pytest.mark.parametrize("clearance", [0.15, 0.02])
def test_gradients_are_those_of_differences(clearance):
    """This holds for flanks that stay apart, and for flanks that touch.

    The instant of the least gap is known to the root of its rounding only, where the derivative
    with respect to the involute length changes quickly."""
    one = Evaluator.of(load("cic_drawn", [*APART, f"contact.clearance_mm={clearance}"]))
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
    expected = dict.fromkeys(
        (f"{which}gear_torque_N_m" for which in ("", "mean_", "rms_")), load_N_m
    )
    expected["gear_force_N"] = load_N_m / config.profile.pitch_radius_mm * 1e3
    assert {name: held().response[name] for name in expected} == pytest.approx(expected, rel=1e-6)


def test_torque_of_a_gear_of_flanks_that_strike():
    config = load("cic_drawn")
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
    config = load("cic_drawn", [*APART, "response.reserve=true"])
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
    assert said == pytest.approx([held().response[name] for name in RESERVES], rel=1e-6)
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
    config = load("cic_drawn", [*APART, f"tolerances={{over: {{{over}}}}}"])
    monkeypatch.setattr(sensitivity, "SIMULATED", 8)
    found = touching(config)
    clearance, backlash = found["keys"]
    reserve = found["contact_reserve_um"]
    # The longest lever is that of the involute, at the pressure angle.
    lever = config.profile.pitch_radius_mm * np.cos(np.deg2rad(config.design[0]))
    assert reserve == pytest.approx(150 - 1e3 * lever * swing(config), rel=1e-3)
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

    def moved(*arguments, **named):
        raise AssertionError("nothing may move")

    for name in ("_motion", "_build", "apart_program"):
        monkeypatch.setattr(evaluation, name, moved)
    found = rootsopt.optimize_design(load("cic_drawn", [*QUICK, "optimizer.iterations=8"]))
    assert found.optimized.status is Status.GEOMETRY_ONLY
    assert found.optimized.response.keys() == {"flow_ripple"}
    assert 0.01 < found.improvement["flow_ripple"] == pytest.approx(found.improvement["objective"])


@pytest.mark.long
def test_a_reserve_limits_a_search():
    least = held().response["contact_reserve_um"] + 1.0
    limit = f"constraints.terms={{contact_reserve_um: {{min: {least}}}}}"
    found = rootsopt.optimize_design(load("cic_drawn", [*QUICK, "optimizer.iterations=12", limit]))
    assert found.optimized.response["contact_reserve_um"] > least - 1e-3
    (row,) = [row for row in found.constraints if row["name"] == "contact reserve"]
    assert (row["satisfied"], row["baseline_satisfied"]) == (True, False)
