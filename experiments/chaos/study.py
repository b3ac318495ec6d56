"""Studies a scene that is chaotic at the baseline and at the optimum.

- The average of a single motion along a line of designs, against the average over an ensemble.
- The derivative of a single motion's average, against the slope estimated from an ensemble.
- An optimisation of the ensemble's average, and its verification by independent ensembles.
- How the standard errors fall with the members, and whether they agree with the scatter.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from experiments._common.driver import NoResultError
from experiments._common.scenes import shipped
from rootsopt.config import Config
from rootsopt.dynamics.flow import one_period
from rootsopt.optimize.noise import standard_error
from rootsopt.optimize.outcome import Optimization
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.search import Search
from rootsopt.response.ensemble import ERRORS, Ensemble, integrator
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.members import run_members
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene

SCENE = (
    "scene.load.torque_N_m=1",
    "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.1, backlash_mm: 0.4}",
    "objective.motion=ensemble",
)
FULL = (
    "ensemble.members=16",
    "ensemble.settle_periods=32",
    "ensemble.spread=0.1",
    "optimizer.screening=8",
    "optimizer.starts=1",
    "optimizer.iterations=16",
)
QUICK = (
    "ensemble.members=4",
    "ensemble.settle_periods=8",
    "ensemble.periods=8",
    "ensemble.designs=12",
    "ensemble.spread=0.1",
    "optimizer.screening=1",
    "optimizer.starts=1",
    "optimizer.iterations=1",
)


@dataclasses.dataclass(frozen=True)
class Size:
    """Sizes of all parts of the study except the optimisation.

    `line`: number of designs along the line; `members`, `window`: members and mesh periods of an
    average; `pathwise`: mesh periods of the single motion that is differentiated; `large`: members
    of the ensemble that is divided into `groups`; `slopes`: (designs, members) of each gradient.
    """

    line: int
    members: int
    window: int
    pathwise: int
    large: int
    groups: tuple[int, ...]
    slopes: tuple[tuple[int, int], ...]


def _slopes(designs: int, members: int, count: int) -> tuple[tuple[int, int], ...]:
    """Return sizes (designs, members) of gradients, starting from the given size.

    First come `count` sizes with doubling members, then `count` - 1 with doubling designs."""
    more = [(designs, members * 2**k) for k in range(count)]
    return (*more, *((designs * 2**k, members) for k in range(1, count)))


SIZES = {
    False: Size(25, 32, 128, 96, 512, (4, 8, 16, 32, 64), _slopes(16, 4, 4)),
    True: Size(3, 4, 8, 8, 16, (4, 8), _slopes(8, 4, 1)),
}


def resized(config: Config, model: Scene, **changes) -> Evaluator:
    """Make an evaluator without gradients, with `changes` to the config's `ensemble` section."""
    ensemble = config.ensemble.model_copy(update=changes)
    config = config.model_copy(update={"ensemble": ensemble})
    return Evaluator(config, model, Ensemble()).surveying().without_gradient()


def line(config: Config, model: Scene, designs: np.ndarray, size: Size) -> list[dict]:
    """Average the force along a line of designs (n, d), over the motion from rest and an
    ensemble."""
    evaluator = resized(config, model, members=size.members, periods=size.window)
    settle = config.ensemble.settle_periods
    rest = np.zeros((1, 2))
    rows = []
    for share, design in zip(np.linspace(0, 1, len(designs)), designs, strict=True):
        evaluation = evaluator(jnp.asarray(design), series=False)
        pair = _pair(evaluator.scene, jnp.asarray(design))
        (single,) = run_members([pair], rest, settle, size.window, integrator(evaluator.scene))
        row = {"share": share, **evaluation.design, "single_mean_force_N": single.means[0, 0]}
        for name in ("mean_force_N", "peak_force_N"):
            row[name] = evaluation.response.get(name, np.nan)
            row[ERRORS[name]] = evaluation.steady_state.get(ERRORS[name], np.nan)
        rows.append(row)
    return rows


_pair = CachedFunction(Scene.pair)


@CachedFunction
def _pathwise(model: Scene, design, periods, how):
    """Differentiate the mean force with respect to the design, along the motion from rest.

    Returns derivatives (periods, d): row k is for the mean over all mesh periods up to the k-th.
    """

    def means(design):
        pair = model.pair(design)

        def step(state, _):
            out = one_period(pair, state, how)
            return out.end, out.response[0]

        every = lax.scan(step, jnp.zeros(2), length=periods)[1]
        return jnp.cumsum(every) / (1 + jnp.arange(periods))

    return jax.jacfwd(means)(design)


def pathwise(evaluator: Evaluator, design, size: Size) -> list[dict]:
    """Measure how the derivative of a single motion's mean force grows with the averaging
    window."""
    slopes = np.asarray(
        _pathwise(evaluator.scene, jnp.asarray(design), size.pathwise, integrator(evaluator.scene))
    )
    return [
        {"window_mesh_periods": n, "mean_force_by_pressure_angle_N_per_deg": slope}
        for n, slope in enumerate(slopes[:, 0], 1)
    ]


