"""`Response.start`: an orbit that travels through pure functions to similar designs and scenes."""

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


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_config(CONFIG)


@pytest.fixture(scope="module")
def respond():
    """Return the compiled function of (scene, design, start): derivatives and responses at three
    speeds, each from the orbit of the one before."""

    def forces(design, scene, start):
        found = steady_response(scene, design, start)
        return jnp.stack([found.mean, found.rms, found.peak]), found

    @eqx.filter_jit
    def sweep(scene, design, start):
        def step(start, factor):
            moved = eqx.tree_at(lambda s: s.speed, scene, factor * scene.speed)
            found = jax.jacfwd(forces, has_aux=True)(design, moved, start)
            return found[1].start, found

        return jax.lax.scan(step, start, SPEEDS)[1]

    return sweep


@pytest.fixture(scope="module")
def first(scene, respond):
    """Return the response from rest, by the program that takes a start."""
    _, found = respond(scene, DESIGN, unused(steady_response(scene, DESIGN, np.zeros(2)).start))
    return jax.tree.map(lambda x: x[0], found)


def same(one, other, forces=1e-8, slopes=1e-6):
    (by_one, found), (by_other, usual) = one, other
    assert {*found.status.tolist(), *usual.status.tolist()} == {Status.PERIODIC.code}
    for name in ("mean", "rms", "peak"):
        np.testing.assert_allclose(getattr(found, name), getattr(usual, name), rtol=forces)
    np.testing.assert_allclose(by_one, by_other, rtol=slopes, atol=slopes * np.max(abs(by_other)))


def test_neighbour_gives_the_response_from_rest(scene, respond, first):
    usual = respond(scene, NEAR, unused(first.start))
    found = respond(scene, NEAR, first.start)
    same(found, usual)
    assert np.all(found[1].start.known.sound)
    # Without a transient, the states come from the orbit of the neighbour.
    np.testing.assert_allclose(found[1].state, usual[1].state, rtol=1e-6)
    # Each point of the sweep begins on the orbit before, and is that from rest.
    for factor, *forces in zip(SPEEDS, found[1].mean, found[1].peak, strict=True):
        moved = eqx.tree_at(lambda s: s.speed, scene, factor * scene.speed)
        alone = steady_response(moved, NEAR, np.zeros(2))
        np.testing.assert_allclose(forces, [alone.mean, alone.peak], rtol=1e-8)


def unused(start):
    """Return a start at rest, without an orbit, in the form of `start`."""
    at_rest = eqx.tree_at(lambda s: s.state, start, jnp.zeros_like(start.state))
    return eqx.tree_at(lambda s: s.known.sound, at_rest, jnp.zeros((), bool))


@pytest.mark.parametrize("damage", ["other speed", "noise", "not a number", "another orbit"])
def test_start_of_no_use_does_not_change_the_response(scene, respond, first, damage):
    """An orbit that does not lead to one of the pair is refused, and the search begins at rest."""
    start, usual = first.start, respond(scene, NEAR, unused(first.start))
    if damage == "other speed":
        slow = eqx.tree_at(lambda s: s.speed, scene, 0.3 * scene.speed)
        slower = respond(slow, DESIGN, unused(first.start))[1].start
        start = jax.tree.map(lambda x: x[0], slower)
    else:
        share, more = {"noise": (1, 30.0), "not a number": (1, jnp.nan), "another orbit": (0, 0)}[
            damage
        ]
        start = eqx.tree_at(
            lambda s: s.known.elements.slopes, start, replace_fn=lambda x: share * x + more
        )
    start = eqx.tree_at(lambda s: s.state, start, jnp.zeros_like(start.state))
    same(respond(scene, NEAR, start), usual)


def test_start_survives_a_file(scene, respond, first):
    again = pickle.loads(pickle.dumps(jax.device_get(first.start)))
    one, other = (respond(scene, NEAR, start) for start in (first.start, again))
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_start_of_another_kind_is_refused(scene, first):
    other = rootsopt.load_config("configs/ee.yaml")
    for arguments, words in (
        ((Scene.from_config(other), other.design, first.start), "same kind of scene"),
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
