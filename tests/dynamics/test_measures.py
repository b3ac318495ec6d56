"""Tests of spectral lines, p-norm, and orbits of more than two states."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rootsopt.config import load
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.linear import spectral_radius
from rootsopt.dynamics.orbit import Shots, close_orbit
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.window import no_tangents
from rootsopt.errors import InputError
from rootsopt.optimize.problem import Problem
from rootsopt.response.evaluation import Evaluator, objective_weights
from rootsopt.response.records import floquet

LIVELY = (
    "scene.speed_rpm=4000",
    "scene.timing_gear.damping_ratio=0.2",
    "scene.timing_gear.backlash_mm=0.2",
)


def evaluated(*overrides):
    return Evaluator.of(load("configs/cic.yaml", list(overrides)))()


@pytest.mark.parametrize("scene", [(), LIVELY])
def test_lines_are_those_of_the_sampled_force(scene):
    """Amplitudes from integrated coefficients agree with those from the transform of 2520
    samples."""
    evaluation = evaluated("response.lines=[1, 2, 7, 0.5, 0.3]", *scene)
    period = evaluation.steady_state["period"]
    assert period == (2 if scene else 1)
    force = evaluation.series.force
    amplitudes = 2 * np.abs(np.fft.rfft(force)) / len(force)
    mesh_periods = len(force) // 2520 * period
    for order in (1, 2, 7, 0.5):
        found = evaluation.response[f"line_{order:g}_force_N"]
        line = order * mesh_periods
        present = abs(order * period - round(order * period)) < 1e-9
        expected = amplitudes[round(line)] if present else 0.0
        # Impacts are narrow: the samples leave 1e-3 of the greatest line.
        assert found == pytest.approx(expected, abs=1e-3 * evaluation.response["line_1_force_N"])
    # No motion of up to eight mesh periods has this line.
    assert evaluation.response["line_0.3_force_N"] == 0
    assert set(evaluation.gradient["line_0.3_force_N"].values()) == {0.0}


def test_p_norm_tends_to_the_peak_as_stated():
    """The p-norm rises to the peak with p, at the rate of Laplace's method for a smooth peak."""
    found = {p: evaluated(f"objective.peak_norm={p}") for p in (8, 16, 32, 64)}
    norms = [one.response["peak_norm_force_N"] for one in found.values()]
    peaks = [one.response["peak_force_N"] for one in found.values()]
    assert np.all(np.diff(norms) > 0)
    assert np.ptp(peaks) < 1e-6 * peaks[0]
    assert norms[-1] < peaks[0]
    # (mean of F^p)^(1/p) of the samples, which know nothing of the quadrature.
    for p, norm in zip(found, norms, strict=True):
        force = found[p].series.force
        assert norm == pytest.approx(np.mean(force**p) ** (1 / p), rel=2e-4)
    # The bias falls about as ln(p)/p: a factor of 8 in p leaves less than a quarter of it.
    bias = 1 - np.array(norms) / peaks
    assert bias[-1] < 0.3 * bias[0]


@pytest.mark.long
def test_what_is_not_asked_for_is_not_computed():
    """Without lines and norm, the program has no integrals for them."""
    plain, more = (
        Evaluator.of(load("configs/cic.yaml", over)) for over in ([], ["response.lines=[1]"])
    )
    assert plain.scene.solver.measures.count == 2
    assert more.scene.solver.measures.count == 4

    def size(evaluator):
        pair = evaluator.scene.pair(jnp.array([36.43, 9.0, 4.0]))
        one, shots = jnp.asarray(1), Shots(how, evaluator.scene.solver.measures)
        jaxpr = jax.make_jaxpr(
            lambda y: close_orbit(pair, no_tangents(pair), y, one, shots).response
        )(jnp.zeros(2))
        return len(str(jaxpr))

    how = Integrator("tsit5", jnp.asarray(1e-6), 256)
    assert size(plain) < size(more)


