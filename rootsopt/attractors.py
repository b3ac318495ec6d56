"""`python -m rootsopt.attractors CONFIG`: find the coexisting motions of one scene."""

from rootsopt.commands.table import attractors

attractors.begin(__name__)
