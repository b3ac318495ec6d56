"""Values that XLA computes once."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.profiles import base as trig
from rootsopt.runtime.compute_once import compute_once, compute_once_along

ANGLES = jnp.linspace(-3.0, 3.0, 64)


def results(cos, sin):
    """Return a function with several results and derivatives that use the same two values."""

    def one(angle):
        near = jnp.arctan2(2 + sin(angle), 3 + cos(angle))
        return near * cos(angle), near / (2 + sin(angle)), cos(near) - sin(angle)

    def both(angle):
        with trig.computed_once():
            values, linear = jax.linearize(one, angle)
            return values, linear(1.0), jax.jacfwd(jax.jacfwd(one))(angle)

    return jax.jit(jax.vmap(both))


def waves(function, *arguments):
    text = function.lower(*arguments).compile().as_text()
    return sum(text.count(f" {name}(") for name in ("cosine", "sine"))


def test_what_is_kept_does_not_change():
    """Integers, single numbers, infinite values and arrays of any nested batch pass unchanged."""
    tree = {"number": 3.0 * ANGLES[0], "count": jnp.arange(3), "far": jnp.full(40, jnp.inf)}
    jax.tree.map(np.testing.assert_array_equal, compute_once(tree), tree)
    square = ANGLES.reshape(8, 8)
    row = jax.vmap(jax.vmap(lambda x: compute_once((x, jnp.arange(4.0)))))(square)
    np.testing.assert_array_equal(row[0], square)
    assert row[1].shape == (8, 8, 4)
    assert float(jax.grad(lambda x: trig.sin(x) ** 2)(0.3)) == pytest.approx(np.sin(0.6))


@jax.custom_jvp
def values_kept(value):
    return compute_once(value)


@values_kept.defjvp
def _(primals, tangents):
    return compute_once(*primals), tangents[0]


def derivatives(through):
    """Return a function whose derivatives all pass `through` the same intermediate value."""

    def one(angle):
        inner = through(jnp.sin(2.0 * jnp.sin(angle)))
        return jnp.arctan2(inner, 3.0), jnp.exp(inner) / (2.0 + inner), inner**3

    def all_(angles):
        values, linear = jax.linearize(jax.vmap(one), angles)
        slopes = jax.vmap(linear)(jnp.eye(2)[:, :1] + jnp.zeros_like(angles))
        return values, [jnp.cumsum(x, axis=1) for x in slopes]

    return jax.jit(all_)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="only CPUs repeat operations")
@pytest.mark.parametrize(
    ("repeated", "once", "share"),
    [
        (results(jnp.cos, jnp.sin), results(trig.cos, trig.sin), 0.5),
        (derivatives(values_kept), derivatives(compute_once_along), 1.0),
    ],
    ids=["cosines of many angles", "derivatives along directions"],
)
def test_values_are_computed_once(repeated, once, share):
    """Values and derivatives are the same. XLA alone repeats cosine, sine and inner derivative."""
    same = functools.partial(np.testing.assert_allclose, rtol=1e-13, atol=1e-13)
    jax.tree.map(same, repeated(ANGLES), once(ANGLES))
    assert waves(once, ANGLES) < share * waves(repeated, ANGLES)
