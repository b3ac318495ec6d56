"""`python -m rootsopt.explore CONFIG`: explore a design and its scene with sliders."""

from rootsopt.commands.door import leave
from rootsopt.commands.table import explore

main = explore.main

if __name__ == "__main__":
    leave(main())
