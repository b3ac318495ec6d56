"""`python -m rootsopt.profile CONFIG`: compute the geometry of one design."""

from rootsopt.commands.table import profile

main = profile.main
profile.begin(__name__)
