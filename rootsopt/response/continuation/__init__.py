"""Periodic orbits followed along a parameter; `rootsopt.continuation` has the public names."""
