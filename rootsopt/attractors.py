"""`python -m rootsopt.attractors CONFIG`: find the coexisting motions of one scene."""

from rootsopt.commands.table import attractors

main = attractors.main
attractors.begin(__name__)