def test_objective_takes_the_lines_and_the_norm_as_weighted():
    config = load(
        "configs/cic.yaml",
        ["objective.line_weights={1: 1, 2: 2}", "objective.rms_weight=1", "objective.peak_norm=8"],
    )
    weights = objective_weights(config)
    assert sum(weights.values()) == pytest.approx(1)
    assert weights["line_2_force_N"] == pytest.approx(2 / 5)
    assert weights["peak_norm_force_N"] == pytest.approx(0.5 / 5)
    assert "peak_force_N" not in weights
    evaluator = Evaluator.of(config)
    baseline = evaluator(series=False)
    problem = Problem.of(config, evaluator.scene, baseline)
    assert problem.objective(baseline) == pytest.approx(1)
    point = problem.point(list(baseline.design.values())) * 0.99
    here = evaluator(problem.design(point), series=False)
    slope = problem.slope(here, point)
    unit = np.array([1.0, -0.5, 0.5])
    up, down = (
        problem.objective(evaluator(problem.design(point + h * unit), series=False))
        for h in (1e-4, -1e-4)
    )
    assert slope @ unit == pytest.approx((up - down) / 2e-4, rel=1e-3)


def test_a_line_the_baseline_has_not_got_is_refused():
    config = load("configs/cic.yaml", ["objective.line_weights={0.5: 1, 1: 1}"])
    # Of the same kind as in the test before: nothing is compiled for it.
    evaluator = Evaluator.of(
        load("configs/cic.yaml", ["response.lines=[0.5, 1]", "objective.peak_norm=8"])
    )
    with pytest.raises(InputError, match=r"line_weights.*0\.5.*repeats every 1 mesh periods"):
        Problem.of(config, evaluator.scene, evaluator(series=False))


@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_spectral_radius(count, seed):
    """The result agrees with NumPy's eigenvalues, for any number of states."""
    matrix = np.random.default_rng(seed).normal(size=(count, count))
    expected = np.max(np.abs(np.linalg.eigvals(matrix)))
    assert float(spectral_radius(jnp.asarray(matrix))) == pytest.approx(expected, rel=1e-8)
    first = floquet(matrix)[0]
    assert np.hypot(*first) == pytest.approx(expected, rel=1e-9)


def test_spectral_radius_of_a_nilpotent_matrix_is_zero():
    matrix = jnp.zeros((3, 3)).at[0, 1].set(1.0)
    assert float(spectral_radius(matrix)) == 0


class Lagging(RotorPair):
    """A pair with a third state: the load follows the contact torque with a lag of 0.1 mesh
    periods."""

    def derivative(self, tau, state):
        slope, contact = super().derivative(tau, state[:2])
        lag = 10 * (contact.torque2 / 10 - state[2])
        share = state[2] / self.inertia * self.mesh_period**2 / self.angle_scale
        return jnp.stack([slope[0], slope[1] - share, lag]), contact

    def switches(self, tau, state):
        return super().switches(tau, state[:2])

    def contact_at(self, tau, state):
        return super().contact_at(tau, state[:2])


@pytest.mark.long
def test_an_orbit_of_three_states():
    """The orbit closes to 1e-9, and its derivative agrees with differences of orbits."""
    model = Evaluator.of(load("configs/cic.yaml", [])).scene
    how = Integrator("dopri8", jnp.asarray(1e-11), 4096)

    @eqx.filter_jit
    def orbit(load):
        def arrays(load):
            pair = model.pair(jnp.array([36.43, 9.0, 4.0]))
            pair = eqx.tree_at(lambda pair: pair.load.torque, pair, load)
            fields = {f.name: getattr(pair, f.name) for f in dataclasses.fields(pair)}
            return eqx.partition(Lagging(**fields), eqx.is_inexact_array)

        (dynamic, static), tangents = arrays(load), jax.jacfwd(lambda x: arrays(x)[0])(load)
        tangents = jax.tree.map(lambda x: x[None], tangents)
        start = jnp.array([-0.6, -0.4, 0.3])
        return close_orbit(
            eqx.combine(dynamic, static), tangents, start, jnp.asarray(1), Shots(how)
        )

    here = orbit(jnp.asarray(4.775))
    assert float(here.residual) < 1e-9
    assert here.monodromy.shape == (3, 3)
    assert float(here.multiplier) == pytest.approx(np.hypot(*floquet(here.monodromy)[0]), rel=1e-6)
    assert float(here.multiplier) < 1
    step = 1e-3
    up, down = (np.asarray(orbit(jnp.asarray(4.775 + h)).response) for h in (step, -step))
    slope = np.asarray(here.sensitivity)[:, 0]
    assert slope[:2] == pytest.approx((up - down)[:2] / (2 * step), rel=1e-5)
