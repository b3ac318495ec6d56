"""The versions on which results depend."""

import importlib.metadata
import platform

import rootsopt

_LIBRARIES = ("jax", "jaxlib", "diffrax", "optax", "equinox", "numpy")


def versions() -> dict[str, str]:
    """Return the versions of Python, this package and the libraries that affect its results."""
    found = {"python": platform.python_version(), "rootsopt": rootsopt.__version__}
    return found | {name: importlib.metadata.version(name) for name in _LIBRARIES}


__all__ = ["versions"]
