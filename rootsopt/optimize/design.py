"""The main tasks in one function each: optimise a design, and trace a front of compromises."""

import threading
from collections.abc import Callable

from rootsopt.config.reading import Config
from rootsopt.errors import InputError
from rootsopt.optimize.outcome import Optimization, Progress
from rootsopt.optimize.robust import StagedSearch, is_robust
from rootsopt.optimize.search import Search
from rootsopt.optimize.tradeoffs.front import Front
from rootsopt.optimize.tradeoffs.trace import Tracer
from rootsopt.response.journal import Checkpoint
from rootsopt.response.reducers import HERE, Runs
from rootsopt.response.sweeps.cluster import running
from rootsopt.runtime.threads import one_thread
from rootsopt.scene.check import check_geometry


def search_of(
    config: Config,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
    checkpoint: Checkpoint | None = None,
    runs: Runs = HERE,
) -> Search | StagedSearch:
    """Return the search that a `config` needs.

    It is a `Search` if there are no `tolerances` and `assumptions.scenes` is 0, and otherwise a
    `StagedSearch`. Arguments: see `Search`.

    Raises `InputError` for `tolerances` with a profile from a file, which has no design
    parameters."""
    if config.tolerances is not None and config.profile.family == "outline":
        raise InputError(
            "`tolerances` must be absent for `profile.family` outline; optimise it without them, "
            "then optimise the `optimized.yaml` of that run with `tolerances`"
        )
    kind = StagedSearch if config.spans or is_robust(config) else Search
    return kind(config, progress, stop, checkpoint, runs)


@one_thread
def optimize_design(
    config: Config,
    progress: Callable[[int, int, float], None] | None = None,
    *,
    stop: threading.Event | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Optimization:
    """Find the design that minimises the objective of a `config`, and compare it with the baseline.

    `progress`: function called after each evaluation with (evaluations done, evaluations expected,
    best objective so far). `stop`: event that another thread can set to end the search early, with
    the best design found until then. `workers`, `scheduler`: where the designs are simulated, as in
    `sweep_scenes`; by default in this process, on all cores.

    Return an `Optimization`. Its main fields are `baseline`, `optimized` (`None` if no better
    design was confirmed), `improvement`, `constraints`, `history` and `status`.

    Raises `InputError` if the config cannot be optimised. Raises `RuntimeError` if JAX is not set
    to double precision.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> quick = ["optimizer.starts=1", "optimizer.screening=0", "optimizer.iterations=2"]
    >>> quick += ["assumptions.scenes=0"]  # no comparison in other scenes
    >>> optimization = rootsopt.optimize_design(rootsopt.load_config("cic", quick))
    >>> optimization.improvement["objective"] > 0  # a few designs only: without `quick`, an optimum
    True
    """
    check_geometry(config)
    with running(workers, scheduler) as runs:
        return search_of(config, progress, stop, runs=runs).run()


@one_thread
def pareto_front(
    config: Config,
    progress: Callable[[int, int], None] | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Front:
    """Trace the front of best compromises between the terms of `config.pareto`.

    `progress`: function called after each local search with (searches done, searches expected).
    `workers`, `scheduler`: where the designs are simulated, as in `sweep_scenes`; by default in
    this process, on all cores.

    Return a `Front`. Its main fields are `points` (each with `terms`, `design`, `rates` and
    `standing`), `gaps`, `dropped`, `baseline_terms` and `status`.

    Raises `InputError` if the config cannot be optimised, or for unknown terms. Raises
    `RuntimeError` if JAX is not set to double precision.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> terms = "pareto.terms=[outer_radius_mm, area_efficiency]"
    >>> quick = [terms, "pareto.points=3", "pareto.refinements=0"]
    >>> front = rootsopt.pareto_front(rootsopt.load_config("cic_drawn", quick))
    >>> [round(point.terms["outer_radius_mm"], 1) for point in front.points]
    [39.0, 43.1, 47.8]
    """
    check_geometry(config)
    with running(workers, scheduler) as runs:
        return Tracer(config, progress, runs=runs).run()
