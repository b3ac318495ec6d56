"""`python -m rootsopt.sweep CONFIG`: simulate one design at many speeds, or values of any keys."""

from rootsopt.commands.table import sweep

main = sweep.main
sweep.begin(__name__)
