"""`python -m rootsopt.pareto CONFIG`: trace the best compromises between two or three terms."""

from rootsopt.commands.door import leave
from rootsopt.commands.pareto import main

if __name__ == "__main__":
    leave(main())
