"""`python -m rootsopt.profile CONFIG`: compute the geometry of one design."""

from rootsopt.commands.door import leave
from rootsopt.commands.profile import main

if __name__ == "__main__":
    leave(main())
