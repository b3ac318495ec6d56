"""Tries the oldest and the newest supported versions of all dependencies: `make compat`."""
