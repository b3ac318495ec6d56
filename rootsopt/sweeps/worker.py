"""Simulates points of a sweep, and designs of a search, in a process that another one started."""

import functools
import pickle
import signal
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

from rootsopt.config import Config
from rootsopt.config.families import import_named
from rootsopt.errors import InputError
from rootsopt.response.many import HERE
from rootsopt.runtime import environment, programs
from rootsopt.runtime.environment import versions
from rootsopt.sweeps.local import at_once
from rootsopt.sweeps.points import Row

_one = threading.Lock()


class Settings(NamedTuple):
    """What a worker must agree on with the process that collects the points.

    `versions` (name, version); `imports`: names of files and modules to import first; `cache`:
    whether to keep compiled programs between runs; `threads`: number of points at a time."""

    versions: tuple[tuple[str, str], ...]
    imports: tuple[str, ...] = ()
    cache: bool = True
    threads: int = 1


def work(
    settings: Settings, config: dict[str, Any], points: Sequence[tuple[int, dict[str, Any]]]
) -> list[tuple[int, Row]]:
    """Return (number, record) of `points`, each given as (number, values by dotted key).

    `config`: that of the sweep as plain values. Raises `InputError` if this worker has other
    versions than the sweep."""
    with _one:
        _prepare(settings)
    return at_once(Config.model_validate(config), points, settings.threads)


def evaluate(settings: Settings, task: bytes) -> bytes:
    """Return the evaluation of a point.

    `task`: the `Point`. It travels as bytes, as does the result: its arrays need double precision,
    and its types may need an import. Raises `InputError` if this worker has other versions than the
    search."""
    with _one:
        _prepare(settings)
    return pickle.dumps(HERE.evaluated(pickle.loads(task)))


def dask_setup(worker: Any) -> None:
    """Ignore Ctrl-C, which reaches all processes of a terminal: the sweep's own process reacts.

    Dask calls this function when it starts a process with this module as `preload`."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@functools.cache
def _prepare(settings: Settings) -> None:
    """Choose precision, threads and cache, and import extensions, once per process."""
    here = dict(versions())
    odd = [name for name, version in settings.versions if here.get(name) != version]
    if odd:
        there = dict(settings.versions)
        told = ", ".join(f"{name} {here.get(name)} instead of {there[name]}" for name in odd)
        raise InputError(
            f"a worker has other versions than this process: {told}; install the same ones on all "
            "machines"
        )
    environment.use_one_thread()
    environment.use_float64()
    refused = programs.keep_by_default() if settings.cache else programs.keep_in(None)
    if refused:
        environment.say(f"compiled programs are not kept between runs: {refused}")
    for name in settings.imports:
        import_named(name)
