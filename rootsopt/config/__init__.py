"""Configuration: YAML in, typed settings out.

The only place that knows file formats. Keys carry their units; conversion to SI happens
in `rootsopt.scene`. Anything wrong with a file, a key or a value raises `InputError`
with one message that names the key, the value and what is allowed.
"""

from rootsopt.config.families import FAMILY_KEYS
from rootsopt.config.reading import Config, describe_families, describe_keys, load, parse
from rootsopt.config.scene import ProfileConfig
from rootsopt.config.study import EnsembleConfig, SolverConfig
from rootsopt.config.units import hint

load_config = load
"""The public name of `load`."""
DESIGN_KEYS = FAMILY_KEYS["cic"]
"""The design parameters of a CIC rotor, as named in the config."""

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
