"""The options `--workers`, `--scheduler` and `--resume` of `sweep`, `optimize` and `pareto`."""

import os
from typing import TYPE_CHECKING

from rootsopt.runtime.environment import say

if TYPE_CHECKING:
    import argparse
    from contextlib import AbstractContextManager

    from rootsopt.response.many import Runs


def add_options(parser: "argparse.ArgumentParser | argparse._ArgumentGroup") -> None:
    """Add the options to a `parser`, or to a group of its options."""
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="start N processes (default: this one, with one thread per core)",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="use a running Dask scheduler: tcp://10.0.0.1:8786",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with a run into the same folder that was stopped or killed",
    )


def chosen(options: "argparse.Namespace") -> "AbstractContextManager[Runs]":
    """Return a context manager for what runs the evaluations of a search with these `options`."""
    from rootsopt.sweeps.evaluations import evaluating

    if options.workers is not None:
        say(
            f"`--workers {options.workers}` starts processes that load everything again, some 10 s "
            f"each, and then are no faster than this process, which uses all {os.cpu_count() or 1} "
            "cores; leave it out unless a design may end its process"
        )
    cache = not options.no_cache
    return evaluating(options.workers, options.scheduler, options.imports, cache)


__all__ = ["add_options", "chosen"]
