"""Configuration: YAML in, typed settings out.

Only this package knows the config's file format. Each key carries its unit; `rootsopt.scene`
converts to SI. Raises `InputError` for a wrong file, key or value: one message that names the key,
the value and what is allowed.
"""

from rootsopt.config.families import FAMILY_KEYS
from rootsopt.config.reading import Config, describe_families, describe_keys, load, parse
from rootsopt.config.scene import ProfileConfig
from rootsopt.config.study import EnsembleConfig, SolverConfig
from rootsopt.config.units import hint

load_config = load
"""Name of `load` in the package `rootsopt`."""
DESIGN_KEYS = FAMILY_KEYS["cic"]
"""Config keys of the design parameters of a CIC rotor."""

__all__ = [
    "DESIGN_KEYS",
    "FAMILY_KEYS",
    "Config",
    "EnsembleConfig",
    "ProfileConfig",
    "SolverConfig",
    "describe_families",
    "describe_keys",
    "hint",
    "load",
    "load_config",
    "parse",
]
