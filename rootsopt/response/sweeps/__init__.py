"""Sweeps: one config at many values of any of its keys, on one process or many."""
