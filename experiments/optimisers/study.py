"""Compares optimisation methods on the same problems, by evaluations and time to the optimum.

Every problem is a config with overrides. All methods work on the epigraph of the same problem, with
exact gradients, start at the baseline and end when their evaluations run out. The best feasible
value that any of them reaches counts as the optimum.
"""

import contextlib
import importlib.util
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import BFGS, NonlinearConstraint, minimize

from experiments._common.driver import Run
from experiments._common.scenes import shipped
from experiments._common.tables import Row, show
from experiments.optimisers.epigraph import SCALE, Epigraph
from rootsopt.config import Config
from rootsopt.optimize.local import FEASIBLE, Linearization, Look, certify
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.sqp import EndError, Stops, descend
from rootsopt.response.evaluation import Evaluator
from rootsopt.view.figures.style import figure, looks

# Distance of the objective from the optimum below which a method has reached the optimum.
REACHED = 1e-6

# Number of designs that each method may simulate: in a full run, and in a reduced run.
EVALUATIONS, QUICK = 150, 15
_PEAK = "objective.mean_weight=0"
Method = Callable[[Any, NDArray[np.float64], Stops], None]

# Number of rounds of the augmented Lagrangian, and of iterations of L-BFGS in each round.
_OUTER, _INNER = 30, 25

# Weight of the penalty: first value, factor where the violation does not fall by half, and
# maximum.
_PENALTY, _GROWTH, _MOST = 10.0, 4.0, 1e6

# Share of the predicted decrease that a step must reach, shares of a step that are tried, and
# decrease below which L-BFGS ends.
_ARMIJO, _SHARES, _FLAT = 1e-4, 0.5 ** np.arange(20), 1e-11

# Greatest sine at the start of L-BFGS: at 1, on a bound, its gradient would be zero.
_INSIDE = 0.98


# Shipped config and overrides of each problem.
TASKS: dict[str, tuple[str, ...]] = {
    "cic": ("cic",),
    "cic, peak alone": ("cic", _PEAK),
    "cic, mean alone": ("cic", "objective.peak_weight=0"),
    "cic, RMS alone": ("cic", _PEAK, "objective.peak_weight=0", "objective.rms_weight=1"),
    "cic, 2000 rpm": ("cic", "scene.speed_rpm=2000"),
    "cic, 5000 rpm": ("cic", "scene.speed_rpm=5000"),
    "cic, half the load": ("cic", "scene.load.torque_N_m=2.4"),
    "cic, wide backlash": ("cic", "scene.timing_gear.backlash_mm=0.2"),
    "cic, narrow bore of the housing": (
        "cic", "constraints.outer_radius_max_mm=44.8", "constraints.area_efficiency_min=0.43"),
    "cic, wide seal": ("cic", "constraints.seal_width_min_mm=5"),
    "cic, two speeds": ("cic", "objective.speeds_rpm=[2500, 3500]"),
    "cic, worst of two speeds": (
        "cic", "objective.speeds_rpm=[2500, 3500]", "objective.over_speeds=worst"),
    "free form": ("free",),
}  # fmt: skip

# Number of problems in a reduced run.
QUICK_TASKS = 2


def sqp(look: "Recorder", start: NDArray[np.float64], stops: Stops) -> None:
    """Run the package's own local search: sequential quadratic programming."""
    descend(look, start, stops, look.problem.limits_at)


def on_epigraph(solve: Callable[[Epigraph, Stops], None]) -> Method:
    """Return a method that works on the epigraph of a problem, until an evaluation ends it."""

    def method(look: Look, start: NDArray[np.float64], stops: Stops) -> None:
        first = look(start)
        if first is not None:
            with contextlib.suppress(EndError):
                solve(Epigraph(look, start, first, stops), stops)

    return method


def _bounds(problem: Epigraph, count: int) -> list[tuple[float | None, float | None]]:
    free: list[tuple[float | None, float | None]] = [(None, None)]
    return [(0.0, 1.0 / SCALE)] * problem.size + free * (count - problem.size)


