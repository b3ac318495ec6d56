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
    """A study cannot continue. The message says why; the exit code of the study is 3."""


def start_process(cache: bool = False, gpu: bool = False) -> None:
    """Choose double precision for this process, before it computes anything.

    `cache`: keep compiled programs between processes. `gpu`: also let JAX use a GPU. Raises
    `InputError` where the environment prevents JAX from starting.
    """
    use_float64()
    use_cache(wanted=cache)
    if gpu:
        import jax

        jax.config.update("jax_platforms", None)


@dataclasses.dataclass(frozen=True)
class Run:
    """One run of a study: its options, its result folder, and its published figures.

    `published`: for each published figure, its name in the result folder and its name in `docs/`;
    `began`: clock (s) at the start.
    """

    options: argparse.Namespace
    folder: ResultFolder
    published: Mapping[str, str]
    began: float

    @property
    def quick(self) -> bool:
        """Whether this is a reduced run (`--quick`)."""
        return self.options.quick

    @property
    def seconds(self) -> float:
        """Time (s) since the start."""
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
        """Write a figure into the result folder and, with `--docs`, into `docs/` if published."""
        self.folder.write_figure(name, figure)
        if self.options.docs and name in self.published:
            ResultFolder(DOCS).write_figure(self.published[name], figure)


Body = Callable[[Run], int]
"""Type of the body of a study: a function that computes, writes and prints for a run, and returns
the exit code."""


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

    `name`: folder of the study; `purpose`: text of `--help`; `quick`: what `--quick` omits;
    `published`: see `Run`; `add_options`: adds the study's own options; `cache`: see
    `start_process`. If `precision` is False, JAX is not started: the study does that in its own
    processes.
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
    """Return the exit code of a study that checks promises: 0 if they are `kept`, else 3."""
    return OK if kept else NO_RESULT


def _parser(name: str, purpose: str | None, quick: str, publishes: bool) -> argparse.ArgumentParser:
    """Return a parser with the common options of all studies."""
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
