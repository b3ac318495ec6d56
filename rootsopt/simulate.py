"""`python -m rootsopt.simulate CONFIG`: simulate one design in one scene."""

from rootsopt.commands.table import simulate

main = simulate.main
simulate.begin(__name__)
