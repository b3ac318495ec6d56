"""`python -m rootsopt.explore CONFIG`: explore a design and its scene with sliders."""

from rootsopt.commands.table import explore

main = explore.main
explore.begin(__name__)
