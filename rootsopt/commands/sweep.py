"""`rootsopt sweep CONFIG`: simulate one design at many speeds."""

from collections.abc import Sequence

from rootsopt.commands import door

PURPOSE = "Simulate one design at many speeds, each from rest: contact force and kind of motion."


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt sweep` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("sweep", lambda: _run(argv), own=argv is None)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt.commands import cli

    return cli.run("sweep", PURPOSE, argv)
