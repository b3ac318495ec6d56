"""Pages in a browser: the report of a run, and the explorer."""

import importlib.util

from rootsopt.errors import InputError

REPORT = "report.html"
"""Name of the report in the result folder."""
_LIBRARIES = "bokeh", "jinja2"


def missing(extra: str = "pages") -> str:
    """Return the libraries of pages that are not installed, and how to install the `extra`."""
    names = [name for name in _LIBRARIES if importlib.util.find_spec(name) is None]
    return f"{' and '.join(names)}; install with `pip install 'rootsopt[{extra}]'`" if names else ""


def require(what: str, extra: str = "pages") -> None:
    """Raise `InputError` unless the libraries of pages are installed, which `what` needs."""
    if words := missing(extra):
        raise InputError(f"{what} needs {words}")
