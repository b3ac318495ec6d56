"""Run `python -m rootsopt.optimize CONFIG`: optimise a design and compare it with the baseline."""

from rootsopt.commands.table import optimize

optimize.begin(__name__)
