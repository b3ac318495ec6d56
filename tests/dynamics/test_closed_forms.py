"""Small parts of the numerics, each by itself, against closed forms and computations of their own.

No rotor is simulated here: a pair whose flanks are never in reach is a damped oscillator, and what
adds up motions is given motions made by hand.
"""

import dataclasses
import threading
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.config.families import Parameter, parameters
from rootsopt.contact.gap import Contact
from rootsopt.contact.impact import ImpactLaw
from rootsopt.contact.map import MARGIN
from rootsopt.contact.nodes import signed_distance
from rootsopt.contact.search import SearchContact
from rootsopt.contact.size import MapSize, _smallest
from rootsopt.continuation import orbits
from rootsopt.continuation.arclength import StepSizes
from rootsopt.design.space import sobol
from rootsopt.dynamics import peak, window
from rootsopt.dynamics.flow import Flow
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.orbit import Shots, close_orbit
from rootsopt.dynamics.pair import FlankForce, RotorPair
from rootsopt.dynamics.parts import ConstantLoad, MotorDrive, PrescribedDrive, TimingGear
from rootsopt.dynamics.verdict import TOO_DEEP
from rootsopt.optimize import noise
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.search import Search, Trial, _history
from rootsopt.output import files
from rootsopt.profiles import CIC
from rootsopt.response import ensemble, evaluation, members, speeds
from rootsopt.response.evaluation import RESPONSES, Evaluation, Evaluator
from rootsopt.response.members import Members
from rootsopt.response.speeds import AtSpeed, SpeedsEvaluator
from rootsopt.runtime.threads import on_all_cores
from rootsopt.scene import Scene
from rootsopt.status import Status

LOBES, SPEED, INERTIA, STIFFNESS, DAMPING, LOAD = 3, 300.0, 2e-3, 2e3, 1.5, 0.4
HALF_BACKLASH, SCALE = 1e-3, 5e-3


class Far(Contact):
    """Flanks a metre apart in every position."""

    def __call__(self, roll, relative):
        return jnp.ones_like(roll), jnp.zeros_like(roll), jnp.zeros_like(roll)


def oscillator(**changes) -> RotorPair:
    """A pair held by its gear alone."""
    gear = TimingGear(*(jnp.asarray(x) for x in (STIFFNESS, DAMPING, HALF_BACKLASH, 1e-6)))
    parts = {
        "lobes": LOBES,
        "contact": Far(),
        "law": ImpactLaw(*(jnp.asarray(x) for x in (1e9, 1.5, 100.0, 1e-5, 1e-7))),
        "clearance": jnp.asarray(0.0),
        "inertia": jnp.asarray(INERTIA),
        "drive": PrescribedDrive(jnp.asarray(SPEED)),
        "load": ConstantLoad(jnp.asarray(LOAD)),
        "gear": gear,
        "angle_scale": jnp.asarray(SCALE),
        "force_scale": jnp.asarray(100.0),
    }
    return RotorPair(**parts | changes)


# Motions


def test_motion_between_samples_and_within_steps():
    """A motion of degree five in time is known exactly between its samples, and one of degree three
    within a step, with its rate; other states to degree four and in proportion."""
    pair = oscillator()
    curve, other = (
        np.polynomial.Polynomial([0.3, -1, 2, 0.5, -3, 2]),
        np.polynomial.Polynomial([1, 2, -1, 0.5, 3]),
    )
    width = 0.125
    times = width * np.arange(9)
    states = jnp.asarray(np.column_stack([curve(times), curve.deriv()(times), other(times)]))
    between = jax.jit(lambda place: peak.motion(pair, states, place, jnp.asarray(width)))
    for tau in (0.0, 0.31, 0.4375, 0.5, 0.93):
        expected = [curve(tau), curve.deriv()(tau), other(tau)]
        np.testing.assert_allclose(between(jnp.asarray(tau / width)), expected, atol=1e-12)
    cubic = curve.cutdeg(3)
    ends = np.array([0.2, 0.5, 1.1, np.inf])
    begins = np.array([0.0, 0.2, 0.5, 1.1])

    def at(tau):
        tau = np.where(np.isfinite(tau), tau, 0.0)
        return jnp.asarray(np.column_stack([cubic(tau), cubic.deriv()(tau), 5 * tau]))

    steps = peak.Steps(jnp.asarray(begins), jnp.asarray(ends), at(begins), at(ends), jnp.asarray(3))
    within = jax.jit(lambda tau: steps.motion(pair, tau))
    for tau in (0.05, 0.2, 0.44, 0.8, 1.1):
        expected = [cubic(tau), cubic.deriv()(tau), 5 * tau]
        np.testing.assert_allclose(within(jnp.asarray(tau)), expected, atol=1e-12)
    # At x of a step of length h the cubic is as good as samples a width w apart: x (1 - x) h² < w².
    for tau, good in ((0.51, True), (0.8, False), (1.09, True), (0.35, True)):
        assert bool(steps.reaches(jnp.asarray(tau), jnp.asarray(0.2))) == good


