"""`Response.start`: an orbit that travels through pure functions to similar designs and scenes."""

import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rootsopt
from rootsopt import Scene, Status, steady_response

CONFIG = rootsopt.load_config("configs/cic.yaml")
DESIGN = np.asarray(CONFIG.design, float)
NEAR = DESIGN * np.array([1.002, 0.999, 1.001])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_config(CONFIG)


@pytest.fixture(scope="module")
def respond(scene):
    """Return the compiled function of (scene, design, start): derivatives and response."""

    def forces(design, scene, start):
        found = steady_response(scene, design, start)
        return jnp.stack([found.mean, found.rms, found.peak]), found

    return eqx.filter_jit(
        lambda scene, design, start: jax.jacfwd(forces, has_aux=True)(design, scene, start)
    )


@pytest.fixture(scope="module")
def first(scene, respond):
    """Return the response from rest, by the program that takes a start."""
    start = steady_response(scene, DESIGN).start
    rest = eqx.tree_at(lambda s: s.known.sound, start, jnp.zeros((), bool))
    return respond(scene, DESIGN, rest)[1]


def same(one, other, forces=1e-8, slopes=1e-6):
    (by_one, found), (by_other, usual) = one, other
    assert Status.of(found.status) is Status.of(usual.status) is Status.PERIODIC
    for name in ("mean", "rms", "peak"):
        np.testing.assert_allclose(getattr(found, name), getattr(usual, name), rtol=forces)
    np.testing.assert_allclose(by_one, by_other, rtol=slopes, atol=slopes * np.max(abs(by_other)))


def test_neighbour_gives_the_response_from_rest(scene, respond, first):
    usual = respond(scene, NEAR, unused(first.start))
    found = respond(scene, NEAR, first.start)
    same(found, usual)
    assert bool(found[1].start.known.sound)
    # Without a transient, the states come from the orbit of the neighbour.
    np.testing.assert_allclose(found[1].state, usual[1].state, rtol=1e-6)


def unused(start):
    """Return a start at rest, without an orbit, in the form of `start`."""
    at_rest = eqx.tree_at(lambda s: s.state, start, jnp.zeros_like(start.state))
    return eqx.tree_at(lambda s: s.known.sound, at_rest, jnp.zeros((), bool))


@pytest.mark.parametrize("damage", ["other speed", "noise", "not a number", "another orbit"])
def test_start_of_no_use_does_not_change_the_response(scene, respond, first, damage):
    """An orbit that does not lead to one of the pair is refused, and the search begins at rest."""
    start, usual = first.start, respond(scene, NEAR, unused(first.start))
    slopes = start.known.elements.slopes
    if damage == "other speed":
        slow = eqx.tree_at(lambda s: s.speed, scene, 0.3 * scene.speed)
        start = respond(slow, DESIGN, unused(first.start))[1].start
    elif damage == "another orbit":
        start = eqx.tree_at(lambda s: s.known.elements.slopes, start, jnp.zeros_like(slopes))
    else:
        value = {"noise": 30.0, "not a number": jnp.nan}[damage]
        start = eqx.tree_at(lambda s: s.known.elements.slopes, start, slopes + value)
    start = eqx.tree_at(lambda s: s.state, start, jnp.zeros_like(start.state))
    same(respond(scene, NEAR, start), usual)


def test_start_survives_a_file(scene, respond, first):
    """A start that was stored gives the same bits."""
    again = pickle.loads(pickle.dumps(jax.device_get(first.start)))
    one, other = (respond(scene, NEAR, start) for start in (first.start, again))
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(x, y)


def test_start_travels_through_scan(scene, first):
    """A sweep of the speed in one program, each point from the orbit before, as from rest."""
    speeds = scene.speed * jnp.linspace(1.0, 1.02, 4)

    def step(start, speed):
        moved = eqx.tree_at(lambda s: s.speed, scene, speed)
        found = steady_response(moved, DESIGN, start)
        return found.start, found

    _, found = jax.jit(lambda start: jax.lax.scan(step, start, speeds))(first.start)
    assert np.all(np.asarray(found.status) == Status.PERIODIC.code)
    last = eqx.tree_at(lambda s: s.speed, scene, speeds[-1])
    alone = steady_response(last, DESIGN)
    assert float(found.mean[-1]) == pytest.approx(float(alone.mean), rel=1e-8)
    assert float(found.mean[0]) == pytest.approx(float(first.mean), rel=1e-8)


def test_start_of_another_kind_is_refused(scene, first):
    other = rootsopt.load_config("configs/ee.yaml")
    with pytest.raises(ValueError, match="same kind of scene"):
        steady_response(Scene.from_config(other), other.design, first.start)
    with pytest.raises(ValueError, match=r"state \(2,\) of this scene"):
        steady_response(scene, DESIGN, np.zeros(3))
