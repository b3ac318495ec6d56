"""The explorer: a local page whose sliders move a design and its scene; the forces follow."""

import importlib.util

from rootsopt.errors import InputError

LIBRARY = "bokeh"
"""Name of the library that serves the page."""


def require() -> None:
    """Raise `InputError` unless the library that serves the page is installed."""
    if importlib.util.find_spec(LIBRARY) is None:
        raise InputError(
            f"`explore` needs {LIBRARY}; install with `pip install 'rootsopt[explore]'`"
        )


__all__ = ["require"]
