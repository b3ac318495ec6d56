"""Tests of an orbit's monodromy matrix against the matrix exponential of an oscillator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from rootsopt.dynamics import window
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.orbit import Shots, branch, close_orbit
from tests.standins import (
    DAMPING,
    HALF_BACKLASH,
    INERTIA,
    LOAD,
    LOBES,
    SCALE,
    SPEED,
    STIFFNESS,
    oscillator,
)


def test_multiplier_is_that_of_the_whole_orbit():
    """A damped oscillator decays by exp(-c t/2I): over k mesh periods, k times as far as over one.

    The monodromy matrix is its matrix exponential, and the multiplier is not a root or power of
    that."""
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
        # For a linear equation, one step of Newton's method finds the orbit.
        assert int(orbit.newton_steps) < 8


@pytest.mark.parametrize("taken", [[True] * 3, [False] * 3, [True, False, True]])
def test_branches_of_a_batch_on_a_gpu(monkeypatch, taken):
    """A batch computes only the branches that one of its motions takes."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    made = set()

    def told(name, value):
        jax.debug.callback(lambda: made.add(name))
        return value

    def one(taken, x):
        return branch(taken, lambda: told("then", 2 * x), lambda: told("otherwise", -x))

    values = jnp.arange(1.0, 4.0)
    found = jax.jit(jax.vmap(one))(jnp.asarray(taken), values)
    jax.effects_barrier()
    np.testing.assert_array_equal(found, jnp.where(jnp.asarray(taken), 2 * values, -values))
    assert made == {"then" if now else "otherwise" for now in taken}
    # A condition that is the same for the whole batch, and a branch without batched values.
    shared = jax.jit(jax.vmap(one, (None, 0)))(taken[1], values)
    np.testing.assert_array_equal(shared, 2 * values if taken[1] else -values)
    fixed = jax.vmap(lambda now: branch(now, lambda: jnp.ones(2), lambda: jnp.zeros(2)))
    np.testing.assert_array_equal(fixed(jnp.asarray(taken))[:, 0], taken)


def test_loops_of_a_branch_end_with_the_motions_that_take_it(monkeypatch):
    """In a batch on a GPU, a motion that does not take a branch does not prolong its loops."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    turns = []

    def counted(k):
        jax.debug.callback(lambda: turns.append(1))
        return k + 1

    def one(limit):
        count = jnp.zeros((), int)

        def loop():
            return lax.while_loop(lambda k: k < limit, counted, count)

        return branch(limit < 10, loop, lambda: count)

    found = jax.jit(jax.vmap(one))(jnp.asarray([3, 500, 5]))
    jax.effects_barrier()
    np.testing.assert_array_equal(found, [3, 0, 5])
    assert len(turns) <= 3 * 5
