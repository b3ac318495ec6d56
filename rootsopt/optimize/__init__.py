"""Gradient-based optimisation of a rotor pair: design problem, search and verification."""

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command `rootsopt optimize` with the arguments `argv` and return the exit code.

    If `argv` is `None`, use the arguments of the process."""
    from rootsopt.commands.table import optimize

    return optimize.main(argv)
