"""`Response.start`: an orbit that travels through pure functions to similar designs and scenes.

One program, `respond`, serves most tests: it maps a sweep over designs, scenes and starts."""

import pickle
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rootsopt
from rootsopt import Scene, Status, steady_response
from rootsopt.dynamics.window import integrated_difference
from rootsopt.response.evaluation import Evaluator

CONFIG = rootsopt.load_config("configs/cic_drawn.yaml")
DESIGN = np.asarray(CONFIG.design, float)
NEAR = DESIGN * np.array([1.002, 0.999, 1.001])
SPEEDS = np.array([1.0, 1.01, 1.02])
# Factors of speed and load.
ALONE = np.ones(2)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_config(CONFIG)


@pytest.fixture(scope="module")
def respond(scene):
    """Return the function (six cases by name) → derivatives and responses at three speeds, each
    from the orbit of the one before, by name.

    A case is (design, factors of speed and load, start)."""

    def forces(design, scene, start):
        found = steady_response(scene, design, start)
        return jnp.stack([found.mean, found.rms, found.peak]), found

    def sweep(scene, design, factors, start):
        def step(start, factor):
            speed, load = factors * jnp.stack([factor * scene.speed, scene.load_torque])
            moved = eqx.tree_at(lambda s: (s.speed, s.load_torque), scene, (speed, load))
            found = jax.jacrev(forces, has_aux=True)(design, moved, start)
            return found[1].start, found

        return jax.lax.scan(step, start, SPEEDS)[1]

    program = jax.jit(jax.vmap(sweep, (None, 0, 0, 0)))

    def by_name(cases):
        # As arrays of NumPy, all starts have the same types, so that JAX compiles once.
        arrays = (
            jax.tree.map(lambda *x: np.stack(x), *part)
            for part in zip(*cases.values(), strict=True)
        )
        found = jax.device_get(program(scene, *arrays))
        return {name: jax.tree.map(lambda x, k=k: x[k], found) for k, name in enumerate(cases)}

    return by_name


def at_first(found):
    return jax.tree.map(lambda x: x[0], found)


def at_rest(start):
    return eqx.tree_at(lambda s: s.state, start, np.zeros(2))


@pytest.fixture(scope="module")
def from_rest(scene, respond):
    """Return derivatives and responses from rest, by the program that takes a start."""
    start = at_rest(steady_response(scene, DESIGN, np.zeros(2)).start)
    start = eqx.tree_at(lambda s: s.known.sound, start, np.zeros((), bool))
    cases = {
        "own": (DESIGN, ALONE),
        "near": (NEAR, ALONE),
        "slow": (DESIGN, np.array([0.3, 1.0])),
        "overloaded": (DESIGN, np.array([1.0, 3000.0])),
        "undercut": (np.array([20.0, 9.0, 4.0]), ALONE),
        "limits": (np.array([36.43, 9.2, 4.0]), ALONE),
    }
    return respond({name: (*case, start) for name, case in cases.items()})


@pytest.fixture(scope="module")
def start(from_rest):
    """Return the start of the own design, which comes from a file."""
    return pickle.loads(pickle.dumps(at_first(from_rest["own"][1].start)))


@pytest.fixture(scope="module")
def from_neighbour(respond, from_rest, start):
    """Return derivatives and responses that begin on a neighbour's orbit, or on one that does not
    help: damaged, or of another speed."""
    slopes = start.known.elements.slopes
    damaged = {
        "noise": slopes + 30.0,
        "not a number": np.full_like(slopes, np.nan),
        "another orbit": np.zeros_like(slopes),
    }
    starts = {
        name: eqx.tree_at(lambda s: s.known.elements.slopes, start, one)
        for name, one in damaged.items()
    }
    starts["other speed"] = at_first(from_rest["slow"][1].start)
    cases = {name: (NEAR, ALONE, at_rest(one)) for name, one in starts.items()}
    cases["near"] = NEAR, ALONE, start
    cases["turning"] = np.array([np.nan, 9.0, 4.0]), ALONE, start
    return respond(cases)


def same(one, other, forces=1e-8, slopes=1e-6):
    (by_one, found), (by_other, usual) = one, other
    assert {*found.status.tolist(), *usual.status.tolist()} == {Status.PERIODIC.code}
    for name in ("mean", "rms", "peak"):
        np.testing.assert_allclose(getattr(found, name), getattr(usual, name), rtol=forces)
    np.testing.assert_allclose(by_one, by_other, rtol=slopes, atol=slopes * np.max(abs(by_other)))


def test_neighbour_gives_the_response_from_rest(scene, from_rest, from_neighbour):
    usual, found = from_rest["near"], from_neighbour["near"]
    same(found, usual)
    assert np.all(found[1].start.known.sound)
    # Without a transient, the states come from the orbit of the neighbour.
    np.testing.assert_allclose(found[1].state, usual[1].state, rtol=1e-6)
    # Each point of the sweep begins on the orbit before, and is that from rest.
    for factor, *forces in zip(SPEEDS, found[1].mean, found[1].peak, strict=True):
        moved = eqx.tree_at(lambda s: s.speed, scene, factor * scene.speed)
        alone = steady_response(moved, NEAR, np.zeros(2))
        np.testing.assert_allclose(forces, [alone.mean, alone.peak], rtol=1e-8)