def test_inertia_of_a_motor_turns_with_rotor_1():
    """Rotor 1 is sped up by the excess torque over both inertias, rotor 2 slowed by its load."""
    slope, torque, own, over = 0.2, 5.0, 7e-3, 4.0
    motor = MotorDrive(*(jnp.asarray(x) for x in (SPEED, torque, slope, own)))
    pair = oscillator(drive=motor, gear=None)
    period = 2 * np.pi / (LOBES * SPEED)
    share = over * period / SCALE
    state = jnp.array([0.1, 0.3, share])
    found, _ = jax.jit(lambda state: pair.derivative(jnp.asarray(0.2), state))(state)
    first = (torque - slope * over) / (INERTIA + own)
    second = -LOAD / INERTIA
    lapse = SPEED / (SPEED + over)
    unit = lapse * period**2 / SCALE
    expected = [lapse * 0.3, unit * (second - first), unit * first]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_motor_of_a_config_is_that_of_its_pair():
    motor = "{slope_N_m_s_per_rad: 0.3, torque_N_m: 6, inertia_kg_m2: 0.004}"
    config = load("configs/cic.yaml", ["scene.drive=torque", f"scene.motor={motor}"])
    drive = Scene.from_config(config)._drive(ConstantLoad(jnp.asarray(LOAD)))
    assert isinstance(drive, MotorDrive)
    numbers = [float(x) for x in (drive.speed, drive.torque, drive.slope, drive.inertia)]
    assert numbers == pytest.approx([100 * np.pi, 6, 0.3, 0.004])


# Statistics of motions made by hand


def told_flow(pair, state, means, growth=None):
    """A mesh period whose force has the mean `means[k]`, k being the first state; the next state
    counts one up. `growth`: what the derivative by the state is, times the unit matrix."""
    at = jnp.round(state[0]).astype(int)
    mean = jnp.asarray(means)[at]
    blank = Flow.empty(state.shape[0], 0, 2, 1, Measures(), state.dtype)
    slope = blank.slope
    if growth is not None:
        count = state.shape[0]
        slope = slope.at[:count].set(jnp.exp(jnp.asarray(growth)[at]) * jnp.eye(count))
    return blank._replace(
        end=state.at[0].add(1.0).at[1].set(at % 3 + 0.001 * at),
        mean=mean,
        mean_square=2 * mean**2,
        peak=3 * mean + at % 2,
        depth=-mean,
        states=jnp.stack([state, -2 * state]),
        solved=jnp.asarray(True),
        slope=slope,
    )


def test_averages_of_a_member(monkeypatch):
    """Means, greatest values and drift of a window after `settle` others, against NumPy; the drift
    is positive where the force rises, and the middle of an odd window belongs to neither half."""
    settle = 3
    means = np.random.default_rng(0).uniform(1, 2, 20) + np.arange(20)
    monkeypatch.setattr(members, "flow", lambda pair, state, *rest: told_flow(pair, state, means))
    monkeypatch.setattr(
        members,
        "strobe",
        lambda pair, state, *rest: types.SimpleNamespace(
            states=state[None].at[0, 0].add(1.0), solved=jnp.asarray(True)
        ),
    )
    averages = averages_from(jnp.zeros(2))
    for periods in (1, 2, 7, 12):
        found = averages(settle, periods)
        window = means[settle : settle + periods]
        at = settle + np.arange(periods)
        peaks = 3 * window + at % 2
        expected = [np.mean(window), np.mean(2 * window**2), np.mean(peaks)]
        np.testing.assert_allclose(found.means, expected, rtol=1e-12)
        half = periods // 2
        drift = np.mean(window[-half:]) - np.mean(window[:half]) if half else 0.0
        assert float(found.drift) == pytest.approx(drift, rel=1e-12)
        assert half == 0 or drift > 0
        assert float(found.greatest) == pytest.approx(np.max(peaks))
        # The trace of `told_flow` holds the state and -2 of it.
        assert float(found.reach) == pytest.approx(SCALE * 2 * at[-1])
        assert float(found.depth) == pytest.approx(np.max(-window))
        assert float(found.states[0]) == settle + periods
        assert not np.any(found.repeats)
        assert not bool(found.stalled)
        assert bool(found.solved)


def averages_from(state):
    """Function (settle, periods) → what a member from `state` comes to."""
    pair, how = oscillator(), Integrator("tsit5", jnp.asarray(1e-6), 64)
    run = jax.jit(lambda *counts: members.member(pair, state, *counts, how))
    return lambda settle, periods: run(jnp.asarray(settle), jnp.asarray(periods))


