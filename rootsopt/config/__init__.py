"""Reads a config from YAML and returns typed settings.

Only this package knows the config's file format. Each key carries its unit; `rootsopt.scene`
converts to SI. A wrong file, key or value raises `InputError`. Its message names the key and the
value, and says what is allowed."""

from rootsopt.config.families import FAMILY_KEYS
from rootsopt.config.plausible import notes
from rootsopt.config.reading import Config, load, parse
from rootsopt.config.reading import load as load_config
from rootsopt.config.rotor import ProfileConfig
from rootsopt.config.study import TWIST, EnsembleConfig, SolverConfig
from rootsopt.config.units import hint

DESIGN_KEYS = FAMILY_KEYS["cic"]
"""Config keys of the design parameters of a CIC rotor."""

__all__ = [
    "DESIGN_KEYS",
    "FAMILY_KEYS",
    "TWIST",
    "Config",
    "EnsembleConfig",
    "ProfileConfig",
    "SolverConfig",
    "hint",
    "load",
    "load_config",
    "notes",
    "parse",
]
