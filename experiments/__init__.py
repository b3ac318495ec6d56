"""Studies of rootsopt, one folder each; README.md lists them."""

import os

# Equinox reads this once, when it is first imported;
# `rootsopt.commands.cli` says why they are off.
os.environ.setdefault("EQX_ON_ERROR", "off")
