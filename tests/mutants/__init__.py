"""Mistakes in a copy of the package, each of which a test should notice; run by `make mutants`."""