def test_a_member_repeats_after_its_period(monkeypatch):
    """The last states of a motion of three mesh periods repeat after 3 and 6, not after others."""

    def step(state):
        return jnp.array([0.5, 0.0]).at[1].set((jnp.round(state[1]) + 1) % 3)

    blank = told_flow(None, jnp.zeros(2), [1.0])
    monkeypatch.setattr(members, "flow", lambda pair, state, *rest: blank._replace(end=step(state)))
    averages = averages_from(jnp.zeros(2))
    # A cycle of k counts once the last k + 1 states have been there k mesh periods before.
    for periods, seen in ((40, [2, 5]), (13, [2, 5]), (12, [2]), (7, [2]), (6, [])):
        assert np.flatnonzero(averages(0, periods).repeats).tolist() == seen


def of_means(means) -> Members:
    """Members of which only the means are of interest."""
    count = len(means)
    zero, no = np.zeros(count), np.zeros(count, bool)
    return Members(
        means, zero, zero, zero, zero, np.zeros((count, 2)), np.zeros((count, 8), bool), no, no, ~no
    )


def test_standard_errors_of_members_are_their_scatter():
    """Mean, peak and RMS of 4000 ensembles of independent members scatter as they state."""
    rng = np.random.default_rng(7)
    samples, count = 4000, 24
    level = 5 + rng.normal(size=(samples, count))
    square = level**2 + rng.gamma(4.0, 1.5, size=(samples, count))
    peak = 20 + 3 * rng.normal(size=(samples, count))
    every = np.stack([level, square, peak], axis=-1)
    found = np.array([of_means(one).responses for one in every])
    values, errors = found[..., 0], found[..., 1]
    np.testing.assert_allclose(values[0, :2], [np.mean(level[0]), np.mean(peak[0])])
    np.testing.assert_allclose(values[0, 2], np.sqrt(np.mean(square[0])))
    scatter = np.std(values, axis=0, ddof=1)
    stated = np.sqrt(np.mean(errors**2, axis=0))
    np.testing.assert_allclose(stated, scatter, rtol=0.05)
    assert of_means(np.zeros((3, 3))).responses.tolist() == np.zeros((3, 2)).tolist()


def test_lyapunov_exponent_and_its_standard_error(monkeypatch):
    """The mean logarithm of the growth, with the standard error of the mean of 16 batches: for
    independent growths, their standard deviation over the root of their number."""
    periods = 4096
    growth = 0.3 + 0.5 * np.random.default_rng(3).normal(size=periods)

    def flow(pair, state, one, how, samples, still, measures):
        out = told_flow(pair, state, np.ones(periods), growth)
        return out._replace(states=jnp.tile(state, (samples, 1)))

    monkeypatch.setattr(window, "flow", flow)
    how = Integrator("tsit5", jnp.asarray(1e-6), 64)
    found = window.lyapunov(oscillator(), jnp.zeros(2), periods, how)
    assert float(found.exponent) == pytest.approx(np.mean(growth), rel=1e-9)
    batches = [np.mean(growth[k : k + 256]) for k in range(0, periods, 256)]
    assert float(found.error) == pytest.approx(np.std(batches, ddof=1) / np.sqrt(16), rel=1e-9)
    assert float(found.error) == pytest.approx(np.std(growth) / np.sqrt(periods), rel=0.4)
    assert float(found.end[0]) == int(found.done) == periods
    np.testing.assert_array_equal(found.states[:, 0, 0], np.arange(periods))


def test_slopes_and_errors_per_config_unit():
    """Random slopes in the unit box, carried to config units one by one, have the mean and scatter
    stated: dR/dp = dR/dx (dp/dx)⁻¹, with a Jacobian that is far from symmetric."""
    rng = np.random.default_rng(11)
    jacobian = np.array([[2.0, 0.0, 0.0], [1.5, 0.5, 0.0], [-4.0, 1.0, 3.0]])
    slope = rng.normal(size=(2, 3))
    roots = rng.normal(size=(2, 3, 3))
    covariance = roots @ roots.transpose(0, 2, 1)
    found, errors = ensemble.per_config_unit(slope, covariance, jacobian)
    for k in range(2):
        drawn = rng.multivariate_normal(slope[k], covariance[k], size=40_000)
        # One solution for each: x jacobian = drawn.
        moved = np.linalg.solve(jacobian.T, drawn.T).T
        scatter = np.std(moved, axis=0)
        np.testing.assert_allclose(errors[k], scatter, rtol=0.03)
        assert np.all(np.abs(found[k] - np.mean(moved, axis=0)) < 5 * scatter / 200)


# Columns, gaps, maps


