"""Work divided among threads."""

import jax.numpy as jnp
import numpy as np

from rootsopt.runtime.threads import on_all_cores


def test_work_is_divided_among_the_cores():
    """Every row is computed once and is returned in its place, whatever its shape."""
    rng = np.random.default_rng(0)
    for count in (1, 2, 5, 8):
        designs, states = jnp.asarray(rng.normal(size=(count, 3))), jnp.arange(float(count))
        doubled, summed = on_all_cores(
            lambda a, b: (2 * a, jnp.sum(a, axis=-1) + b), designs, states
        )
        np.testing.assert_array_equal(doubled, 2 * designs)
        np.testing.assert_allclose(summed, np.sum(designs, axis=1) + np.arange(count))
