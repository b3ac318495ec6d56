"""Steady state: closed orbit, its statistics and gradients, and the status of what has none."""

import json

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.dynamics.flow import Integrator, flow, strobe
from rootsopt.dynamics.steady import floquet
from rootsopt.evaluate import RESPONSES, Evaluator, evaluate
from rootsopt.model import DESIGN_KEYS
from rootsopt.status import Status

# The scene of the shipped configs as it was when the figures below were measured.
SCENE = (
    "scene.speed_rpm=3000",
    "scene.load.torque_N_m=4.775",
    "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.3, backlash_mm: 0.1}",
)
# The reference settings: contact by search, and a solver of order eight near rounding.
SHARP = ("solver.fidelity=search", "solver.method=dopri8", "solver.rtol=1e-12")
DESIGNS = {"paper": (36.43, 9.0, 4.0), "shorter involute": (36.43, 8.0, 4.0)}


def config_of(*overrides, path="configs/cic.yaml"):
    return load(path, [*SCENE, *overrides])


def gear(**changes):
    """Overrides for a scene with another gear, load or speed."""
    names = {"damping": "timing_gear.damping_ratio", "backlash": "timing_gear.backlash_mm"}
    names |= {"load": "load.torque_N_m", "speed": "speed_rpm"}
    return [f"scene.{names[key]}={value}" for key, value in changes.items()]


def numbers(evaluation):
    return np.array([evaluation.response[name] for name in RESPONSES])


def gradients(evaluation):
    """(response, design parameter)."""
    rows = (evaluation.gradient[name] for name in RESPONSES)
    return np.array([[row[key] for key in DESIGN_KEYS] for row in rows])


def integrator(rtol):
    return Integrator("dopri8", jnp.asarray(rtol), 20_000)


@eqx.filter_jit
def run_strobe(pair, states, periods, how):
    """End states of every period from several starts, (starts, periods, 2)."""
    return jax.lax.map(lambda y: strobe(pair, y, periods, how).states, states)


@eqx.filter_jit
def force_at(pair, start, times, how):
    """Force at ascending `times` (mesh periods), each the end of a solver step."""
    states = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda tau, y, _: pair.derivative(tau, y)[0]),
        how.solver,
        t0=0.0,
        t1=times[-1],
        dt0=1e-4,
        y0=start,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.ClipStepSizeController(how.controller, step_ts=times),
        max_steps=200_000,
    ).ys
    return jax.vmap(lambda t, y: pair.contact_at(t, y).total)(times, states)


@eqx.filter_jit
def pair_of(evaluator, design):
    return evaluator.pair(design)


# The orbit


@pytest.fixture(scope="module")
def sharp():
    """Evaluator at the reference settings; its program serves every test that needs it."""
    return Evaluator(config_of(*SHARP))


@pytest.fixture(scope="module")
def orbits(sharp):
    """Sharp evaluations of both designs, and of a scene whose orbit forgets slowly."""
    found = {name: (sharp, sharp(jnp.array(design))) for name, design in DESIGNS.items()}
    slow = Evaluator(config_of(*SHARP, *gear(damping=0.02, load=2.0)))
    return found | {"slow": (slow, slow())}


every_orbit = pytest.mark.parametrize("name", [*DESIGNS, "slow"])


def pair_and_state(orbits, name):
    evaluator, evaluation = orbits[name]
    design = jnp.array(list(evaluation.design.values()))
    return pair_of(evaluator.model, design), jnp.asarray(evaluation.state)


@every_orbit
def test_orbit_is_closed_and_stays_closed(orbits, name):
    """PERIODIC with a tiny Newton residual, and 50 more periods of plain motion stay on it."""
    _, evaluation = orbits[name]
    assert evaluation.status is Status.PERIODIC
    assert evaluation.usable
    assert evaluation.steady_state["kind"] == "periodic"
    assert evaluation.steady_state["period"] == 1
    assert evaluation.steady_state["residual"] < 1e-9
    pair, state = pair_and_state(orbits, name)
    states = run_strobe(pair, state[None], 50, integrator(1e-11))[0]
    # Solver noise of 1e-9 a period, summed over the memory of the orbit, 1/(1 - 0.83).
    assert np.max(np.abs(states - state)) < 1e-7


