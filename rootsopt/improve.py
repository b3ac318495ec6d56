"""`python -m rootsopt.improve ROTOR`: find a better rotor than that of a CSV or DXF file."""

from rootsopt.commands.table import improve

improve.begin(__name__)
