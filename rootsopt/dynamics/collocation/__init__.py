"""Periodic orbits by collocation: one system of equations for all instants of the orbit, on
elements that end at events."""
