"""Tests of integrations: steps and methods, what they compile, what a batch shares, where steps end
in free flight, and the check of derivatives."""

import dataclasses
import functools
import os
import subprocess
import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from experiments._common.shooting import closed, differentiated, forces_near
from rootsopt import Status, load_config
from rootsopt.dynamics.flow import integrated, interpolated, one_period
from rootsopt.dynamics.integrator import METHODS, Integrator, LandingControl
from rootsopt.dynamics.orbit import Orbit, branch
from rootsopt.dynamics.steady import agreement, verdict
from rootsopt.response.evaluation import Evaluator


def swing(tau, y, gravity):
    """Return the slope of a pendulum's state `y` (2,), which is known up to 1 rad.

    `gravity`: square of the angular frequency of small oscillations."""
    return jnp.stack([y[1], -gravity * jnp.sin(jnp.where(jnp.abs(y[0]) < 1, y[0], jnp.nan))])


@functools.partial(jax.jit, static_argnums=0)
def both(method, gravity):
    """Return the integration by this loop, its states at the ends of diffrax's steps, and that by
    diffrax."""
    # Angle (rad) and speed (rad per unit of time) at the start.
    start, max_steps = jnp.array((0.3, -1.2)), 2048
    solver = Integrator(method, jnp.asarray(1e-6), max_steps).solver()
    term, control = diffrax.ODETerm(swing), diffrax.PIDController(1e-6, 1e-6, dtmax=1 / 32)
    ours = integrated(term, solver, control, start, gravity, max_steps, recorded=True)
    theirs = diffrax.diffeqsolve(
        term,
        solver,
        t0=0.0,
        t1=1.0,
        dt0=None,
        y0=start,
        args=gravity,
        saveat=diffrax.SaveAt(t1=True, steps=True, dense=True),
        stepsize_controller=control,
        adjoint=diffrax.ForwardMode(),
        max_steps=max_steps,
        throw=False,
    )
    inside = jax.vmap(lambda share: interpolated(ours, solver, share)[0])
    shown = theirs.ts, theirs.ys, theirs.stats, theirs.result == diffrax.RESULTS.successful
    return ours, inside(jnp.minimum(theirs.ts, 1.0)), shown


@pytest.mark.parametrize(
    ("method", "gravity", "ends_well"),
    [
        pytest.param("tsit5", 4000.0, True, id="order 5"),
        pytest.param("dopri8", 4000.0, True, id="order 8"),
        pytest.param("tsit5", 1e5, True, id="first step leaves the domain"),
        pytest.param("tsit5", 1e9, False, id="too few steps"),
        pytest.param("tsit5", np.nan, False, id="not a number"),
    ],
)
def test_steps_are_those_of_diffrax(method, gravity, ends_well):
    """An integration that does not reach the end says so."""
    ours, inside, (ends, after, stats, solved) = both(method, jnp.asarray(gravity))
    count = int(ours.accepted)
    assert bool(ours.solved) == bool(solved) == ends_well
    assert int(ours.steps) == int(stats["num_steps"])
    if not ends_well:
        return
    assert int(stats["num_accepted_steps"]) == count > 30
    np.testing.assert_allclose(ours.records.ends[:count], ends[:count], rtol=1e-12)
    np.testing.assert_allclose(inside[:count], after[:count], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours.end, inside[count - 1], rtol=1e-12)
    assert ours.records.ends[count - 1] == 1
    assert np.all(np.isinf(ours.records.ends[count:]))


def test_solvers_agree():
    config = load_config("configs/cic_drawn.yaml")
    found = []
    pair = Evaluator.of(config).pair(config.design)
    period = eqx.filter_jit(one_period)
    for method, rtol in (("tsit5", 1e-11), *((method, 1e-8) for method in METHODS)):
        how, state = Integrator(method, jnp.asarray(rtol), 20000), jnp.zeros(2)
        # The orbit's multiplier is 0.004: six periods leave 1e-14 of the start.
        for _ in range(7):
            out = period(pair, state, how)
            assert bool(out.solved)
            state = out.end
        mean, square, peak = out.response
        found.append([mean, peak, np.sqrt(square)])
    np.testing.assert_allclose(found[1:], [found[0]] * len(METHODS), rtol=1e-5)