@every_orbit
def test_floquet_multiplier_is_the_decay_of_a_perturbation(orbits, name):
    """States set beside the orbit come back as the monodromy matrix says."""
    pair, state = pair_and_state(orbits, name)
    _, evaluation = orbits[name]
    size = 1e-4
    starts = state + size * jnp.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    ends = np.asarray(run_strobe(pair, starts, 6, integrator(1e-12)))
    spread = np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=-1) / (2 * size)
    after_one, after_six = spread[0], spread[5]
    multiplier = evaluation.steady_state["floquet_multiplier"]
    # 1e-9 of noise over 1e-4, and the square of the perturbation.
    rate = np.max(np.abs(np.linalg.eigvals(after_one)))
    assert rate == pytest.approx(multiplier, rel=1e-3, abs=1e-6)
    assert float(floquet(jnp.asarray(after_one)).max()) == pytest.approx(rate, rel=1e-9)
    if multiplier > 0.1:
        later = np.max(np.abs(np.linalg.eigvals(after_six))) ** (1 / 6)
        assert later == pytest.approx(multiplier, rel=1e-3)


@every_orbit
def test_mean_and_rms_are_those_of_a_fine_sampling(orbits, name):
    """Quadrature carried along with the motion equals the average of the sampled force."""
    _, evaluation = orbits[name]
    force = evaluation.series.force
    mean, _, rms = numbers(evaluation)
    # The force has corners: its 2520 samples average to second order only.
    assert np.mean(force) == pytest.approx(mean, rel=2e-5)
    assert np.sqrt(np.mean(force**2)) == pytest.approx(rms, rel=2e-5)
    pair, state = pair_and_state(orbits, name)
    times = jnp.arange(1, 20_161) / 20_160
    fine = np.asarray(force_at(pair, state, times, integrator(1e-9)))
    assert np.mean(fine) == pytest.approx(mean, rel=1e-6)
    assert np.sqrt(np.mean(fine**2)) == pytest.approx(rms, rel=1e-6)


@every_orbit
def test_peak_is_the_greatest_force(orbits, name):
    """No sample exceeds the peak, and a brute-force search around it finds no other value."""
    _, evaluation = orbits[name]
    series, peak = evaluation.series, evaluation.response["peak_force_N"]
    assert np.max(series.force) <= peak * (1 + 1e-9)
    pair, state = pair_and_state(orbits, name)
    samples = len(series.force) // 3
    best = int(np.argmax(series.force[:samples]))
    times = (best + np.linspace(-1, 1, 801)) / samples
    around = force_at(pair, state, jnp.asarray(times), integrator(1e-12))
    assert float(np.max(around)) == pytest.approx(peak, rel=1e-6)


def test_series_is_the_motion_over_one_revolution(orbits):
    """Uniform times over a revolution, repeating with the mesh; forces where flanks overlap."""
    evaluator, evaluation = orbits["paper"]
    series = evaluation.series
    count = len(series.time)
    np.testing.assert_allclose(series.time, 0.02 * np.arange(count) / count, rtol=1e-12)
    np.testing.assert_allclose(series.rotation, 2 * np.pi * np.arange(count) / count, rtol=1e-12)
    third = count // 3
    for part in (series.relative, series.rate):
        np.testing.assert_array_equal(part[:third], part[third : 2 * third])
    # The rate is the slope of the angle: central differences over 2.6 µs.
    slope = np.gradient(series.relative, series.time)[1:-1]
    assert np.max(np.abs(slope - series.rate[1:-1])) < 1e-2 * np.ptp(series.rate)
    assert not np.any(series.force[series.depth <= 0])
    assert np.all(series.drive_force * series.coast_force == 0)
    assert evaluator.config.scene.speed_rpm == 3000


# Gradients


def central(evaluator, design, key, step):
    """Central difference of the three responses in one design parameter."""
    ends = []
    for sign in (1, -1):
        moved = np.array(design)
        moved[key] += sign * step
        evaluation = evaluator(jnp.array(moved), series=False)
        assert evaluation.status is Status.PERIODIC
        ends.append(numbers(evaluation))
    return (ends[0] - ends[1]) / (2 * step)


