"""What a study is, and one run of it: options, precision, result folder, published figures.

This module imports neither JAX nor a study, so `--help` answers at once. The module `study` of a
study is imported after double precision has been chosen.
"""

import argparse
import dataclasses
import importlib
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rootsopt.commands.cli import use_cache
from rootsopt.runtime.environment import use_float64, versions
from rootsopt.view.files import ResultFolder, row_columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Folder of the published figures, relative to the repository root.
DOCS = Path("docs")


class NoResultError(Exception):
    """A study cannot continue. The message says why; the exit code of the study is 3."""


@dataclasses.dataclass(frozen=True)
class Study:
    """What a study is, apart from its question, which is the docstring of its package.

    `quick`: what a reduced run omits; `published`: for each published figure, its name in the
    result folder and its name in `docs/`; `options`: for each option of its own, the settings that
    `argparse` takes; `further`: options of further runs that `--all` makes; `cache`: whether
    compiled programs are kept between processes; `alone`: whether no other study may run beside
    it, because it measures times or uses all cores; or the option with which this holds. If
    `precision` is False, JAX is not started: the study does that in its own processes.
    """

    quick: str
    published: Mapping[str, str] = dataclasses.field(default_factory=dict)
    options: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    further: tuple[tuple[str, ...], ...] = ()
    cache: bool = True
    alone: bool | str = False
    precision: bool = True


def start_process(cache: bool = False) -> None:
    """Choose double precision for this process, before it computes anything.

    `cache`: keep compiled programs between processes. Raises `InputError` where the environment
    prevents JAX from starting.
    """
    use_float64()
    use_cache(wanted=cache)


@dataclasses.dataclass(frozen=True)
class Run:
    """One run of a study: its options, its result folder, and its published figures.

    `published`: see `Study`; `began`: clock (s) at the start.
    """

    options: argparse.Namespace
    folder: ResultFolder
    published: Mapping[str, str]
    began: float

    @property
    def quick(self) -> bool:
        """Whether this is a reduced run (`--quick`)."""
        return self.options.quick

    def say(self, text: str) -> None:
        """Report progress on stderr, with the time."""
        print(f"{time.perf_counter() - self.began:7.1f} s  {text}", file=sys.stderr, flush=True)

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


def conduct(name: str, study: Study, options: argparse.Namespace) -> bool:
    """Run a study; return whether it keeps the promises that it checks.

    `name`: folder of the study. Raises `InputError` for bad input, and `NoResultError`."""
    began = time.perf_counter()
    if study.precision:
        start_process(study.cache)
    run = Run(options, ResultFolder(options.output), study.published, began)
    return importlib.import_module(f"experiments.{name}.study").run(run) is not False
