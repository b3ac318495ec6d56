"""`python -m rootsopt.sweep CONFIG`: simulate one design at many speeds, or values of any keys."""

from rootsopt.commands.door import leave
from rootsopt.commands.table import sweep

main = sweep.main

if __name__ == "__main__":
    leave(main())
