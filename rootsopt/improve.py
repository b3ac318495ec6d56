"""`python -m rootsopt.improve ROTOR`: find a better rotor than that of a CSV or DXF file."""

from rootsopt.commands.door import leave
from rootsopt.commands.table import improve

main = improve.main

if __name__ == "__main__":
    leave(main())
