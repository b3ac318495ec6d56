"""Figures of profiles, forces, searches, speeds and basins."""
