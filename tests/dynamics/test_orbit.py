"""Tests of branches of a search that the motions of a batch share."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from rootsopt.dynamics.orbit import branch


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
