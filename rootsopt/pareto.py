"""`python -m rootsopt.pareto CONFIG`: trace the best compromises between two or three terms."""

from rootsopt.commands.door import leave
from rootsopt.commands.table import pareto

main = pareto.main

if __name__ == "__main__":
    leave(main())
