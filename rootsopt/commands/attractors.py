"""`rootsopt attractors CONFIG`: coexisting motions and the initial states that lead to each."""

from collections.abc import Sequence

from rootsopt.commands import door

PURPOSE = "Find the coexisting motions of a scene and the initial states that lead to each."


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt attractors` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("attractors", lambda: _run(argv), own=argv is None)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt.commands import cli

    return cli.run("attractors", PURPOSE, argv)
