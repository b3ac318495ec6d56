"""`rootsopt simulate CONFIG`: simulate one design in one scene."""

from collections.abc import Sequence

from rootsopt.commands import door

PURPOSE = "Simulate one design in one scene: steady state, contact force, its gradient."


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt simulate` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("simulate", lambda: _run(argv), own=argv is None)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt import export
    from rootsopt.commands import cli

    return cli.run("simulate", PURPOSE, argv, lambda p: export.add_option(p, "none"))
