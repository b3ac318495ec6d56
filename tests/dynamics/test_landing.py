"""Tests of steps that end where free flight may end, and of the check of derivatives."""

import dataclasses
import functools

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


@functools.cache
def landing(*changes) -> tuple[LandingControl, float]:
    """Return the control of steps of a scene, and its unit of angle (rad)."""
    own = ["contact.clearance_mm=0", "scene.timing_gear.backlash_mm=0.2", *changes]
    config = load("configs/cic_drawn.yaml", own)
    pair = Evaluator.of(config).pair(config.design)
    found = Integrator("tsit5", jnp.asarray(1e-8), 4096).controller(pair)
    assert isinstance(found, LandingControl)
    return found, float(pair.angle_scale)


def test_edges_are_those_of_clearance_and_backlash():
    half, gap = 0.1 / 33, 0.03 / 33
    control, unit = landing()
    assert np.sort(control.edges) * unit == pytest.approx([-half, 0, 0, half], abs=1e-15)
    assert np.isinf(control.inside)
    control, unit = landing("contact.clearance_mm=0.03")
    assert np.sort(control.edges) * unit == pytest.approx([-half, -gap, gap, half])
    assert float(control.inside) * unit == pytest.approx(gap)
    # With displaced axes, the flanks may touch at any ε.
    assert float(landing("scene.center_distance_error_mm=0.01")[0].inside) == 0


def adapted(before, after, step):
    """Return whether a step between these states, with no error, is kept, and where the next one
    ends."""
    begin = jnp.asarray(0.2)
    args = begin, begin + step, jnp.asarray(before), jnp.asarray(after), None, jnp.zeros(2), 5.0
    state = jnp.asarray(1.0), jnp.asarray(1.0), jnp.asarray(False)
    keep, start, stop, *_ = landing()[0].adapt_step_size(*args, state)
    return bool(keep), float(start - begin), float(stop - begin)


def parabola(place, rate, bend, time):
    return [place + rate * time + bend / 2 * time**2, rate + bend * time]


@pytest.mark.parametrize("bend", [-30.0, 0.0, 40.0])
@pytest.mark.parametrize("place", [0.3, -0.2])
def test_the_next_step_ends_just_beyond_the_edge(place, bend):
    """The next step ends just beyond the edge ε = 0; steps of 1/32 mesh period would pass it by
    far."""
    step = 0.004
    rate = -12.0 * np.sign(place)
    roots = np.roots([bend / 2, rate, place]) if bend else np.array([-place / rate])
    meets = min(float(r.real) for r in roots if abs(r.imag) < 1e-12 and r.real > 0)
    found = adapted(*(parabola(place, rate, bend, t) for t in (0.0, step)), step)
    assert found == pytest.approx((True, step, min(meets + 1e-4, step + 1 / 32)), rel=1e-9)


def test_a_step_that_passed_an_edge_far_is_taken_again():
    assert adapted([0.05, -10.0], [-0.2, -10.0], 0.025) == pytest.approx((False, 0, 0.005 + 1e-4))
    # A step that passes the edge as intended is kept; the next one starts short.
    found = adapted([0.05, -10.0], [-0.001, -10.0], 0.0051)
    assert found == pytest.approx((True, 0.0051, 0.0051 + 5e-4))


def test_a_step_ends_at_a_turn_beside_an_edge():
    """A step ends where a parabola turns 0.01 before the edge, because it might reach the edge."""
    bend, turn, step = 100.0, 0.02, 0.002
    stops = []
    for beyond in (0.0, 0.3):
        begin = 0.01 + beyond + bend / 2 * turn**2, -bend * turn
        keep, _, stop = adapted(begin, parabola(*begin, bend, step), step)
        assert keep
        stops.append(stop)
    # Far from every edge, the step is not limited.
    assert stops[0] == pytest.approx(turn)
    assert stops[1] > turn


@pytest.mark.parametrize("rtol", [1e-4, 1e-11])
def test_a_touch_between_two_stages_is_met(rtol):
    """A touch is found in a free fall onto a stiff floor at ε = 0, from a height at which steps are
    long."""
    base = diffrax.PIDController(rtol=rtol, atol=rtol, dtmax=1.0)
    control = dataclasses.replace(landing()[0], base=base)

    def field(t, y, args):
        return jnp.stack([y[1], -1.0 + jnp.where(y[0] < 0, 4e6 * y[0] ** 2, 0.0)])

    found = eqx.filter_jit(diffrax.diffeqsolve)(
        diffrax.ODETerm(field),
        diffrax.Tsit5(),
        t0=0.0,
        t1=3.0,
        dt0=1e-3,
        y0=jnp.asarray([0.5, 0.0]),
        stepsize_controller=control,
        throw=False,
    )
    # The floor gives back what it takes, and is left by t = 2.
    ((place, rate),) = np.asarray(found.ys)
    assert place + rate**2 / 2 == pytest.approx(0.5, abs=max(300 * rtol, 1e-9))


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
    step, way, found = 5e-5, np.array([1.0, -0.7, 0.8]), evaluator(series=False)
    assert found.status is Status.PERIODIC
    assert found.statistics["gradient_disagreement"] < 1e-4
    # At the default tolerance, rounding alone changes the mean by 1e-8, and the difference by 1e-2.
    sharp = evaluator.at_tolerance(1e-11)
    slope = 0.0
    for change in (step, -step):
        design = jnp.asarray([35.23, 5.77, 1.68] + change * way)
        end = sharp(design, start=found.state, series=False)
        slope += end.response["mean_force_N"] / (2 * change)
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
    design, way = np.array(design), np.array([1.0, -0.7, 0.8])
    evaluator = Evaluator.of(load("configs/cic_drawn.yaml", scene)).surveying()
    found = {rtol: evaluator.at_tolerance(rtol)(design, series=False) for rtol in (1e-8, 1e-10)}
    state, period = found[1e-10].state, found[1e-10].steady_state["period"]

    def forces(change):
        return closed(evaluator.pair(design * (1 + change * way)), state, period).forces

    truth, noise = differentiated(forces, 1e-3)
    for rtol, one in found.items():
        rows = [list(one.gradient[f"{name}_force_N"].values()) for name in ("mean", "peak", "rms")]
        slopes = np.array(rows) * design * way
        size = np.max(np.abs(slopes), axis=1)
        error = np.maximum(np.abs(np.sum(slopes, axis=1) - truth) - noise, 0.0) / size
        assert np.max(noise / size) < 1e-6
        assert np.max(error) < one.statistics["gradient_disagreement"] < 1e-4, rtol
        # The mesh for 1e-8 leaves 1.3e-7 in the first scene.
        assert np.max(error) < {1e-8: 2e-7, 1e-10: 1e-7}[rtol]


def test_what_is_not_certain_has_no_derivatives():
    rtol, scales = jnp.asarray(1e-8), tuple(map(jnp.asarray, (1.5, 0.033, 100.0)))
    for share, certain in ((0.9, True), (1.1, False), (np.nan, False)):
        orbit = Orbit.empty(jnp.zeros(2), 3, 3)._replace(disagreement=share * agreement(rtol))
        found = verdict(orbit, jnp.zeros(2), (1e-3, 1e-9), (rtol, rtol), scales)
        assert bool(found.certain) is certain
