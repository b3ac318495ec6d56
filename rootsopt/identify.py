"""`python -m rootsopt.identify CONFIG`: fit quantities of a scene to a measured record."""

import sys

import rootsopt
from rootsopt.commands.table import identify

identify.begin(__name__)
# This import, too, leaves `rootsopt.identify` the public function of that name.
sys.modules[__name__] = rootsopt.__getattr__("identify")