@pytest.mark.parametrize("damage", ["other speed", "noise", "not a number", "another orbit"])
def test_start_of_no_use_does_not_change_the_response(from_rest, from_neighbour, damage):
    """An orbit that does not lead to one of the pair is refused, and the search begins at rest."""
    same(from_neighbour[damage], from_rest["near"])


def test_batch_is_computed_as_single_motions(scene, from_rest, from_neighbour):
    """`jit(vmap(jacrev))` works over scenes and designs. Some of them have no forces.

    These are a scene whose lobes pass through each other, and designs that are not sound. Their
    forces and gradients are NaN, and do not change those of the others. The margins say which check
    a design fails."""
    slopes, found = at_first(from_rest["own"])
    alone = steady_response(scene, DESIGN, np.zeros(2))
    forces = [[one.mean, one.rms, one.peak] for one in (found, alone)]
    np.testing.assert_allclose(*forces, rtol=1e-9)
    gradient = Evaluator.of(CONFIG)(series=False).gradient
    names = "mean_force_N", "rms_force_N", "peak_force_N"
    expected = np.array([[*gradient[name].values()] for name in names])
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-6 * size)
    assert found.margins.failed == ""
    for name in ("overloaded", "undercut", "limits", "turning"):
        slopes, found = at_first((from_rest | from_neighbour)[name])
        passed = name == "overloaded"
        assert Status.of(found.status) is (Status.PASSED_THROUGH if passed else Status.UNSOUND)
        assert found.margins.failed == ("" if passed else name)
        assert np.all(np.isnan([*slopes.ravel(), found.mean, found.rms, found.peak]))
        assert passed or np.all(np.isnan(found.state))


def test_start_survives_a_file(from_rest, start):
    jax.tree.map(np.testing.assert_array_equal, start, at_first(from_rest["own"][1].start))


def test_start_of_another_kind_is_refused(scene, start):
    other = rootsopt.load_config("configs/ee.yaml")
    for arguments, words in (
        ((Scene.from_config(other), other.design, start), "same kind of scene"),
        ((scene, DESIGN, np.zeros(3)), r"state \(2,\) of this scene"),
    ):
        with pytest.raises(ValueError, match=words):
            steady_response(*arguments)


@pytest.mark.long
def test_orbit_that_is_not_closed_is_said_to_be(scene, monkeypatch):
    """Its forces are those of a window of the motion, and its gradient is not a number."""
    monkeypatch.setattr("rootsopt.dynamics.closed.corrected", jnp.zeros_like)
    # With a window of 16 mesh periods, which says that the motion is not chaotic.
    monkeypatch.setattr("rootsopt.dynamics.closed.PERIODS", 16)

    def mean(design):
        found = steady_response(scene, design)
        return found.mean, found

    (_, found), slope = jax.jit(jax.value_and_grad(mean, has_aux=True))(DESIGN)
    assert Status.of(found.status) is Status.NOT_CLOSED
    assert np.all(np.isnan(slope))
    assert not bool(found.start.known.sound)
    usual = steady_response(scene, DESIGN)
    assert found.mean == pytest.approx(float(usual.mean), rel=1e-4)
    assert found.peak == pytest.approx(float(usual.peak), rel=1e-3)
    # The window has a program of its own.
    program = mock.Mock(return_value=(found, slope))
    monkeypatch.setattr("rootsopt.response.steady._compiled", program)
    assert Status.of(steady_response(scene, DESIGN).status) is Status.NOT_CLOSED
    assert [call.args[-1] for call in program.call_args_list] == [False, True]


def test_reported_orbit_is_integrated(scene, monkeypatch):
    """An orbit that an integration over its period contradicts is no result."""
    evaluator = Evaluator.of(CONFIG)
    usual = evaluator()
    pair, how = evaluator.pair(DESIGN), scene.solver.orbit
    forces = jnp.asarray([usual.response["mean_force_N"], usual.response["rms_force_N"] ** 2])
    state, apart = jnp.asarray(usual.state), eqx.filter_jit(integrated_difference)
    for moved, scaled, low, high in ((1, 1, 0, 1e-5), (1, 1.001, 4e-4, 1), (1.01, 1, 1e-4, 1)):
        assert low < apart(pair, (state * moved, forces * scaled), jnp.asarray(1), how) < high
    monkeypatch.setattr("rootsopt.response.evaluation._APART", (0.0, 0.0))
    again = evaluator()
    assert (again.status, again.gradient) == (Status.NOT_CLOSED, {})
    assert again.response["peak_force_N"] == pytest.approx(usual.response["peak_force_N"], rel=1e-3)
    # Without a series, nothing is integrated.
    assert evaluator(series=False).status is Status.PERIODIC
    # An orbit near a known one is searched for again from its state.
    integrated = mock.Mock(side_effect=[1.0, 0.0])
    monkeypatch.setattr("rootsopt.response.evaluation._integrated", integrated)
    monkeypatch.setattr("rootsopt.response.evaluation._APART", (1e-4, 0.0))
    again = evaluator(start=usual.start)
    assert (again.status, integrated.call_count) == (Status.PERIODIC, 2)
    assert "from_neighbour" not in again.statistics