def test_series_has_drive_and_coast_where_they_belong(monkeypatch):
    """From the contact to the columns of the file: the drive flank's force is the drive column."""
    count = 5
    tau, states = np.arange(count) / count, np.zeros((count, 2))
    one = np.arange(1.0, count + 1)
    contact = FlankForce(
        drive=one, coast=10 * one, depth=2 * one, closing=3 * one, lever1=4 * one, lever2=5 * one,
        torque1=6 * one, torque2=7 * one,
    )  # fmt: skip
    physical = 0.2 * one, 0.3 * one
    monkeypatch.setattr(
        evaluation, "_contact_series", lambda *args: (0.02, np.ones(count), physical, contact)
    )
    columns = files.response_columns(evaluation._series(oscillator(), tau, states))
    expected = {
        "time_s": 0.02 * tau,
        "rotation_deg": 120 * tau,  # three lobes
        "relative_rotation_rad": 0.2 * one,
        "relative_speed_rad_s": 0.3 * one,
        "drive_flank_force_N": one,
        "coast_flank_force_N": 10 * one,
        "contact_force_N": 11 * one,
    }
    assert list(columns) == list(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(columns[name], values, rtol=1e-14, err_msg=name)


def test_long_steps_of_an_orbit_are_divided():
    """No step of a continued orbit is longer than 1/256 mesh period and a quarter, the ends there
    were stay, and none is added within a quarter of another, or beyond the orbit."""
    given = np.array([0.3 / 256, 2.1 / 256, 0.1, 0.1001, 1.0, 1.5])
    grid = np.concatenate([given, np.full(1024 - len(given), np.inf)])
    made = np.asarray(orbits._without_long(jnp.asarray(grid), jnp.asarray(1.5)))
    assert len(made) == 1024
    ends = made[np.isfinite(made)]
    assert np.all(np.isin(given, ends))
    steps = np.diff(ends, prepend=0.0)
    assert np.max(steps) <= 1.25 / 256 + 1e-15
    added = ends[~np.isin(ends, given)]
    np.testing.assert_allclose(256 * added, np.round(256 * added), atol=1e-12)
    assert np.min(np.abs(added[:, None] - np.append(given, 0.0))) > 0.25 / 256
    assert np.max(added) < 1.5


def test_work_is_divided_among_the_cores():
    """Every row is done once and comes out in its place, whatever the shape of a row."""
    rng = np.random.default_rng(0)
    for count in (1, 2, 5, 8):
        designs, states = jnp.asarray(rng.normal(size=(count, 3))), jnp.arange(float(count))
        doubled, summed = on_all_cores(
            lambda a, b: (2 * a, jnp.sum(a, axis=-1) + b), designs, states
        )
        np.testing.assert_array_equal(doubled, 2 * designs)
        np.testing.assert_allclose(summed, np.sum(designs, axis=1) + np.arange(count))


class Near(Contact):
    """Flanks that overlap by the radius of 0.03 m times the turn towards them."""

    def __call__(self, roll, relative):
        return 0.03 * relative, 0.03 * jnp.ones_like(roll), 0.03 * jnp.ones_like(roll)


def test_rotor_2_behind_touches_the_drive_flank():
    """ε < 0: rotor 2 lags, so that rotor 1 drives it forward; ε > 0: the other way about."""
    pair = oscillator(contact=Near())
    for relative, drives in ((-1e-3, True), (1e-3, False)):
        found = pair.contact_force(jnp.asarray(0.1), jnp.asarray(relative), jnp.asarray(0.0))
        forces = float(found.drive), float(found.coast)
        assert (forces[0] > 0, forces[1] > 0) == (drives, not drives)
        assert float(found.total) == pytest.approx(1e9 * (0.03 * 1e-3) ** 1.5, rel=1e-12)
        assert float(found.torque2) == pytest.approx((1 if drives else -1) * 0.03 * max(forces))
        assert float(found.torque1) == pytest.approx(-float(found.torque2))


def test_switches_of_a_pair_are_those_of_its_parts():
    """They change where the penetration passes the rounding of the onset and the depth of full
    damping, and |ε| the backlash and its rounding; a flank out of reach is of no account."""
    pair = oscillator(contact=Near())
    switches = jax.jit(lambda relative: pair.switches(jnp.asarray(0.2), relative))
    places = {1: 1e-7 / 0.03, 2: 1e-5 / 0.03, 6: HALF_BACKLASH, 7: HALF_BACKLASH + 1e-6}
    for side in (-1, 1):
        for number, place in places.items():
            seen = [
                switches(jnp.array([side * share * place / SCALE, 0.0]))[0][number]
                for share in (0.9999, 1.0001)
            ]
            assert seen == [False, True]
        flags, counts = switches(jnp.array([side * 1e-3 / SCALE, 0.0]))
        assert flags[0]
        assert bool(flags[5]) == (side < 0)
        assert np.all(counts)
    _, counts = oscillator().switches(jnp.asarray(0.2), jnp.array([0.1, 0.0]))
    assert counts.tolist() == 5 * [False] + 3 * [True]


def test_levers_may_jump_where_flanks_do_not_roll():
    """At the nominal centre distance conjugate flanks roll on each other, with one closest
    approach; anywhere else there may be two as deep."""
    paper = CIC(3, 0.033, np.radians(36.43), 8e-3, np.radians(4.0))
    assert not SearchContact.of(paper).jumps
    displaced = SearchContact.of(paper, jnp.asarray(0.0662), two_sided=True)
    assert displaced.jumps
    assert float(displaced.pair.center_distance) == 0.0662


def test_distance_from_a_circle_of_few_nodes():
    """Outside positive; to the chords too great by up to R (1 - cos π/n) outside, and by the cubics
    with an error of fourth order."""
    rng = np.random.default_rng(0)
    radii, angles = rng.uniform(0.5, 1.5, 300), rng.uniform(0, 2 * np.pi, 300)
    nodes = radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    errors = []
    for count in (32, 64):
        turns = 2 * np.pi * np.arange(count + 1) / count
        circle = np.column_stack([np.cos(turns), np.sin(turns)])
        straight, cubic = (signed_distance(nodes, circle, refine) for refine in (False, True))
        sagitta = 1 - np.cos(np.pi / count)
        far = straight - (radii - 1)
        assert -1e-12 < np.min(far) < 0.1 * sagitta
        assert 0.9 * sagitta < np.max(far) < 1.001 * sagitta
        errors.append(np.max(np.abs(cubic - (radii - 1))))
        assert errors[-1] < 0.02 * sagitta
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.2)


