"""Run `python -m rootsopt.optimize CONFIG`: optimise a design and compare it with the baseline."""

from rootsopt.commands.door import leave
from rootsopt.commands.optimize import main

if __name__ == "__main__":
    leave(main())