@on_epigraph
def augmented_lagrangian(problem: Epigraph, _stops: Stops) -> None:
    """Run an augmented Lagrangian with optax's L-BFGS (Nocedal and Wright, algorithm 17.4).

    L-BFGS knows no bounds: each bounded variable is a sine of a free one. The step length is found
    by halving (Armijo)."""
    size = problem.size
    z = problem.start()
    z[:size] = np.arcsin(np.clip(2 * SCALE * z[:size] - 1, -_INSIDE, _INSIDE))
    weights = np.zeros(len(problem.constraints(z)[0]))
    penalty, before = _PENALTY, np.inf

    def bounded(w):
        sines, cosines = (1 + np.sin(w)) / (2 * SCALE), np.cos(w) / (2 * SCALE)
        inside = np.arange(len(w)) < size
        return np.where(inside, sines, w), np.where(inside, cosines, 1.0)

    def merit(w) -> tuple[float, NDArray[np.float64]]:
        z, by_free = bounded(w)
        (value, slope), (slack, normals) = problem.value(z), problem.constraints(z)
        short = np.maximum(weights / penalty - slack, 0.0)
        slope = slope - penalty * short @ normals
        return float(value + penalty / 2 * short @ short), slope * by_free

    for _ in range(_OUTER):
        z = _lbfgs(merit, z)
        slack = problem.constraints(bounded(z)[0])[0]
        violation = np.max(np.maximum(-slack, 0.0))
        weights = np.maximum(weights - penalty * slack, 0.0)
        if violation > before / 2:
            penalty = min(_GROWTH * penalty, _MOST)
        before = violation


