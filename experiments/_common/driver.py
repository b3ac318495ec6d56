"""The command line of a study: common options, precision, result folder, exit code.

Exit code 0: success. 2: bad input, one message on stderr. 3: no result, or the results break a
promise that the study checks.

This module imports neither JAX nor a study, so `--help` answers at once. A study is imported inside
the body of its `__main__.py`, after double precision has been chosen.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rootsopt.commands.cli import use_cache
from rootsopt.commands.door import BAD_INPUT, NO_RESULT
from rootsopt.commands.door import OK as OK
from rootsopt.errors import InputError
from rootsopt.output.files import ResultFolder, row_columns, versions
from rootsopt.runtime import environment
from rootsopt.runtime.environment import use_float64

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULTS = Path("results/experiments")
"""Folder of the result folders, relative to the repository root."""
DOCS = Path("docs")
"""Folder of the published figures, relative to the repository root."""


class NoResultError(Exception):
    """A study cannot continue: the message says why, and the exit code is 3."""


def start_process(cache: bool = False, gpu: bool = False) -> None:
    """Choose double precision for this process, before it computes anything.

    `cache`: keep compiled programs between processes. `gpu`: also let JAX use a GPU. Raises
    `InputError` where the environment prevents JAX from starting.
    """
    use_float64()
    if cache:
        use_cache()
    if gpu:
        import jax

        jax.config.update("jax_platforms", None)


@dataclasses.dataclass(frozen=True)
class Run:
    """One run of a study: its options, its result folder, and its published figures.

    `published` maps a figure's name in the result folder to its name in `docs/`. `began` is the
    clock (s) at the start.
    """

    options: argparse.Namespace
    folder: ResultFolder
    published: Mapping[str, str]
    began: float

    @property
    def quick(self) -> bool:
        """Return whether this is the reduced run."""
        return self.options.quick

    @property
    def seconds(self) -> float:
        """Return the seconds since the start."""
        return time.perf_counter() - self.began

    def say(self, text: str) -> None:
        """Report progress on stderr, with the time."""
        print(f"{self.seconds:7.1f} s  {text}", file=sys.stderr, flush=True)

    def csv(
        self, name: str, rows: Sequence[Mapping[str, Any]], keys: Iterable[str] | None = None
    ) -> None:
        """Write rows as a CSV file; `keys` orders the columns (default: order of appearance)."""
        self.folder.write_csv(name, row_columns(rows, keys))

    def json(self, name: str, data: Mapping[str, Any]) -> None:
        """Write a record as JSON, with the versions of the libraries used."""
        self.folder.write_json(name, {**data, "versions": versions()})

    def figure(self, name: str, figure: "Figure") -> None:
        """Write a figure; with `--docs` also write the published one."""
        self.folder.write_figure(name, figure)
        if self.options.docs and name in self.published:
            ResultFolder(DOCS).write_figure(self.published[name], figure)


Body = Callable[[Run], int]
"""Body of a study for a run: compute, write, print. Returns the exit code."""


def drive(
    name: str,
    purpose: str | None,
    body: Body,
    *,
    quick: str,
    published: Mapping[str, str],
    add_options: Callable[[argparse.ArgumentParser], None] = lambda _: None,
    precision: bool = True,
    cache: bool = False,
) -> int:
    """Parse the arguments, choose double precision, run a study's body; return the exit code.

    `purpose` is the text of `--help`. `quick` says what `--quick` omits. `published` is as in
    `Run`, and `cache` as in `start_process`. `add_options` adds the study's own options. Without
    `precision` JAX is not touched: the study starts it in its own processes.
    """
    parser = _parser(name, purpose, quick, bool(published))
    add_options(parser)
    options = parser.parse_args()
    if options.quick and options.docs:
        parser.error("--docs publishes figures and cannot be combined with --quick; remove one")
    environment.own_process()
    began = time.perf_counter()
    try:
        if precision:
            start_process(cache)
        return body(Run(options, ResultFolder(options.output), published, began))
    except InputError as error:
        print(f"{parser.prog}: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    except NoResultError as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return NO_RESULT


def verdict(kept: bool) -> int:
    """Return the exit code of a study whose promises are kept, or not."""
    return OK if kept else NO_RESULT


def _parser(name: str, purpose: str | None, quick: str, publishes: bool) -> argparse.ArgumentParser:
    """Make a parser with the common options of all studies."""
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{name}",
        description=purpose,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        default=RESULTS / name,
        help="folder of the results (default: %(default)s)",
    )
    parser.add_argument("--quick", action="store_true", help=f"reduced run: {quick}")
    parser.set_defaults(docs=False)
    if publishes:
        parser.add_argument(
            "--docs", action="store_true", help="also write the published figures into docs/"
        )
    return parser