def test_finite_differences_approach_the_gradient_with_the_square_of_the_step(sharp, orbits):
    """The error of a central difference falls fourfold per halving: the gradient is the limit."""
    design = DESIGNS["shorter involute"]
    exact = gradients(orbits["shorter involute"][1])[:, 1]
    steps = 0.08, 0.04, 0.02
    errors = np.array([central(sharp, design, 1, step)[0] - exact[0] for step in steps])
    ratio = errors[:-1] / errors[1:]
    assert np.all((ratio > 3) & (ratio < 6))
    # Extrapolated to 0.01, half of what the next test allows.
    assert abs(errors[-1]) / 4 < 5e-5 * abs(exact[0])


@pytest.mark.parametrize("name", DESIGNS)
def test_gradient_is_that_of_finite_differences(sharp, orbits, name):
    """d mean, peak, RMS by each design parameter match central differences to 1e-4.

    Step 0.01 (degree, mm): between the h² error seen above and the noise of the orbit,
    1e-10 of the response, over h. Where AD is taken at looser settings its own error is
    the larger one: the adaptive steps control the motion's error, not its derivative's.
    """
    exact = gradients(orbits[name][1])
    found = np.stack([central(sharp, DESIGNS[name], key, 0.01) for key in range(3)], axis=1)
    np.testing.assert_allclose(exact, found, rtol=1e-4)


def test_forward_and_reverse_gradients_agree(settled):
    """At the default settings both modes give one gradient to 1e-8."""
    for design in DESIGNS.values():
        pair = [
            gradients(Evaluator(config_of(f"solver.gradient={mode}"))(jnp.array(design)))
            for mode in ("forward", "reverse")
        ]
        np.testing.assert_allclose(pair[0], pair[1], rtol=1e-8)
    assert settled["periodic"].gradient


class FixedSteps(Integrator):
    """A thousand equal steps a mesh period."""

    @property
    def controller(self):
        return diffrax.ConstantStepSize()


def test_both_modes_differentiate_the_same_motion(sharp, orbits):
    """On one sequence of steps w·(J v) is (w·J) v to rounding, search contact included.

    On adaptive steps the two programs may round differently, take other steps, and then
    differ by the error of the derivative itself (1e-3 at rtol 1e-8, 1e-5 at 1e-12).
    """
    state = jnp.asarray(orbits["paper"][1].state)
    how = FixedSteps("tsit5", jnp.asarray(1e-8), 2048)

    def outcome(adjoint):
        def run(state, design):
            out = flow(sharp.model.pair(design), state, jnp.asarray(1.0), how, 64, adjoint)
            return jnp.concatenate([out.end, jnp.stack([out.mean, out.mean_square, out.peak])])

        return run

    at = state, jnp.array(DESIGNS["paper"])

    @jax.jit
    def forward(tangent):
        return jax.jvp(outcome(diffrax.ForwardMode()), at, tangent)

    @jax.jit
    def reverse(weight):
        value, pull = jax.vjp(outcome(diffrax.RecursiveCheckpointAdjoint()), *at)
        return value, pull(weight)

    rng = np.random.default_rng(5)
    for weight in np.eye(5):
        tangent = tuple(jnp.asarray(rng.normal(size=n)) for n in (2, 3))
        value, moved = forward(tangent)
        same, pulled = reverse(jnp.asarray(weight))
        np.testing.assert_allclose(value, same, rtol=1e-12)
        terms = np.concatenate([np.asarray(p) * t for p, t in zip(pulled, tangent, strict=True)])
        assert np.max(np.abs(terms)) > 0
        assert weight @ moved == pytest.approx(np.sum(terms), abs=1e-8 * np.sum(np.abs(terms)))


# Statuses


SCENES = {
    "periodic": config_of(),
    "epicycloid": config_of(path="configs/ee.yaml"),
    "chaotic": config_of(*gear(backlash=0.2, damping=0.0, load=1.0)),
    "impatient": config_of(
        *gear(backlash=0.05, damping=0.05, load=1.0), "solver.max_mesh_periods=16"
    ),
    "no gear": config_of("scene.timing_gear=null", "scene.load.torque_N_m=30"),
    "few steps": config_of("solver.max_steps_per_period=64"),
    "soft": config_of(*gear(backlash=2.0, load=300.0), "contact.stiffness_N_per_mm_e=200"),
}
OUTCOMES = {
    "periodic": {Status.PERIODIC},
    "epicycloid": {Status.PERIODIC},
    "chaotic": {Status.CHAOTIC},
    "impatient": {Status.NOT_SETTLED},
    "no gear": {Status.PASSED_THROUGH},
    "few steps": {Status.SOLVER_FAILED},
    "soft": {Status.TOO_DEEP},
}


