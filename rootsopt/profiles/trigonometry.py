"""Cosine and sine, computed once where this pays (`rootsopt.runtime.kept`)."""

import contextlib
import functools
from collections.abc import Iterator
from contextvars import ContextVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rootsopt.runtime.kept import kept

_keeping = ContextVar("_keeping", default=False)


@contextlib.contextmanager
def computed_once() -> Iterator[None]:
    """Have cosines and sines that are traced inside this context computed once.

    The program runs faster if it evaluates many points with derivatives, but takes longer to
    compile."""
    token = _keeping.set(True)
    try:
        yield
    finally:
        _keeping.reset(token)


def cos(angle: Float[ArrayLike, "*n"]) -> Float[Array, "*n"]:
    """Return the cosine of an `angle` (rad)."""
    return _circle(_keeping.get(), angle)[0]


def sin(angle: Float[ArrayLike, "*n"]) -> Float[Array, "*n"]:
    """Return the sine of an `angle` (rad)."""
    return _circle(_keeping.get(), angle)[1]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _circle(keep, angle):
    """Return cosine and sine of an `angle` (rad); `keep`: whether they are `kept`."""
    angle = jnp.asarray(angle)
    values = lax.cos(angle), lax.sin(angle)
    return kept(values) if keep else values


@_circle.defjvp
def _(keep, primals, tangents):
    (cos, sin), (turned,) = _circle(keep, *primals), tangents
    return (cos, sin), (-sin * turned, cos * turned)
