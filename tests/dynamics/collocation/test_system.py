"""Tests of the condensed linear equations against a dense solution of the same equations."""

import jax
import jax.numpy as jnp
import numpy as np

from rootsopt.dynamics.collocation.elements import BLOCK, GAUSS, Elements, Mesh, in_blocks
from rootsopt.dynamics.collocation.system import Lines, chained, condensed, own_column

STATES, POINTS = 3, 4
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


def _elements(times, state, slopes):
    mesh = Mesh(times, jnp.asarray(WHICH), jnp.asarray(INTERVAL), jnp.asarray(LEFT),
                jnp.asarray(RIGHT), jnp.asarray(USED))  # fmt: skip
    return Elements(mesh, state, slopes, jnp.zeros((6, POINTS + 1, 1, 2)))


@jax.jit
def _stepped(elements, lines, columns):
    return chained(elements, lines, columns, condensed(elements, lines, columns))


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
    state = jnp.asarray(draw.normal(size=(6, STATES)))
    slopes = jnp.asarray(draw.normal(size=(6, POINTS, STATES)))
    elements = _elements(jnp.asarray(TIMES), state, slopes)
    tau, z = elements.places
    each = jax.jit(jax.vmap(jax.vmap(lambda t, y: jax.jacfwd(
        lambda p: _equation(p[0], p[1:]))(jnp.append(t, y)))))  # fmt: skip
    bend = jax.vmap(lambda t, y: jax.jacfwd(lambda p: _margin(p[0], p[1:]))(jnp.append(t, y)))
    lines = Lines(
        miss=jax.vmap(jax.vmap(_equation))(tau, z)[:, :POINTS] - slopes,
        slopes=each(tau, z)[:, :POINTS],
        margin=jax.vmap(_margin)(tau[:, -1], z[:, -1]),
        bend=bend(tau[:, -1], z[:, -1]),
    )
    step = _stepped(elements, lines, own_column(elements, lines))
    unknown = jnp.concatenate([state[:USED].ravel(), slopes[:USED].ravel(), TIMES[1:2]])
    expected = np.linalg.solve(jax.jit(jax.jacfwd(_misses))(unknown), -jax.jit(_misses)(unknown))
    found = np.concatenate(
        [step.state[:USED, :, 0].ravel(), step.slopes[:USED, ..., 0].ravel(), step.times[1]]
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(step.times[jnp.array([0, 2, 3, 4])], 0)


def test_blocks_of_a_batch():
    """A batch with meshes of different sizes does not copy all its arrays for every block."""
    used = jnp.asarray([5, BLOCK + 1, 3 * BLOCK])
    values = jnp.arange(9.0 * BLOCK).reshape(3, -1)
    made = jax.vmap(lambda used, values: in_blocks(lambda x: 2 * x, used, values))
    for count, value, found in zip(used, values, made(used, values), strict=True):
        np.testing.assert_array_equal(found[:count], 2 * value[:count])
    # A loop with a condition for each mesh would choose between old and new arrays.
    assert "bool[3] = lt" not in str(jax.make_jaxpr(made)(used, values))