@pytest.fixture(scope="module")
def settled():
    """Evaluation of every scene at the default settings."""
    return {name: evaluate(config) for name, config in SCENES.items()}


@pytest.mark.parametrize("name", SCENES)
def test_status_names_the_outcome(settled, name):
    """Each scene ends with the status that is true of it."""
    evaluation = settled[name]
    assert evaluation.status in OUTCOMES[name]
    assert evaluation.message == evaluation.status.value
    assert evaluation.usable == (evaluation.status is Status.PERIODIC)


@pytest.mark.parametrize("name", SCENES)
def test_no_number_without_its_status(settled, name):
    """Responses, gradient and series are there exactly where the status stands for them."""
    evaluation = settled[name]
    status, steady = evaluation.status, evaluation.steady_state
    described = status in (Status.PERIODIC, Status.TOO_DEEP, Status.CHAOTIC, Status.NOT_SETTLED)
    assert set(evaluation.response) == (set(RESPONSES) if described else set())
    assert (evaluation.series is not None) == described
    differentiable = status is Status.PERIODIC and bool(evaluation.design)
    assert set(evaluation.gradient) == (set(RESPONSES) if differentiable else set())
    for row in evaluation.gradient.values():
        assert set(row) == set(DESIGN_KEYS)
    kinds = {Status.PERIODIC: "periodic", Status.TOO_DEEP: "periodic", Status.CHAOTIC: "chaotic"}
    assert steady["kind"] == kinds.get(status, "transient")
    # Strict JSON knows no NaN and no infinity.
    record = json.loads(json.dumps(evaluation.record(), allow_nan=False))
    assert record["status"] == status.label
    if described:
        mean, peak, rms = numbers(evaluation)
        assert 0 < mean <= rms <= peak


def test_status_does_not_depend_on_the_series():
    """Asking for no series does not turn a motion that is too deep into a usable one."""
    assert Evaluator(SCENES["soft"])(series=False).status is Status.TOO_DEEP


def test_chaos_has_a_positive_exponent_and_no_gradient(settled):
    """A chaotic scene says so, with an exponent that is beyond its own error."""
    evaluation = settled["chaotic"]
    steady = evaluation.steady_state
    exponent = steady["lyapunov_exponent_per_mesh_period"]
    assert exponent > 3 * steady["lyapunov_standard_error"] > 0
    assert evaluation.gradient == {}
    assert not evaluation.usable
    # Two motions 1e-9 apart part company at about that rate, from 1e-9 to 1e-2.
    evaluator = Evaluator(SCENES["chaotic"])
    pair = pair_of(evaluator.model, jnp.array(list(evaluation.design.values())))
    scale, rate = float(pair.angle_scale), float(pair.angle_scale) / float(pair.mesh_period)
    start = jnp.array([evaluation.series.relative[0] / scale, evaluation.series.rate[0] / rate])
    starts = start + 1e-9 * jnp.array([[0.0, 0.0], [1.0, 0.0]])
    ends = np.asarray(run_strobe(pair, starts, 60, integrator(1e-12)))
    apart = np.linalg.norm(ends[0] - ends[1], axis=1)
    assert np.max(apart) > 1e-2


def test_more_time_settles_an_impatient_scene():
    """What 16 mesh periods leave unsettled is periodic when given the default time."""
    patient = evaluate(config_of(*gear(backlash=0.05, damping=0.05, load=1.0)))
    assert patient.status is Status.PERIODIC
    assert patient.statistics["transient_mesh_periods"] > 16


def test_epicycloid_has_responses_and_nothing_to_differentiate(settled):
    """EE is evaluated like any other family, with an empty design and gradient."""
    evaluation = settled["epicycloid"]
    assert evaluation.design == {}
    assert evaluation.gradient == {}
    assert set(evaluation.response) == set(RESPONSES)


def test_a_found_orbit_is_a_start_that_changes_nothing(sharp, orbits):
    """Begun on the orbit of the design, the evaluation finds the same numbers again."""
    _, evaluation = orbits["paper"]
    again = sharp(jnp.array(DESIGNS["paper"]), start=evaluation.state)
    np.testing.assert_allclose(numbers(again), numbers(evaluation), rtol=1e-9)