def test_limits_are_those_that_are_told():
    """A pair is lost a quarter of the angle from a lobe's axis to its flank away; the depth that a
    status tells of is the one that sets it."""
    pair = oscillator()
    limit = np.pi / 24 / SCALE
    for share, lost in ((0.999, False), (1.001, True)):
        for side in (-1, 1):
            state = jnp.array([side * share * limit, 0.0])
            assert bool(pair.lost(state)) == lost
            slope, _ = pair.derivative(jnp.asarray(0.0), state)
            assert bool(slope[1] == 0) == lost
    assert f"({100 * TOO_DEEP:g} % of the pitch radius)" in Status.TOO_DEEP.value


@pytest.mark.parametrize("period", [1, 3])
def test_longest_gap_of_an_orbit_is_in_mesh_periods(monkeypatch, period):
    """A quarter of an orbit of k mesh periods without a touch lasts k/4 of them."""
    touching = np.ones(504, bool)
    touching[100:226] = False
    out = Flow.empty(2, 1, 4, 4, Measures(), jnp.zeros(0).dtype)._replace(
        solved=np.asarray(True), depth=np.asarray(1e-6), mean_square=np.asarray(25.0),
        mean=np.asarray(3.0), peak=np.asarray(9.0), end=np.array([0.4, -0.2]),
        states=np.array([[0.4, -0.2], [0.6, 0.1], [-0.7, 0.3], [0.2, 0.2]]),
    )  # fmt: skip
    shot = orbits._Shot(out, np.zeros(4), np.asarray(False), touching, np.asarray(2e-3))
    subject = object.__new__(orbits.Orbits)
    subject.period, subject.unit, subject.width = period, 1e-3, 200.0
    subject.limits = StepSizes(100.0, 300.0)
    subject.scene = types.SimpleNamespace(fidelity="search", pitch_radius=0.033)
    monkeypatch.setattr(orbits.Orbits, "_check_design", lambda self, value: None)
    monkeypatch.setattr(orbits.Orbits, "_shot", lambda self, *args, **options: shot)
    look = subject(np.array([0.4, -0.2, 0.5 * orbits.SPAN]) / orbits.SPAN, None, False)
    seen = look.data
    assert seen.gap_time == pytest.approx(period / 4)
    np.testing.assert_allclose(seen.statistics, [3.0, 9.0, 5.0])
    # In the units of a config whose angle scale is twice that of the curve.
    np.testing.assert_allclose(seen.state, [0.2, -0.1])
    assert seen.reach == pytest.approx(0.7e-3)
    assert seen.half_way == pytest.approx(1.1 / orbits.SPAN)
    assert seen.residual == pytest.approx(0, abs=1e-15)
    point = subject.point(orbits.Spot(np.array([0.02, -0.01, 0.5]), np.eye(3)[-1], look, 2))
    assert (point.value, point.period, point.gap_time) == (200.0, period, seen.gap_time)
    np.testing.assert_allclose(np.sort(np.abs(point.multipliers)), [0, 0])


def test_error_of_a_map_is_what_its_spline_leaves():
    """The greatest difference between a fine sampling and the cubic spline through the map's own
    points, where the flanks overlap, by an interpolation written anew."""
    from scipy.interpolate import make_interp_spline

    points = np.linspace(0.0, 1.0, 3073)
    lines = np.stack([-1 - 0.3 * np.cos(9 * points), -2 - 0.1 * np.sin(25 * points)])
    exact = [lambda x: -1 - 0.3 * np.cos(9 * x), lambda x: -2 - 0.1 * np.sin(25 * x)]
    for asked in (1e-4, 1e-5, 1e-6):
        count, error = _smallest(
            (12, 24, 48, 96, 192), 0.0, 1.0, (jnp.asarray(points), jnp.asarray(lines)), asked
        )
        assert error <= asked
        # A map of n points has some beyond the range: those within it are a uniform grid.
        step = 1.0 / (count - 1 - MARGIN)
        knots = step * np.arange(count - MARGIN)
        left = [
            np.max(np.abs(make_interp_spline(knots, f(knots), bc_type="not-a-knot")(points) - line))
            for f, line in zip(exact, lines, strict=True)
        ]
        assert error == pytest.approx(max(left), rel=1e-3)


