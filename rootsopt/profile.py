"""`python -m rootsopt.profile CONFIG`: compute the geometry of one design."""

from rootsopt.commands.table import profile

profile.begin(__name__)
