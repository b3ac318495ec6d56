"""`python -m rootsopt.explore CONFIG`: explore a design and its scene with sliders."""

from rootsopt.commands.table import explore

explore.begin(__name__)
