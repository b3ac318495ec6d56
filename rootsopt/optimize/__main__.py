"""Run `python -m rootsopt.optimize CONFIG`: optimise a design and compare it with the baseline."""

from rootsopt.commands.door import leave
from rootsopt.commands.table import optimize

if __name__ == "__main__":
    leave(optimize.main())
