"""Checks the precision of JAX.

A command or a script chooses the precision; the library never does."""

import jax


def check_precision(precision: str) -> None:
    """Raise `RuntimeError` if `precision` is float64 but JAX is set to single precision."""
    if precision == "float64" and not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "JAX computes in single precision here: call "
            'jax.config.update("jax_enable_x64", True) before anything else, or set '
            "solver.precision to float32"
        )
