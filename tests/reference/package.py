"""The one place that calls rootsopt: load a config, evaluate it, take its record."""

import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

import rootsopt
from rootsopt.config import load

HERE = Path(__file__).parent
CALL = "Evaluator.of_objective(load(config, overrides))(series=False).record()"
"""The call of each case, as stated in the reference file."""
KEPT = ("design", "geometry", "response", "gradient", "steady_state", "status")
"""Entries of a record that are stored."""
PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "optimistix", "lineax", "numpy", "scipy")


def start() -> None:
    """Choose double precision and the cache of compiled programs, as a command does.

    Programs are not optimised unless XLA_FLAGS says otherwise, because most of the time is
    compilation."""
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
    from rootsopt.commands.cli import use_cache
    from rootsopt.runtime.environment import use_float64

    use_float64()
    use_cache()


def evaluate(config: str, overrides: list[str], nudge: float = 0.0) -> dict[str, Any]:
    """Return the record of the config's own design, as plain data.

    config: name of a shipped config. overrides: HERE in them is this folder. nudge: relative change
    of the speed, to see how far a result depends on rounding. Raises `rootsopt.errors.InputError`
    for a config that is refused."""
    from rootsopt.response.evaluation import Evaluator

    overrides = [one.replace("HERE/", f"{HERE}/") for one in overrides]
    found = load(config, overrides)
    if nudge:
        speed = found.scene.speed_rpm * (1 + nudge)
        found = load(config, [*overrides, f"scene.speed_rpm={speed!r}"])
    record = Evaluator.of_objective(found)(series=False).record()
    return {key: record[key] for key in KEPT if key in record}


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which the numbers depend."""
    own = {"python": platform.python_version(), "rootsopt": rootsopt.__version__}
    return own | {name: metadata.version(name) for name in PACKAGES}
