"""Quantities of a scene from a measured record: the scene whose motion fits the record best."""
