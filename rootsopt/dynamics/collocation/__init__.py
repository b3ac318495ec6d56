"""Periodic orbits by collocation: all instants are solved for at once, on elements that end at
events."""
