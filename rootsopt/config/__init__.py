"""Configuration: YAML in, typed settings out.

The only place that knows file formats. Keys carry their units; conversion to SI happens
in `rootsopt.model`. Anything wrong with a file, a key or a value raises `InputError`
with one message that names the key, the value and what is allowed.
"""

from rootsopt.config.reading import Config, describe_keys, load, parse
from rootsopt.config.scene import DESIGN_KEYS, FAMILY_KEYS, LIST_KEYS, ProfileConfig
from rootsopt.config.study import EnsembleConfig, SolverConfig
from rootsopt.config.units import hint

__all__ = [
    "DESIGN_KEYS",
    "FAMILY_KEYS",
    "LIST_KEYS",
    "Config",
    "EnsembleConfig",
    "ProfileConfig",
    "SolverConfig",
    "describe_keys",
    "hint",
    "load",
    "parse",
]