def errors_by_members(config: Config, model: Scene, design, size: Size) -> list[dict]:
    """Compare the stated standard error of the mean force with the scatter of independent groups.

    The groups are parts of one large ensemble. The standard error of the scatter is listed too.
    """
    evaluator = resized(config, model, members=size.large)
    design = jnp.asarray(design)
    start = evaluator(design, series=False)
    pair, how = _pair(evaluator.scene, design), integrator(evaluator.scene)
    (large,) = run_members([pair], np.asarray(start.start), 0, config.ensemble.periods, how)
    means = np.asarray(large.means)[:, 0]
    rows = []
    for members in size.groups:
        groups = means[: len(means) // members * members].reshape(-1, members)
        stated = np.std(groups, axis=1, ddof=1) / np.sqrt(members)
        scatter = np.std(np.mean(groups, axis=1), ddof=1)
        rows.append(
            {
                "members": members,
                "groups": len(groups),
                "stated_standard_error_N": np.sqrt(np.mean(stated**2)),
                "scatter_of_groups_N": scatter,
                "error_of_scatter_N": scatter / np.sqrt(2 * max(len(groups) - 1, 1)),
            }
        )
    return rows


def gradients(config: Config, model: Scene, design, size: Size) -> list[dict]:
    """Estimate the slope of the mean force over the pressure angle, with its standard error.

    Returns a row for each size in `size.slopes`: more members, or more designs.
    """
    rows = []
    for designs, members in size.slopes:
        evaluator = resized(config, model, members=members, designs=designs)
        evaluator = dataclasses.replace(evaluator, differentiate=True)
        found = evaluator(jnp.asarray(design), series=False)
        errors = found.steady_state["gradient_standard_error"]
        row, column = "mean_force_N", "pressure_angle_deg"
        rows.append(
            {
                "designs": designs,
                "members": members,
                "gradient_N_per_deg": found.gradient[row][column],
                "standard_error_N_per_deg": errors[row][column],
            }
        )
    return rows


def summary(problem: Problem, result: Optimization) -> dict[str, Any]:
    """Return a record of baseline and optimum, evaluated by the verifying ensemble.

    The record includes the significance of the gain."""
    found: dict[str, Any] = {"verification": result.verification}
    for name, one in (("baseline", result.baseline), ("optimized", result.optimized)):
        if one is not None:
            found[name] = {
                "design": one.design,
                **one.response,
                **one.steady_state,
                "objective": problem.objective(one),
                "objective_standard_error": standard_error(problem, one),
            }
    record = result.verification
    if "combined_standard_error" in record:
        gain = 1 - record["verified_objective"]
        found["gain_in_standard_errors"] = gain / record["combined_standard_error"]
    return found


@dataclasses.dataclass(frozen=True)
class Results:
    """Results of the study: the optimisation, and a table of rows for each other part."""

    config: Config
    problem: Problem
    optimization: Optimization
    line: list[dict]
    pathwise: list[dict]
    members: list[dict]
    gradients: list[dict]
    seconds: dict[str, float]

    @property
    def tables(self) -> dict[str, list[dict]]:
        """Return the rows by the name of their part."""
        return {
            "line": self.line,
            "pathwise": self.pathwise,
            "history": self.optimization.history,
            "members": self.members,
            "gradients": self.gradients,
        }

    def record(self) -> dict[str, Any]:
        """Return summary, scene and times for a result file."""
        return summary(self.problem, self.optimization) | {
            "scene": list(SCENE),
            "ensemble": self.config.ensemble.model_dump(),
            "seconds": self.seconds,
        }


def run(quick: bool, say: Callable[[str], None] = lambda text: None) -> Results:
    """Optimise, then study the baseline and the line of designs to the optimum.

    Raises `NoResultError` if the baseline has no average.
    """
    seconds: dict[str, float] = {}

    def timed(name: str, work: Callable[..., Any], *given: Any) -> Any:
        began = time.perf_counter()
        found = work(*given)
        seconds[name] = time.perf_counter() - began
        say(f"{name}: {seconds[name]:.0f} s")
        return found

    size = SIZES[quick]
    config = shipped("cic", *SCENE, *(QUICK if quick else FULL))
    search = Search(config)
    result = timed("optimization", search.run)
    problem = result.problem
    if problem is None or not result.baseline.usable:
        raise NoResultError(f"baseline {result.baseline.status.label}")
    model = search.exact.scene
    designs = designs_between(problem, result, size.line)
    evaluator = resized(config, model)
    return Results(
        config,
        problem,
        result,
        line=timed("line", line, config, model, designs, size),
        pathwise=timed("pathwise", pathwise, evaluator, designs[0], size),
        members=timed("members", errors_by_members, config, model, designs[0], size),
        gradients=timed("gradients", gradients, config, model, designs[0], size),
        seconds=seconds,
    )


def designs_between(problem: Problem, result: Optimization, count: int) -> np.ndarray:
    """Return designs (count, d) on a line from the baseline to the optimum.

    Without a significant optimum (as in a reduced run) the line ends at the last design.
    """
    first = problem.point(list(result.baseline.design.values()))
    end = list((result.optimized or result.baseline).design.values())
    if result.optimized is None:
        end = [result.history[-1][key] for key in result.baseline.design]
    shares = np.linspace(0, 1, count)[:, None]
    points = (1 - shares) * first + shares * problem.point(end)
    return np.array([problem.design(point) for point in points])
