"""`rootsopt sweep CONFIG`: simulate one design at many speeds, or at values of any keys."""

import argparse
from collections.abc import Sequence

from rootsopt.commands import door, parallel

PURPOSE = "Simulate one config at many values of any of its keys (--over), or at many speeds."


def main(argv: Sequence[str] | None = None) -> int:
    """Run `rootsopt sweep` with the arguments `argv` (`None`: those of the process).

    Return the exit code."""
    return door.through("sweep", lambda: _run(argv), own=argv is None)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the command's own options to a `parser`."""
    group = parser.add_argument_group("points of the sweep")
    group.add_argument(
        "--over",
        action="append",
        default=[],
        metavar="KEY=VALUES",
        help="values of a config key: a list (0.05,0.1), a range (300:6000:39, 1:100:9:log) "
        "or, for samples, an interval (300:6000); repeatable",
    )
    group.add_argument(
        "--zip", action="store_true", help="advance all keys together instead of combining them"
    )
    group.add_argument(
        "--zip-keys",
        action="append",
        default=[],
        metavar="KEY,KEY...",
        help="advance these keys together; repeatable",
    )
    group.add_argument("--sample", type=int, metavar="N", help="draw N pseudo-random points")
    group.add_argument(
        "--sobol",
        type=int,
        metavar="N",
        help="draw N points of a Sobol sequence, best a power of 2",
    )
    group.add_argument(
        "--tolerances",
        type=int,
        metavar="N",
        help="simulate N fresh scenes of `tolerances`, instead of --over",
    )
    group.add_argument("--seed", type=int, metavar="N", help="seed of the samples (default: 0)")
    group = parser.add_argument_group("how a sweep runs (with --over or --tolerances)")
    group.add_argument(
        "--data",
        metavar="NAME",
        help="name of the dataset: *.nc or *.zarr (default: sweep.nc)",
    )
    parallel.add_options(group)


def _run(argv: Sequence[str] | None) -> int:
    from rootsopt.commands import cli

    return cli.run("sweep", PURPOSE, argv, options)
