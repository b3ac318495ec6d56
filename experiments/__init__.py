"""Studies of rootsopt, one folder each; README.md lists them."""

import os

# Turn Equinox's checks off; `rootsopt.commands.cli` says why. Equinox reads this variable once,
# when it is first imported.
os.environ.setdefault("EQX_ON_ERROR", "off")
