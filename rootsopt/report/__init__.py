"""The option `--report`: one HTML file that shows a run and opens without a network."""

import importlib.util

from rootsopt.errors import InputError

REPORT = "report.html"
"""Name of the report in the result folder."""
_LIBRARIES = "jinja2", "plotly"


def require() -> None:
    """Raise `InputError` unless the libraries that make the report are installed."""
    missing = [name for name in _LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"`--report` needs {' and '.join(missing)}; install with `pip install "
            "'rootsopt[pages]'`, or leave `--report` out"
        )


__all__ = ["REPORT", "require"]
