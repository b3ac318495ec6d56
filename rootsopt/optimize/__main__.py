"""`python -m rootsopt.optimize CONFIG`: an optimised design against the baseline."""

from rootsopt.commands.door import leave
from rootsopt.commands.optimize import main

if __name__ == "__main__":
    leave(main())
