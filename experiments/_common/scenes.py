"""Configs and names that several studies use."""

from rootsopt.config import Config, load

CIC = "configs/cic.yaml"
"""The shipped CIC pair, relative to the repository root."""
FORCES = ("mean_force_N", "peak_force_N")
"""Names of the forces that most studies compare."""


def shipped(name: str, *overrides: str) -> Config:
    """Load `configs/NAME.yaml` with overrides, each `dotted.key=value`."""
    return load(f"configs/{name}.yaml", list(overrides))