def _lbfgs(
    merit: Callable[[NDArray[np.float64]], tuple[float, NDArray[np.float64]]],
    z: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the variables after some iterations of optax's L-BFGS from `z`."""
    rule = optax.scale_by_lbfgs()
    state = rule.init(jnp.asarray(z))
    update = jax.jit(rule.update)
    value, slope = merit(z)
    for _ in range(_INNER):
        direction, state = update(jnp.asarray(slope), state, jnp.asarray(z))
        step = -np.asarray(direction)
        if step @ slope >= 0:
            step = -slope
        for share in _SHARES:
            found, gradient = merit(z + share * step)
            if found <= value + _ARMIJO * share * (step @ slope):
                break
        else:
            return z
        gained = value - found
        z, value, slope = z + share * step, found, gradient
        if gained < _FLAT:
            break
    return z


@on_epigraph
def interior_point(problem: Epigraph, _stops: Stops) -> None:
    """Run SciPy's trust-constr: an interior point method within a trust region."""
    z = problem.start()
    limits = NonlinearConstraint(
        lambda z: problem.constraints(z)[0],
        0.0,
        np.inf,
        jac=lambda z: problem.constraints(z)[1],  # pyright: ignore[reportArgumentType]
        hess=BFGS(),
    )
    minimize(
        problem.value,
        z,
        jac=True,
        hess=BFGS(),
        method="trust-constr",
        bounds=_bounds(problem, len(z)),
        constraints=limits,
        options={"maxiter": 10_000, "gtol": 1e-12, "xtol": 1e-12, "barrier_tol": 1e-10},
    )


@on_epigraph
def moving_asymptotes(problem: Epigraph, stops: Stops) -> None:
    """Run NLopt's method of moving asymptotes (Svanberg 2002, globally convergent).

    Raises ImportError without the package `nlopt`."""
    import nlopt  # type: ignore[import-not-found]

    z = problem.start()
    count = len(problem.constraints(z)[0])
    search = nlopt.opt(nlopt.LD_MMA, len(z))
    low, high = zip(*_bounds(problem, len(z)), strict=True)
    search.set_lower_bounds([-1e3 if b is None else b for b in low])
    search.set_upper_bounds([1e3 if b is None else b for b in high])

    def value(z, slope):
        found, gradient = problem.value(z)
        slope[: slope.size] = gradient[: slope.size]
        return found

    def limits(result, z, slope):
        slack, normals = problem.constraints(z)
        result[:] = -slack
        if slope.size:
            slope[:] = -normals

    search.set_min_objective(value)
    search.add_inequality_mconstraint(limits, np.full(count, 1e-9))
    search.set_maxeval(stops.evaluations)
    with contextlib.suppress(nlopt.RoundoffLimited, RuntimeError):
        search.optimize(z)


# Each method, with its name in the legend.
METHODS: dict[str, tuple[Method, str]] = {
    "slsqp": (sqp, "SQP (default)"),
    "augmented_lagrangian": (augmented_lagrangian, "augmented Lagrangian"),
    "interior_point": (interior_point, "interior point"),
    "mma": (moving_asymptotes, "MMA"),
}


class Recorder:
    """A problem as the methods see it. It records every evaluation."""

    def __init__(self, config: Config):
        evaluator = Evaluator.of_objective(config)
        self.baseline = baseline = evaluator(series=False)
        self.problem = Problem.of(config, evaluator.scene, baseline)
        self.evaluator = evaluator.relative_to(baseline).surveying().with_maxima()
        self.start = self.problem.project(self.problem.point([*baseline.design.values()]))
        self.reset()

    def reset(self) -> None:
        """Forget all evaluations."""
        self.rows: list[dict[str, float]] = []
        self.near, self.began = self.baseline.start, time.perf_counter()

    def __call__(self, point: np.ndarray) -> Linearization | None:
        """Evaluate the problem at a point and record it."""
        design = self.problem.design(point)
        evaluation = self.evaluator(design, start=self.near, series=False)
        found = self.problem.local(evaluation, point)
        row = {"evaluation": len(self.rows) + 1, "seconds": time.perf_counter() - self.began}
        row |= dict.fromkeys(("objective", "violation", "residual"), np.nan)
        if found is not None:
            self.near = evaluation.start
            row |= {"objective": found.objective, "violation": found.violation}
            row["residual"] = certify(found, point).residual
        self.rows.append(row)
        return found


def summary(rows: list[Row]) -> Iterator[Row]:
    """Yield evaluations and time to the optimum, by problem and method."""
    for task in dict.fromkeys(row["problem"] for row in rows):
        here = [row for row in rows if row["problem"] == task]
        best = min((row["objective"] for row in here if _met(row)), default=np.nan)
        for method in dict.fromkeys(row["method"] for row in here):
            own = [row for row in here if row["method"] == method]
            met = [row for row in own if _met(row)]
            hits = [row for row in met if row["objective"] <= best + REACHED]
            yield {
                "problem": task,
                "method": method,
                "evaluations": hits[0]["evaluation"] if hits else None,
                "seconds": hits[0]["seconds"] if hits else None,
                "above_best": min((r["objective"] for r in met), default=np.nan) - best,
                "residual": min((r["residual"] for r in met), default=np.nan),
                "designs": len(own),
            }


def _met(row: Row) -> bool:
    return bool(np.isfinite(row["objective"]) and row["violation"] <= FEASIBLE)


def solved(rows: list[Row]) -> Figure:
    """Draw, for each method, the number of problems whose optimum it has reached.

    `rows`: those of `summary`."""
    made, ((ax,),) = figure(6.5, 3.6)
    problems = len({row["problem"] for row in rows})
    methods = dict.fromkeys(row["method"] for row in rows)
    for method, look in zip(methods, looks(METHODS[name][1] for name in methods), strict=True):
        own = [row["evaluations"] for row in rows if row["method"] == method]
        counts = np.sort([count for count in own if count is not None])
        ax.step([0, *counts, EVALUATIONS], [*range(len(counts) + 1), len(counts)], where="post",
                **look)  # fmt: skip
    ax.set(
        xlim=(0, EVALUATIONS), ylim=(0, problems + 0.3), xlabel="designs simulated",
        ylabel=f"problems solved to 1e-6, of {problems}",
    )  # fmt: skip
    ax.legend(frameon=False, loc="center right")
    return made


def run(job: Run) -> bool:
    """Run every method on every problem; a method whose package is missing is left out.

    Returns whether the package's own method solves at least as many problems as any other."""
    methods = dict(METHODS)
    if importlib.util.find_spec("nlopt") is None:
        del methods["mma"]
    # So tight that a method ends at its own criterion, or when the evaluations run out.
    stops = Stops(feasibility=FEASIBLE, evaluations=QUICK if job.quick else EVALUATIONS)
    rows: list[Row] = []
    for task in list(TASKS)[: QUICK_TASKS if job.quick else None]:
        look = Recorder(shipped(*TASKS[task]))
        look(look.start)  # Compiles.
        for name, (method, _) in methods.items():
            look.reset()
            method(look, look.start, stops)
            rows += [{"problem": task, "method": name, **row} for row in look.rows]
            job.say(f"{task}: {name}, {len(look.rows)} designs")
    table = [*summary(rows)]
    reached = Counter(row["method"] for row in table if row["evaluations"] is not None)
    job.csv("optimisers.csv", rows)
    job.json("optimisers.json", {"summary": table, "solved": reached})
    job.figure("optimisers.png", solved(table))
    show("Evaluations and time to the optimum", table)
    return job.quick or reached["slsqp"] >= max(reached.values())
