"""Reads a config from YAML and returns typed settings.

Only this package knows the config's file format. Each key carries its unit; `rootsopt.scene`
converts to SI. A wrong file, key or value raises `InputError`. Its message names the key and the
value, and says what is allowed."""

from rootsopt.config.families import family_of
from rootsopt.config.plausible import notes
from rootsopt.config.reading import Config, load, parse
from rootsopt.config.reading import load as load_config
from rootsopt.config.study import EnsembleConfig

__all__ = ["Config", "EnsembleConfig", "family_of", "load", "load_config", "notes", "parse"]
