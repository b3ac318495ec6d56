"""Tests of the Gauss rule, elements and meshes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rootsopt.dynamics.collocation.elements import GAUSS, POINTS, Elements, Mesh, zero_of
from rootsopt.dynamics.collocation.mesh import aligned, counted, moved, needed, ordered

ROOM = 32
EVENT = 0.3071


def _elements(function, slope, edges, start=0.0):
    """Return elements on fixed edges whose motion is a known function."""
    edges = np.asarray(edges)
    count = len(edges) - 1
    pad = ROOM - count
    share = (edges - edges[0]) / (edges[-1] - edges[0])
    mesh = Mesh(
        times=jnp.full(8, edges[-1]).at[0].set(start),
        which=jnp.full(8, -1),
        interval=jnp.asarray([0] * count + [6] * pad),
        left=jnp.asarray([*share[:-1], *np.ones(pad)]),
        right=jnp.asarray([*share[1:], *np.ones(pad)]),
        used=jnp.asarray(count),
    )
    begin, _ = mesh.ends
    inside = begin[:, None] + mesh.lengths[:, None] * GAUSS.nodes
    roots = jnp.zeros((ROOM, POINTS + 1, 1, 2))
    return Elements(mesh, function(begin)[:, None], slope(inside)[..., None], roots)


def _wave(edges):
    turn = 2 * jnp.pi
    return _elements(lambda t: jnp.sin(turn * t), lambda t: turn * jnp.cos(turn * t), edges)


def test_rule_integrates_polynomials():
    """Slopes of degree 3 give the quartic exactly; the weights are exact up to degree 7."""
    for degree in range(POINTS):
        slopes = GAUSS.nodes**degree
        shares = jnp.linspace(0, 1, 7)
        found = GAUSS.integrated(shares) @ slopes
        np.testing.assert_allclose(found, shares ** (degree + 1) / (degree + 1), atol=1e-14)
        np.testing.assert_allclose(GAUSS.lagrange(shares) @ slopes, shares**degree, atol=1e-13)
    for degree in range(2 * POINTS):
        np.testing.assert_allclose(GAUSS.weights @ GAUSS.nodes**degree, 1 / (degree + 1))


def test_motion_is_that_of_the_polynomials():
    elements = _wave(np.linspace(0, 1, 13))
    for tau in (0.0, 0.111, 0.5, 0.99, 1.3):
        expected = np.sin(2 * np.pi * tau)
        np.testing.assert_allclose(elements.motion(jnp.asarray(tau)), expected, atol=1e-6)


def test_motion_moves_to_another_mesh():
    """Elements aligned with events begin at the events, start away from them, and keep the
    motion."""
    elements = _wave(np.linspace(0, 1, 17))
    events = jnp.full(8, jnp.inf).at[:3].set(jnp.asarray([0.1, 0.1004, 0.62]))
    which = jnp.full(8, -1).at[:3].set(jnp.asarray([4, 5, 6]))
    new = jax.jit(lambda x: aligned(x, (events, which), counted(x), jnp.asarray(20)))(elements)
    begin, end = (np.asarray(x)[:20] for x in new.mesh.ends)
    assert int(new.mesh.used) == 20
    np.testing.assert_allclose(begin[1:], end[:-1], atol=1e-15)
    np.testing.assert_allclose(end[-1] - begin[0], 1)
    places = np.mod(begin, 1)
    for event in (0.1, 0.1004, 0.62, 0.0):
        assert np.min(np.abs(places - event)) < 1e-12
    assert np.min(np.abs(np.mod(begin[0] - np.array([0.1, 0.62, 1.0]), 1.0))) > 0.1
    assert set(np.asarray(new.mesh.which).tolist()) == {-1, 4, 5, 6}
    tau = np.random.default_rng(0).uniform(0, 1, 20)
    found = jax.jit(jax.vmap(new.motion))(tau)[:, 0]
    np.testing.assert_allclose(found, np.sin(2 * np.pi * tau), atol=2e-6)
    back = jax.jit(moved)(new, elements.mesh)
    np.testing.assert_allclose(back.state[:16], elements.state[:16], atol=2e-6)


def _times(times, which):
    mesh = _wave(np.linspace(0, 1, 5)).mesh
    count = mesh.times.shape[0] - len(times)
    times = jnp.asarray([*times, *[times[-1]] * count])
    return mesh._replace(times=times, which=jnp.asarray([*which, *[-1] * count]))


@given(st.lists(st.floats(0, 1), min_size=1, max_size=6))
def test_order_of_events_is_mended(events):
    times = _times([0.0, *events, 1.0], [-1, *[2] * len(events), -1])
    mesh, rising = ordered(times)
    assert np.all(np.diff(mesh.times) >= 0)
    assert bool(rising) == (sorted(events) == events)
    if rising:
        np.testing.assert_array_equal(mesh.times, times.times)


def test_elements_of_the_right_length_have_equal_errors():
    """A motion exp(10 t) on elements of equal length has errors that differ by 4 decades.

    On elements that share the density evenly, all errors are alike: they are proportional to the
    fifth power of the length and to the fifth derivative (de Boor and Swartz)."""

    def motion_on(edges):
        return _elements(lambda t: jnp.exp(10 * t), lambda t: 10 * jnp.exp(10 * t), edges)

    def errors(elements):
        begin, end = (np.asarray(x)[:24] for x in elements.mesh.ends)
        inside = begin + np.linspace(0.05, 0.95, 19)[:, None] * (end - begin)
        found = jax.vmap(elements.motion)(jnp.asarray(inside.ravel()))
        off = np.abs(np.ravel(found) - np.exp(10 * inside.ravel()))
        return np.max(off.reshape(inside.shape), axis=0)

    even = motion_on(np.linspace(0, 1, 25))
    place, wanted = map(np.asarray, needed(even))
    fair = motion_on(np.interp(np.linspace(0, wanted[-1], 25), wanted[:25], place[:25]))
    before, after = errors(even), errors(fair)
    assert np.ptp(np.log(before)) > 8
    assert np.max(after) < np.max(before) / 20
    assert np.max(after) < 1.5 * np.min(after)


@pytest.mark.parametrize(
    ("margin", "most"),
    [
        (lambda tau: jnp.sin(tau - EVENT), 12),
        (lambda tau: jnp.exp(50 * tau) - jnp.exp(50 * EVENT), 12),
        (lambda tau: jnp.where(tau > EVENT, -1.0, 1.0), 30),
        (lambda tau: 1e3 * (EVENT - tau) ** 3, 30),
    ],
)
def test_event_is_located(margin, most):
    """A smooth margin takes about ten evaluations, one that jumps no more than bisection."""
    places = []

    def seen(tau):
        places.append(float(tau))
        return margin(tau), tau

    low, high = jnp.asarray(0.3), jnp.asarray(0.32)
    with jax.disable_jit():
        found, before, after = zero_of(seen, low, high, margin(low) > 0)
    assert abs(float(found) - EVENT) < 4e-10
    assert before <= found <= after
    assert after - before < 7e-10
    assert len(places) <= most
    assert min(places) >= 0.3
    assert max(places) <= 0.32
