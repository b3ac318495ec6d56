"""Tests of elements and meshes, and of the condensed linear equations against a dense solution of
the same equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rootsopt.dynamics.collocation.elements import (
    BLOCK,
    GAUSS,
    POINTS,
    Elements,
    Mesh,
    in_blocks,
    zero_of,
)
from rootsopt.dynamics.collocation.mesh import aligned, counted, moved, needed, ordered
from rootsopt.dynamics.collocation.newton import columns_of
from rootsopt.dynamics.collocation.system import Lines, chained, condensed

ROOM = 32
EVENT = 0.3071


def _elements(function, slope, edges):
    """Return elements on fixed edges whose motion is a known function."""
    count = len(edges) - 1
    pad = ROOM - count
    share = (edges - edges[0]) / (edges[-1] - edges[0])
    mesh = Mesh(
        times=jnp.full(8, edges[-1]).at[0].set(0.0),
        which=jnp.full(8, -1),
        interval=jnp.asarray([0] * count + [6] * pad),
        left=jnp.append(share[:-1], jnp.ones(pad)),
        right=jnp.append(share[1:], jnp.ones(pad)),
        used=jnp.asarray(count),
    )
    begin, _ = mesh.ends
    inside = begin[:, None] + mesh.lengths[:, None] * GAUSS.nodes
    roots = jnp.zeros((ROOM, POINTS + 1, 1, 2))
    return Elements(mesh, function(begin)[:, None], slope(inside)[..., None], roots)


def _wave(edges):
    turn = 2 * jnp.pi
    return _elements(lambda t: jnp.sin(turn * t), lambda t: turn * jnp.cos(turn * t), edges)


def test_motion_moves_to_another_mesh():
    """Elements aligned with events begin at the events, start away from them, and keep the
    motion."""
    events = jnp.asarray([0.1, 0.1004, 0.62, *5 * [np.inf]]), jnp.asarray([4, 5, 6, *5 * [-1]])
    tau = np.random.default_rng(0).uniform(0, 1.3, 20)

    @jax.jit
    def moving(edges, tau):
        elements = _wave(edges)
        new = aligned(elements, events, counted(elements), jnp.asarray(20))
        return elements.state, new, new.motion(tau)[:, 0], moved(new, elements.mesh).state

    state, new, found, back = moving(np.linspace(0, 1, 17), tau)
    begin, end = (np.asarray(x)[:20] for x in new.mesh.ends)
    assert int(new.mesh.used) == 20
    np.testing.assert_allclose([*end[:-1], end[-1] - 1], [*begin[1:], begin[0]], atol=1e-15)
    nearest = np.min(np.abs(np.mod(begin, 1)[:, None] - [0.1, 0.1004, 0.62, 0.0]), axis=0)
    np.testing.assert_array_less(nearest, 1e-12)
    assert np.min(np.abs(np.mod(begin[0] - np.array([0.1, 0.62, 1.0]), 1.0))) > 0.1
    assert set(np.asarray(new.mesh.which).tolist()) == {-1, 4, 5, 6}
    np.testing.assert_allclose(found, np.sin(2 * np.pi * tau), atol=2e-6)
    np.testing.assert_allclose(back[:16], state[:16], atol=2e-6)


@given(st.lists(st.floats(0, 1, allow_subnormal=False), min_size=1, max_size=6))
def test_order_of_events_is_mended(events):
    count = len(events)
    times = jnp.asarray([0.0, *events, *(7 - count) * [1.0]])
    which = jnp.asarray([-1, *count * [2], *(7 - count) * [-1]])
    mesh, rising = ordered(_wave(np.linspace(0, 1, 5)).mesh._replace(times=times, which=which))
    assert np.all(np.diff(mesh.times) >= 0)
    assert bool(rising) == (sorted(events) == events)
    if rising:
        np.testing.assert_array_equal(mesh.times, times)


def test_elements_of_the_right_length_have_equal_errors():
    """A motion exp(10 t) on elements of equal length has errors that differ by 4 decades.

    On elements that share the density evenly, all errors are alike: they are proportional to the
    fifth power of the length and to the fifth derivative (de Boor and Swartz)."""

    @jax.jit
    def looked(edges):
        """Return the greatest error in each element, and the density that is needed."""
        elements = _elements(lambda t: jnp.exp(10 * t), lambda t: 10 * jnp.exp(10 * t), edges)
        inside = edges[:-1] + jnp.linspace(0.05, 0.95, 19)[:, None] * jnp.diff(edges)
        found = elements.motion(inside)[..., 0]
        return jnp.max(jnp.abs(found - jnp.exp(10 * inside)), axis=0), needed(elements)

    before, (place, wanted) = jax.device_get(looked(np.linspace(0, 1, 25)))
    after, _ = looked(np.interp(np.linspace(0, wanted[-1], 25), wanted[:25], place[:25]))
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
    assert 0.3 <= min(places) <= max(places) <= 0.32


# The linear equations

STATES = 3
TIMES = np.array([0.2, 0.5, 0.9, 1.2, 1.2])
"""Times of the mesh: start, an event, a fixed time, and the end twice."""
WHICH = np.array([-1, 0, -1, -1, -1])
INTERVAL = np.array([0, 0, 1, 2, 2, 3])
LEFT = np.array([0, 0.3, 0, 0, 0.6, 1.0])
RIGHT = np.array([0.3, 1, 1, 0.6, 1, 1.0])
USED = 5


def _equation(tau, z):
    """Return the slope of a smooth equation with strong coupling."""
    a = jnp.array([[0.0, 1.0, 0.2], [-3.0, -0.4, 0.5], [0.3, 0.1, -1.0]])
    return a @ z + 0.3 * jnp.sin(z) + jnp.stack([0.0, jnp.cos(2 * jnp.pi * tau), tau])


def _margin(tau, z):
    return z[0] - 0.4 * z[1] + 0.7 * tau


def _misses(unknown):
    """Return the residuals of the equations of the used elements, written one by one."""
    z = unknown[: USED * STATES].reshape(USED, STATES)
    k = unknown[USED * STATES : USED * STATES * (POINTS + 1)].reshape(USED, POINTS, STATES)
    times = jnp.asarray(TIMES).at[1].set(unknown[-1])
    rows = []
    for e in range(USED):
        begin, end = times[INTERVAL[e]], times[INTERVAL[e] + 1]
        first = begin + LEFT[e] * (end - begin)
        length = (RIGHT[e] - LEFT[e]) * (end - begin)
        for i in range(POINTS):
            at = z[e] + length * sum(GAUSS.integral[i, j] * k[e, j] for j in range(POINTS))
            rows.append(k[e, i] - _equation(first + GAUSS.nodes[i] * length, at))
        reached = z[e] + length * sum(GAUSS.weights[j] * k[e, j] for j in range(POINTS))
        rows.append(reached - z[(e + 1) % USED])
    rows.append(_margin(times[1], z[2])[None])
    return jnp.concatenate(rows)


def test_newton_step_solves_the_dense_equations():
    draw = np.random.default_rng(0)
    state, slopes = draw.normal(size=(6, STATES)), draw.normal(size=(6, POINTS, STATES))

    def slope_of(function):
        return lambda t, y: jax.jacfwd(lambda p: function(p[0], p[1:]))(jnp.append(t, y))

    @jax.jit
    def stepped(mesh, state, slopes):
        elements = Elements(mesh, state, slopes, jnp.zeros((6, POINTS + 1, 1, 2)))
        tau, z = elements.places
        lines = Lines(
            miss=jax.vmap(jax.vmap(_equation))(tau, z)[:, :POINTS] - slopes,
            slopes=jax.vmap(jax.vmap(slope_of(_equation)))(tau, z)[:, :POINTS],
            margin=jax.vmap(_margin)(tau[:, -1], z[:, -1]),
            bend=jax.vmap(slope_of(_margin))(tau[:, -1], z[:, -1]),
        )
        nothing = jnp.zeros((6, POINTS + 1, STATES + 1, 0))
        known = elements, lines, columns_of(elements, lines, nothing)
        return chained(*known, condensed(*known))

    mesh = Mesh(TIMES, WHICH, INTERVAL, LEFT, RIGHT, np.asarray(USED))
    step = jax.device_get(stepped(mesh, state, slopes))
    unknown = np.concatenate([state[:USED].ravel(), slopes[:USED].ravel(), TIMES[1:2]])
    expected = np.linalg.solve(*jax.jit(lambda x: (jax.jacfwd(_misses)(x), -_misses(x)))(unknown))
    found = np.concatenate(
        [step.state[:USED, :, 0].ravel(), step.slopes[:USED, ..., 0].ravel(), step.times[1]]
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(step.times[[0, 2, 3, 4]], 0)


def test_blocks_of_a_batch():
    """A batch with meshes of different sizes does not copy all its arrays for every block."""
    used = jnp.asarray([5, BLOCK + 1, 3 * BLOCK])
    values = jnp.arange(9.0 * BLOCK).reshape(3, -1)
    made = jax.vmap(lambda used, values: in_blocks(lambda x: 2 * x, used, values))
    for count, value, found in zip(used, values, made(used, values), strict=True):
        np.testing.assert_array_equal(found[:count], 2 * value[:count])
    # A loop with a condition for each mesh would choose between old and new arrays.
    assert "bool[3] = lt" not in str(jax.make_jaxpr(made)(used, values))
