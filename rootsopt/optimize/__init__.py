"""Gradient-based design of a rotor pair: problem, search, command line."""

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `rootsopt optimize`; returns the exit code."""
    from rootsopt.commands.optimize import main as command

    return command(argv)
