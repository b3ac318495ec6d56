"""`python -m rootsopt.simulate CONFIG`: simulate one design in one scene."""

from rootsopt.commands.table import simulate

simulate.begin(__name__)