def test_stated_error_of_a_map_is_relative_to_the_static_depth(monkeypatch):
    """`map_error` is that of the penetration over the depth which carries the load: F = K δ^e."""
    config = load("configs/cic.yaml", ["solver.fidelity=map", "solver.map_error=2e-3"])
    evaluator = Evaluator.of(config)
    depth = 1e-3 * (4.775 / 33e-3 / 2e5) ** (1 / 2.2)
    asked = []

    def size_map(profile, deepest, error):
        asked.append(error)
        return MapSize(256, 24, 0.7 * error, True)

    monkeypatch.setattr(evaluation, "size_map", size_map)
    sized = evaluator._sized(jnp.array([36.43, 8.0, 4.0]))
    assert asked == pytest.approx([2e-3 * depth])
    assert sized.map_error == pytest.approx(1.4e-3)
    assert sized.scene.map_size == (256, 24)
    # The evaluator that was asked stays as it was.
    assert np.isnan(evaluator.map_error)


def test_ranges_of_parameters_that_a_config_leaves_open():
    """Lengths go with the pitch radius, the tip land with the lobe pitch, and every other one has
    the range of its kind; no length is negative."""
    other = Parameter("some_other_angle_deg", "an angle", 0, 180)
    expected = {
        "arc_center_mm": (15.0, 29.97),
        "rolling_radius_mm": (0.3, 45.0),
        "edge_radius_mm": (0.3, 45.0),
        "tip_arc_angle_deg": (0.0, 15.0),
        "tip_arc_turn_deg": (1.0, 90.0),
        "pressure_angle_deg": (15.0, 60.0),
        "trochoid_ratio": (0.0, 2.0),
        "coefficients": (-1.0, 1.0),
        "some_other_angle_deg": (0.0, 90.0),
    }
    for key, pair in expected.items():
        found = (parameters() | {other.key: other})[key].usually(30.0, 3)
        assert found == pytest.approx(pair), key


# Speeds


def evaluation_of(force=1.0, status=Status.PERIODIC, design=(), state=None) -> Evaluation:
    """An evaluation whose forces are all `force`."""
    return Evaluation(
        design={f"x{k}": float(x) for k, x in enumerate(design)},
        geometry={"area_efficiency": 0.5},
        response=dict.fromkeys(RESPONSES, force) if status.usable else {},
        gradient={},
        steady_state={},
        status=status,
        message=status.value,
        statistics={"seconds": 1.0},
        series=None,
        state=np.zeros(2) if state is None else state,
    )


@pytest.mark.parametrize("failing", [2000.0, 3000.0, 4000.0])
def test_every_speed_simulated_counts_in_the_status(monkeypatch, failing):
    """The scene's own 3000 rpm has no share in the objective, but a result that fails there is
    none."""
    config = load("configs/cic.yaml", ["objective.speeds_rpm=[4000, 2000]"])
    evaluator = SpeedsEvaluator(Evaluator.of(config))

    def single(self, design, start, series):
        here = float(self.scene.speed) * 60 / (2 * np.pi)
        lost = abs(here - failing) < 1e-6
        return self, evaluation_of(here, Status.PASSED_THROUGH if lost else Status.PERIODIC)

    monkeypatch.setattr(Evaluator, "fit", single)
    found = evaluator()
    assert [part.share for part in found.parts] == [0.5, 0.0, 0.5]
    assert found.status is Status.PASSED_THROUGH
    assert not found.usable
    assert found.state is None
    assert found.message.startswith(f"At {failing:g} rpm: ")
    assert found.statistics["seconds"] == 3
    parts = [part._replace(evaluation=evaluation_of()) for part in found.parts]
    assert speeds.overall(parts)[0] is Status.PERIODIC
    wrong = [AtSpeed(1.0, 0.0, evaluation_of(status=Status.CHAOTIC)), *parts]
    assert speeds.overall(wrong)[0] is Status.CHAOTIC


# The search


def trial_of(point, objective, feasible=True) -> Trial:
    """A trial at a point of the unit box."""
    evaluation = evaluation_of(objective, design=point)
    return Trial(np.asarray(point, float), 0, 0, evaluation, objective, feasible)


def searching(truth=lambda point: 1.0, **settings) -> Search:
    """A search whose designs are points of the unit box, and whose verification finds the `truth`
    about them."""
    search = object.__new__(Search)
    search.stop, search._refuted, search._trials = threading.Event(), [], []
    search._found, search.checkpoint, search.noisy = {}, None, True
    search.method = settings.get("method")
    search.settings = types.SimpleNamespace(screening=0, seed=0, starts=2)
    vars(search.settings).update(settings)
    search.problem = types.SimpleNamespace(
        design=lambda point: point,
        objective=lambda evaluation: evaluation.response.get("mean_force_N", float("nan")),
        project=lambda point: point,
        toward=lambda point, inside: point,
        feasible=lambda point: True,
    )

    def exact(point):
        found = truth(tuple(point))
        status = Status.PERIODIC if np.isfinite(found) else Status.NOT_SETTLED
        return evaluation_of(found, status, point)

    search.exact = exact
    return search


