"""`python -m rootsopt.attractors CONFIG`: find the coexisting motions of one scene."""

from rootsopt.commands.door import leave
from rootsopt.commands.table import attractors

main = attractors.main

if __name__ == "__main__":
    leave(main())
