"""`python -m rootsopt.pareto CONFIG`: trace the best compromises between two or three terms."""

from rootsopt.commands.table import pareto

pareto.begin(__name__)
