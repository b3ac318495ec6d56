"""`python -m rootsopt.sweep CONFIG`: simulate one design at many speeds, or values of any keys."""

from rootsopt.commands.table import sweep

sweep.begin(__name__)