@pytest.mark.parametrize(
    ("promised", "true", "accepted"),
    [
        (0.8, 0.8, True),
        (0.8, 0.8079, True),
        (0.8, 0.7921, True),
        (0.8, 0.8081, False),  # more than 1 % from what was promised, if still better than 1
        (0.8, 0.7919, False),
        (0.8, float("nan"), False),
        (0.995, 1.001, False),  # within 1 %, but no improvement
        (1.0, 0.995, False),  # nothing was promised
    ],
)
def test_a_promise_must_hold_up(promised, true, accepted):
    """A design is accepted if simulated again it is better than the baseline and within 1 % of
    what the search had."""
    search = searching(lambda point: true)
    found, record = search._verify([trial_of([0.3, 0.4], promised)])
    assert (found is not None) == accepted
    assert record["holds_up"] == accepted
    if accepted:
        assert record["verified_objective"] == true
        assert record["searched_objective"] == promised
        assert found.design == {"x0": 0.3, "x1": 0.4}


def test_the_best_feasible_trial_that_holds_up_is_taken():
    """Neither an infeasible one, though it is better, nor one without a steady state, nor one that
    does not hold up; and neighbours of a trial that failed are not tried."""
    truth = {(0.9, 0.9): 0.3, (0.1, 0.1): 0.95, (0.11, 0.1): 0.5, (0.5, 0.5): 0.602,
             (0.7, 0.2): 0.65}  # fmt: skip
    search = searching(lambda point: truth[point])
    trials = [
        trial_of([0.7, 0.2], 0.65),
        trial_of([0.9, 0.9], 0.3, feasible=False),
        trial_of([0.2, 0.9], float("nan")),
        trial_of([0.5, 0.5], 0.6),
        trial_of([0.11, 0.1], 0.51),
        trial_of([0.1, 0.1], 0.5),
    ]
    found, record = search._verify(trials)
    assert found is not None
    assert found.design == {"x0": 0.5, "x1": 0.5}
    (rejected,) = record["rejected"]
    assert rejected["verified_objective"] == 0.95
    assert not rejected["holds_up"]
    best = [row["best_objective"] for row in _history(trials)]
    np.testing.assert_array_equal(best, [0.65, 0.65, 0.65, 0.6, 0.51, 0.5])
    starts = searching(starts=9)._starts(trials)
    np.testing.assert_array_equal(starts, [[0.1, 0.1], [0.5, 0.5], [0.7, 0.2]])
    only_infeasible = trial_of([0.9, 0.9], 0.3, feasible=False)
    assert search._verify([only_infeasible])[0] is None
    assert np.isnan(_history([only_infeasible])[0]["best_objective"])
    assert searching()._starts([only_infeasible]) == []


def test_an_ensemble_takes_no_infeasible_candidate():
    problem = object.__new__(Problem)
    vars(problem)["objective"] = lambda evaluation: 0.01
    trials = [trial_of([0.9, 0.9], 0.3, feasible=False), trial_of([0.2, 0.3], 0.8)]
    ((objective, point),) = noise.candidates(
        problem, [dataclasses.replace(one, evaluation=evaluation_of()) for one in trials]
    )
    assert objective == 0.8
    np.testing.assert_array_equal(point, [0.2, 0.3])


@dataclasses.dataclass(frozen=True)
class Told(Evaluator):
    """An evaluator for which a quadratic bowl about 0.6 has no steady state beyond 0.3 at first."""

    asked: list = dataclasses.field(default_factory=list)

    def __call__(self, design=None, start=None, series=True):
        self.asked.append((tuple(design), start))
        lost = len(self.asked) == 2
        force = 0.5 + float(np.sum((np.asarray(design) - 0.6) ** 2))
        status = Status.NOT_SETTLED if lost else Status.PERIODIC
        return evaluation_of(force, status, design, state=np.asarray(design))