_COUNT = """
import jax, jax.numpy as jnp, rootsopt
from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import Integrator

jax.config.update("jax_enable_x64", True)
config = rootsopt.load_config("configs/ee.yaml")
scene, how = rootsopt.Scene.from_config(config), Integrator("tsit5", jnp.asarray(1e-8), 1024)

def program(design, state):
    pair = scene.pair(design)
    return strobe(pair, state, 4, how), one_period(pair, state, how)

print(str(jax.make_jaxpr(program)(config.design, jnp.zeros(2))).count("callback"))
"""


def test_no_callback_to_python_in_an_integration():
    """An integration has no callback to Python, because programs with callbacks cannot be cached.

    Equinox's checks of the arguments of diffrax would be such callbacks. A command turns them off,
    but a caller from Python does not."""
    variables = {name: x for name, x in os.environ.items() if name != "EQX_ON_ERROR"}
    command = [sys.executable, "-c", _COUNT]
    done = subprocess.run(command, env=variables, check=True, capture_output=True, text=True)
    assert done.stdout == "0\n"


@pytest.mark.parametrize("limits", [[3, 500, 5], [500] * 3])
def test_branches_of_a_batch_on_a_gpu(monkeypatch, limits):
    """A branch that no motion takes is left out, and a motion that does not take a branch does not
    prolong its loops."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    turns, limits = [], np.array(limits)

    def counted(k):
        jax.debug.callback(lambda: turns.append(1))
        return k + 1

    def one(limit):
        def loop():
            return lax.while_loop(lambda k: k < limit, counted, jnp.zeros((), int))

        def stay():
            return jnp.zeros((), int)

        return branch(limit < 10, loop, stay), branch(limit >= 10, stay, loop)

    found = jax.jit(jax.vmap(one))(limits)
    jax.effects_barrier()
    small = np.where(limits < 10, limits, 0)
    np.testing.assert_array_equal(found, [small, small])
    assert len(turns) <= 2 * 3 * np.max(small)
    # A condition that is the same for the whole batch, and a branch without batched values.
    same = jax.vmap(lambda now, x: branch(now, lambda: 2 * x, lambda: -x), (None, 0))
    now = limits[0] < 10
    np.testing.assert_array_equal(jax.jit(same)(now, limits), 2 * limits if now else -limits)
    fixed = jax.vmap(lambda now: branch(now, lambda: jnp.ones(2), lambda: jnp.zeros(2)))
    np.testing.assert_array_equal(fixed(limits < 10)[:, 0], limits < 10)


# Free flight


@functools.cache
def landing(*changes) -> tuple[LandingControl, float]:
    """Return the control of steps of a scene, and its unit of angle (rad)."""
    own = ["contact.clearance_mm=0", "scene.timing_gear.backlash_mm=0.2", *changes]
    config = load_config("configs/cic_drawn.yaml", own)
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


@eqx.filter_jit
def _adapted(control, begin, end, before, after):
    state = jnp.ones(()), jnp.ones(()), jnp.zeros((), bool)
    return control.adapt_step_size(begin, end, before, after, None, jnp.zeros(2), 5.0, state)[:3]


def adapted(before, after, step):
    """Return whether a step between these states, with no error, is kept, and where the next one
    ends."""
    begin = 0.2
    at = map(jnp.asarray, (begin, begin + step, before, after))
    keep, start, stop = _adapted(landing()[0], *at)
    return bool(keep), float(start - begin), float(stop - begin)


def parabola(place, rate, bend, time):
    return [place + rate * time + bend / 2 * time**2, rate + bend * time]


@pytest.mark.parametrize("bend", [-30.0, 0.0, 40.0])
@pytest.mark.parametrize("place", [0.3, -0.2])
def test_the_next_step_ends_just_beyond_the_edge(place, bend):
    """The next step ends just beyond the edge ε = 0; steps of 1/32 mesh period would pass it by
    far."""
    step, rate = 0.004, -12.0 * np.sign(place)
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
    begins = [(0.01 + beyond + bend / 2 * turn**2, -bend * turn) for beyond in (0.0, 0.3)]
    near, far = (adapted(begin, parabola(*begin, bend, step), step) for begin in begins)
    assert near == pytest.approx((True, step, turn))
    # Far from every edge, the step is not limited.
    assert far[0]
    assert far[2] > turn


def falling(t, y, args):
    """Return the slope in a free fall onto a stiff floor at ε = 0."""
    return jnp.stack([y[1], -1.0 + jnp.where(y[0] < 0, 4e6 * y[0] ** 2, 0.0)])


@pytest.mark.parametrize("rtol", [1e-4, 1e-11])
def test_a_touch_between_two_stages_is_met(rtol):
    """It is found in a fall from a height at which steps are long."""
    base = diffrax.PIDController(rtol=jnp.asarray(rtol), atol=jnp.asarray(rtol), dtmax=1.0)
    control = dataclasses.replace(landing()[0], base=base)
    found = eqx.filter_jit(diffrax.diffeqsolve)(
        diffrax.ODETerm(falling),
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
    evaluator = Evaluator.of(load_config("configs/cic_drawn.yaml", scene)).surveying()
    step, way, found = 5e-5, np.array([1.0, -0.7, 0.8]), evaluator(series=False)
    assert found.status is Status.PERIODIC
    assert found.statistics["gradient_disagreement"] < 1e-4
    # At the default tolerance, rounding alone changes the mean by 1e-8, and the difference by 1e-2.
    sharp, design = evaluator.at_tolerance(1e-11), evaluator.config.design
    ends = (sharp(design + x * way, start=found.state, series=False) for x in (step, -step))
    slope = np.subtract(*(end.response["mean_force_N"] for end in ends)) / (2 * step)
    row = np.array(list(found.gradient["mean_force_N"].values()))
    assert row @ way == pytest.approx(slope, abs=1e-5 * np.max(np.abs(row)))


@pytest.mark.parametrize(
    ("scene", "design"),
    [
        (
            (
                "scene.speed_rpm=1015.7",
                "scene.load.torque_N_m=3",
                "scene.timing_gear.backlash_mm=0.055",
                "scene.timing_gear.damping_ratio=0.515",
                "scene.timing_gear.stiffness_N_m_per_rad=11307",
            ),
            (39.33, 8.83, 1.32),
        ),
        (("scene.load.torque_N_m=4.775",), (34.0, 7.0, 3.0)),
    ],
    ids=["joint", "corner"],
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
    evaluator = Evaluator.of(load_config("configs/cic_drawn.yaml", scene)).surveying()
    found = {rtol: evaluator.at_tolerance(rtol)(design, series=False) for rtol in (1e-8, 1e-10)}
    state, period = found[1e-10].state, found[1e-10].steady_state["period"]

    def pair(change):
        return evaluator.pair(design * (1 + change * way))

    orbit = closed(pair(0.0), state, period)
    truth, noise = differentiated(forces_near(pair, orbit, period), 1e-3)
    for rtol, one in found.items():
        rows = (one.gradient[f"{name}_force_N"].values() for name in ("mean", "peak", "rms"))
        slopes = np.array([*map(list, rows)]) * design * way
        size = np.max(np.abs(slopes), axis=1)
        error = np.maximum(np.abs(np.sum(slopes, axis=1) - truth) - noise, 0.0) / size
        assert np.max(noise / size) < 1e-6
        assert np.max(error) < one.statistics["gradient_disagreement"] < 1e-4, rtol
        # The mesh for 1e-8 leaves 1.3e-7 in the first scene.
        assert np.max(error) < {1e-8: 2e-7, 1e-10: 1e-7}[rtol]


def test_many_bounces_in_a_mesh_period():
    """Some forty: with at most 160 elements, the error was too large, and with 1.5 elements per
    event to begin with, Newton's method failed."""
    scene = ["scene.timing_gear.damping_ratio=0.1", "scene.speed_rpm=400"]
    evaluator = Evaluator.of(load_config("configs/cic_drawn.yaml", scene)).surveying()
    found = evaluator(series=False)
    assert found.status is Status.PERIODIC
    # Begun with the monodromy matrix 0, which is computed if that closes the orbit slowly.
    shot = closed(evaluator.pair([*found.design.values()]), found.state, 1, np.zeros((2, 2)))
    assert [*found.response.values()][:3] == pytest.approx(shot.forces, rel=1e-6)


def test_what_is_not_certain_has_no_derivatives():
    rtol, scales = jnp.asarray(1e-8), tuple(map(jnp.asarray, (1.5, 0.033, 100.0)))
    for share, certain in ((0.9, True), (1.1, False), (np.nan, False)):
        orbit = Orbit.empty(jnp.zeros(2), 3, 3)._replace(disagreement=share * agreement(rtol))
        found = jax.jit(verdict)(orbit, jnp.zeros(2), (1e-3, 1e-9), (rtol, rtol), scales)
        assert bool(found.certain) is certain
