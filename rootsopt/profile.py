"""`python -m rootsopt.profile CONFIG`: compute the geometry of one design."""

from rootsopt.commands.door import leave
from rootsopt.commands.table import profile

main = profile.main

if __name__ == "__main__":
    leave(main())