def test_a_descent_goes_half_way_back_from_where_there_is_no_steady_state():
    """By the rule's own steps otherwise, each from the orbit of the trial before."""
    search = searching(method="sgd", learning_rate=0.2, iterations=6)
    search.problem.descent = lambda point, slope: slope
    search.problem.slope = lambda evaluation, point: 2 * (point - 0.6)
    search.patience, search.expected = np.inf, 7
    search._lock, search._done, search._best = threading.Lock(), 0, float("nan")
    progress = []
    search.progress = lambda *numbers: progress.append(numbers)
    search.fast = evaluator = Told.of(load("configs/cic.yaml"))
    trials = search._descend(4, np.array([0.2, 0.3]))
    points = np.array([trial.point for trial in trials])
    assert len(trials) == 7
    # Steps of gradient descent at a rate that falls along a cosine to a twentieth.
    rates = [0.2 * (0.05 + 0.95 * (1 + np.cos(np.pi * k / 6)) / 2) for k in range(6)]
    expected = [np.array([0.2, 0.3])]
    expected.append(expected[0] - rates[0] * 2 * (expected[0] - 0.6))
    expected.append((expected[0] + expected[1]) / 2)
    for rate in rates[1:5]:
        expected.append(expected[-1] - rate * 2 * (expected[-1] - 0.6))
    np.testing.assert_allclose(points, expected, rtol=1e-6)
    starts = [start for _, start in evaluator.asked]
    assert starts[0] is None
    assert starts[2] is None
    for k in (1, 3, 4, 5, 6):
        np.testing.assert_array_equal(starts[k], points[k - 1])
    assert [trial.iteration for trial in trials] == list(range(7))
    assert {trial.start for trial in trials} == {4}
    done, wanted, best = np.array(progress).T
    np.testing.assert_array_equal(done, np.arange(1, 8))
    assert set(wanted) == {7}
    objectives = [trial.objective for trial in trials]
    np.testing.assert_array_equal(best, np.fmin.accumulate(objectives))


def test_a_slope_is_stripped_only_of_what_is_forbidden():
    """Steepest descent in a box with one linear constraint x + y ≥ 1: inside it is the slope
    itself, on a face or on the constraint without its part across, in a corner nothing."""
    problem = object.__new__(Problem)
    normal = np.array([1.0, 1.0])
    vars(problem)["look"] = lambda point: (
        point, np.eye(2), np.array([normal @ point - 1]), normal[None]
    )  # fmt: skip
    cases = [
        ([0.7, 0.8], [1.0, -2.0], [1.0, -2.0]),
        ([0.7, 1.0], [1.0, -2.0], [1.0, 0.0]),
        ([0.7, 1.0], [1.0, 2.0], [1.0, 2.0]),
        ([1.0, 1.0], [-1.0, -2.0], [0.0, 0.0]),
        ([0.6, 0.4], [1.0, 1.0], [0.0, 0.0]),
        ([0.6, 0.4], [3.0, 1.0], [1.0, -1.0]),
        ([0.6, 0.4], [-3.0, 1.0], [-3.0, 1.0]),
        ([1.0, 0.0], [1.0, 3.0], [0.0, 0.0]),
    ]
    for point, slope, expected in cases:
        found = problem.descent(np.array(point), np.array(slope))
        np.testing.assert_allclose(found, expected, atol=1e-12, err_msg=str(point))


def test_the_seed_of_a_search_chooses_its_screening():
    """The screened points are the Sobol sample of `optimizer.seed`, after the baseline's own."""
    own = np.array([0.5, 0.5, 0.5])
    samples = {}
    for seed in (0, 1, 5):
        points = searching(screening=6, seed=seed)._feasible(own)
        np.testing.assert_array_equal(points[0], own)
        samples[seed] = np.array(points[1:])
        np.testing.assert_array_equal(samples[seed], sobol(6, seed, 3))
    assert not np.any(samples[0] == samples[1])
    assert not np.any(samples[1] == samples[5])
    again = searching(screening=6, seed=5)._feasible(own)
    np.testing.assert_array_equal(again[1:], samples[5])


# A whole orbit


def test_multiplier_is_that_of_the_whole_orbit():
    """Around its rest a damped oscillator decays by exp(-c t/2I): over k mesh periods, k times as
    far as over one. The monodromy is its matrix exponential, and the multiplier no root or power
    of that."""
    pair = oscillator()
    period = 2 * np.pi / (LOBES * SPEED)
    matrix = np.array([[0.0, 1.0], [-STIFFNESS / INERTIA, -DAMPING / INERTIA]])
    roots, vectors = np.linalg.eig(matrix)
    assert roots[0].imag != 0
    rest = -(HALF_BACKLASH + LOAD / STIFFNESS) / SCALE
    how = Integrator("tsit5", jnp.asarray(1e-9), 512)
    unit = np.diag([SCALE, SCALE / period])

    @jax.jit
    def close(length):
        still, shots = window.no_tangents(pair), Shots(how, samples=840)
        return close_orbit(pair, still, jnp.array([rest + 0.01, 0.0]), length, shots)

    for length in (1, 2, 3):
        orbit = close(jnp.asarray(length))
        grown = (vectors * np.exp(roots * length * period)) @ np.linalg.inv(vectors)
        expected = np.linalg.inv(unit) @ grown.real @ unit
        np.testing.assert_allclose(orbit.monodromy, expected, atol=1e-6)
        assert float(orbit.multiplier) == pytest.approx(
            np.exp(-DAMPING / (2 * INERTIA) * length * period), rel=1e-5
        )
        np.testing.assert_allclose(orbit.state, [rest, 0.0], atol=1e-8)
        assert float(orbit.residual) < 1e-9
        # Of a linear equation one step of Newton's method finds the orbit.
        assert int(orbit.newton_steps) < 8
