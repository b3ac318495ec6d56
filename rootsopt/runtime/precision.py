"""Checks the precision of JAX.

A command or a script chooses the precision; the library never does."""

import jax


def check_precision() -> None:
    """Raise `RuntimeError` unless JAX is set to double precision."""
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "JAX computes in single precision here, but rootsopt needs double precision: call "
            'jax.config.update("jax_enable_x64", True) before anything else'
        )
