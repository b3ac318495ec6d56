"""`python -m rootsopt.attractors CONFIG`: find the coexisting motions of one scene."""

from rootsopt.commands.attractors import main
from rootsopt.commands.door import leave

if __name__ == "__main__":
    leave(main())
