"""Tests of steps that end where free flight may end, and of the check of derivatives."""

import dataclasses

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.shooting import closed, differentiated
from rootsopt.config import load
from rootsopt.dynamics.integrator import Integrator, LandingControl
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.steady import agreement, verdict
from rootsopt.response.evaluation import Evaluator
from rootsopt.status import Status


def control(**over) -> LandingControl:
    given = {"clearance_mm": 0.0} | over
    config = load(
        "configs/cic_drawn.yaml",
        [
            f"contact.clearance_mm={given['clearance_mm']}",
            "scene.timing_gear.backlash_mm=0.2",
            *over.get("more", ()),
        ],
    )
    pair = Evaluator.of(config).pair(config.design)
    how = Integrator("tsit5", jnp.asarray(1e-8), 4096)
    found = how.controller(pair)
    assert isinstance(found, LandingControl)
    return found


def test_edges_are_those_of_clearance_and_backlash():
    config = load("configs/cic_drawn.yaml", ["scene.timing_gear.backlash_mm=0.2"])
    pair = Evaluator.of(config).pair(config.design)
    edges = np.sort(np.asarray(control().edges)) * float(pair.angle_scale)
    half = 0.1 / 33
    assert edges == pytest.approx([-half, 0, 0, half], abs=1e-15)
    assert np.isinf(control().inside)
    with_gap = control(clearance_mm=0.03)
    edges = np.sort(np.asarray(with_gap.edges)) * float(pair.angle_scale)
    assert edges == pytest.approx([-half, -0.03 / 33, 0.03 / 33, half])
    assert float(with_gap.inside * pair.angle_scale) == pytest.approx(0.03 / 33)
    # With displaced axes, the flanks may touch at any ε.
    assert float(control(more=["scene.center_distance_error_mm=0.01"]).inside) == 0


def adapted(landing, before, after, step):
    """Return whether a step between these states, with no error, is kept, and where the next one
    ends."""
    before, after = jnp.asarray(before), jnp.asarray(after)
    begin = jnp.asarray(0.2)
    args = begin, begin + step, before, after, None, jnp.zeros(2), 5.0
    state = jnp.asarray(1.0), jnp.asarray(1.0), jnp.asarray(False)
    keep, start, stop, *_ = landing.adapt_step_size(*args, state)
    return bool(keep), float(start - begin), float(stop - begin)


def parabola(place, rate, bend, time):
    return [place + rate * time + bend / 2 * time**2, rate + bend * time]


@pytest.mark.parametrize("bend", [-30.0, 0.0, 40.0])
@pytest.mark.parametrize("place", [0.3, -0.2])
def test_the_next_step_ends_just_beyond_the_edge(place, bend):
    """The next step ends just beyond the edge ε = 0; steps of 1/32 mesh period would pass it by
    far."""
    landing, step = control(), 0.004
    rate = -12.0 * np.sign(place)
    before = parabola(place, rate, bend, 0.0)
    after = parabola(place, rate, bend, step)
    roots = np.roots([bend / 2, rate, place]) if bend else np.array([-place / rate])
    meets = min(float(r.real) for r in roots if abs(r.imag) < 1e-12 and r.real > 0)
    keep, start, stop = adapted(landing, before, after, step)
    assert keep
    assert start == pytest.approx(step)
    assert stop == pytest.approx(min(meets + 1e-4, step + 1 / 32), rel=1e-9)


def test_a_step_that_passed_an_edge_far_is_taken_again():
    keep, start, stop = adapted(control(), [0.05, -10.0], [-0.2, -10.0], 0.025)
    assert not keep
    assert start == 0
    assert stop == pytest.approx(0.005 + 1e-4)
    # A step that passes the edge as intended is kept; the next one starts short.
    keep, start, stop = adapted(control(), [0.05, -10.0], [-0.001, -10.0], 0.0051)
    assert keep
    assert start == pytest.approx(0.0051)
    assert stop - start == pytest.approx(5e-4)


def test_a_step_ends_at_a_turn_beside_an_edge():
    """A step ends where a parabola turns 0.01 before the edge, because it might reach the edge."""
    landing, step = control(), 0.002
    bend = 100.0
    turn = 0.02
    place, rate = 0.01 + bend / 2 * turn**2, -bend * turn
    before, after = (parabola(place, rate, bend, t) for t in (0.0, step))
    keep, _, stop = adapted(landing, before, after, step)
    assert keep
    assert stop == pytest.approx(turn)
    # Far from every edge, the step is not limited.
    far = [0.3 + place, rate]
    _, _, stop = adapted(landing, far, parabola(*far, bend, step), step)
    assert stop > turn


@pytest.mark.parametrize("rtol", [1e-4, 1e-11])
def test_a_touch_between_two_stages_is_met(rtol):
    """A touch is found in a free fall onto a stiff floor at ε = 0, from a height at which steps are
    long."""
    landing = control()
    control_of = dataclasses.replace(
        landing, base=diffrax.PIDController(rtol=rtol, atol=rtol, dtmax=1.0)
    )

    def field(t, y, args):
        push = jnp.where(y[0] < 0, 4e6 * y[0] ** 2, 0.0)
        return jnp.stack([y[1], -1.0 + push])

    @eqx.filter_jit
    def end(control):
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Tsit5(),
            t0=0.0,
            t1=3.0,
            dt0=1e-3,
            y0=jnp.asarray([0.5, 0.0]),
            stepsize_controller=control,
            throw=False,
        )
        return found.ys[0]

    # The floor gives back what it takes, and is left by t = 2.
    state = np.asarray(end(control_of))
    energy = state[0] + state[1] ** 2 / 2
    assert energy == pytest.approx(0.5, abs=max(300 * rtol, 1e-9))


