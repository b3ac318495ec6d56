"""`python -m rootsopt.simulate CONFIG`: simulate one design in one scene."""

from rootsopt.commands.door import leave
from rootsopt.commands.table import simulate

main = simulate.main

if __name__ == "__main__":
    leave(main())
