"""Gradient-based optimisation of a rotor pair: problem, search, verification."""

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command `rootsopt optimize` and return the exit code."""
    from rootsopt.commands.optimize import main as command

    return command(argv)