@pytest.mark.long
def test_two_changes_at_one_instant():
    """Gradients are correct if seal and contact pass the same joint 1e-9 mesh periods apart.

    Otherwise each would be at the end of a step without length, and the gradient wrong by 6e-4 at
    any tolerance."""
    scene = [
        "scene.speed_rpm=3831.1",
        "scene.timing_gear.backlash_mm=0.276",
        "scene.timing_gear.damping_ratio=0.06",
        "scene.timing_gear.stiffness_N_m_per_rad=44582",
        "scene.load={pressure_difference_Pa: 2.0e4}",
        "profile.pressure_angle_deg=35.23",
        "profile.involute_length_mm=5.77",
        "profile.tip_arc_angle_deg=1.68",
    ]
    evaluator = Evaluator.of(load("configs/cic_drawn.yaml", scene)).surveying()
    design, step, way = np.array([35.23, 5.77, 1.68]), 5e-5, np.array([1.0, -0.7, 0.8])
    found = evaluator(series=False)
    assert found.status is Status.PERIODIC
    assert found.statistics["gradient_disagreement"] < 1e-4
    # At the default tolerance, rounding alone changes the mean by 1e-8, and the difference by 1e-2.
    sharp = evaluator.at_tolerance(1e-11)
    ends = [
        sharp(jnp.asarray(design + sign * step * way), start=found.state, series=False)
        for sign in (1, -1)
    ]
    slope = np.subtract(*(one.response["mean_force_N"] for one in ends)) / (2 * step)
    row = np.array(list(found.gradient["mean_force_N"].values()))
    assert row @ way == pytest.approx(slope, abs=1e-5 * np.max(np.abs(row)))


JOINT = (
    "scene.speed_rpm=1015.7",
    "scene.load.torque_N_m=3",
    "scene.timing_gear.backlash_mm=0.055",
    "scene.timing_gear.damping_ratio=0.515",
    "scene.timing_gear.stiffness_N_m_per_rad=11307",
)
CORNER = ("scene.load.torque_N_m=4.775",)


@pytest.mark.parametrize(
    ("scene", "design"), [(JOINT, (39.33, 8.83, 1.32)), (CORNER, (34.0, 7.0, 3.0))]
)
def test_the_check_bounds_the_error(scene, design):
    """The disagreement bounds the errors of all gradients, at any tolerance.

    In the first scene, the contact passes a joint within 1e-4 mesh periods, where derivatives jump.
    With steps around the joint of the same length on both grids, the mean was 1e-5 off at any
    tolerance, and the disagreement 1e-8. In both scenes, the peak is on a corner of the force. In
    the second, with rates from differences of the force, its gradient was 2e-5 off. With values
    4e-8 mesh periods beside the corner, it was 2e-7 off in both. With values 1e-4 of an element
    beside the corner, extrapolated by a cubic, it was 2e-5 off in the second."""
    design, way, names = (
        np.array(design),
        np.array([1.0, -0.7, 0.8]),
        ("mean_force_N", "peak_force_N", "rms_force_N"),
    )
    evaluator = Evaluator.of(load("configs/cic_drawn.yaml", scene)).surveying()

    def terms(found):
        rows = np.array([list(found.gradient[name].values()) for name in names])
        return rows * design * way

    found = {rtol: evaluator.at_tolerance(rtol)(design, series=False) for rtol in (1e-8, 1e-10)}
    state, period = found[1e-10].state, found[1e-10].steady_state["period"]

    def forces(change):
        return closed(evaluator.pair(design * (1 + change * way)), state, period).forces

    truth, noise = differentiated(forces, 1e-3)
    for rtol, one in found.items():
        slopes = terms(one)
        size = np.max(np.abs(slopes), axis=1)
        error = np.maximum(np.abs(np.sum(slopes, axis=1) - truth) - noise, 0.0) / size
        said = one.statistics["gradient_disagreement"]
        assert np.max(noise / size) < 1e-6
        assert np.max(error) < said < 1e-4, rtol
        # The mesh for 1e-8 leaves 1.3e-7 in the first scene.
        assert np.max(error) < {1e-8: 2e-7, 1e-10: 1e-7}[rtol]


def test_what_is_not_certain_has_no_derivatives():
    rtol, orbit = jnp.asarray(1e-8), Orbit.empty(jnp.zeros(2), 3, 3)
    scales = jnp.asarray(1.5), jnp.asarray(0.033), jnp.asarray(100.0)

    def certain(apart):
        found = orbit._replace(disagreement=jnp.asarray(apart))
        return bool(verdict(found, jnp.zeros(2), (1e-3, 1e-9), (rtol, rtol), scales).certain)

    limit = float(agreement(rtol))
    assert certain(0.9 * limit)
    assert not certain(1.1 * limit)
    assert not certain(np.nan)
