"""Mistakes put into a copy of the package, each to be noticed by a test; run by `make mutants`."""
