"""Periodic orbits at all their instants at once, by collocation aligned with events."""
