"""Studies a scene that is chaotic at the baseline and at the optimum.

- The average of a single motion along a line of designs, against the average over an ensemble.
- The derivative of a single motion's average, against the slope estimated from an ensemble.
- An optimisation of the ensemble's average, and its verification by independent ensembles.
- How the standard errors fall with the members, and whether they agree with the scatter.
"""

import dataclasses
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments._common.driver import NoResultError, Run
from experiments._common.scenes import FORCES, shipped
from experiments._common.style import BLACK, BLUE, GREEN, PURPLE, VERMILION, sheet
from experiments._common.tables import Row, print_record
from rootsopt.config import Config
from rootsopt.dynamics.flow import one_period
from rootsopt.optimize.noise import standard_error
from rootsopt.optimize.outcome import Optimization
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.search import Search
from rootsopt.response.ensemble import Ensemble, integrator
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.result import ERRORS
from rootsopt.response.together import run_members
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
    "ensemble.designs=16",
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


# Sizes of all parts of the study except the optimisation; keys: whether the run is reduced.
# `line`: number of designs along the line; `members`, `window`: members and mesh periods of an
# average; `pathwise`: mesh periods of the single motion that is differentiated; `large`: members
# of the ensemble that is divided into `groups`; `slopes`: (designs, members) of each gradient,
# first more members, then more designs.
SIZES = {
    False: SimpleNamespace(
        line=13, members=32, window=128, pathwise=96, large=512, groups=(4, 8, 16, 32, 64),
        slopes=((16, 4), (16, 8), (16, 16), (32, 4), (64, 4), (128, 4))),
    True: SimpleNamespace(
        line=3, members=4, window=8, pathwise=8, large=16, groups=(4, 8), slopes=((8, 4),)),
}  # fmt: skip


def resized(config: Config, model: Scene, **changes) -> Evaluator:
    """Make an evaluator without gradients, with `changes` to the config's `ensemble` section."""
    ensemble = config.ensemble.model_copy(update=changes)
    config = config.model_copy(update={"ensemble": ensemble})
    return Evaluator(config, model, Ensemble()).surveying().without_gradient()


def line(config: Config, model: Scene, designs: np.ndarray, size: SimpleNamespace) -> Iterator[Row]:
    """Average the force along a line of designs (n, d), over the motion from rest and an
    ensemble."""
    evaluator = resized(config, model, members=size.members, periods=size.window)
    how, settle = integrator(evaluator.scene), config.ensemble.settle_periods
    for share, design in zip(np.linspace(0, 1, len(designs)), designs, strict=True):
        found = evaluator(jnp.asarray(design), series=False)
        pair = evaluator.pair(design)
        (single,) = run_members([pair], np.zeros((1, 2)), settle, size.window, how)
        row = {"share": share, **found.design, "single_mean_force_N": single.means[0, 0]}
        row |= {name: found.response.get(name, np.nan) for name in FORCES}
        errors = (ERRORS[name] for name in FORCES)
        yield row | {name: found.steady_state.get(name, np.nan) for name in errors}


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


def pathwise(evaluator: Evaluator, design, size: SimpleNamespace) -> list[Row]:
    """Measure how the derivative of a single motion's mean force grows with the averaging
    window."""
    scene = evaluator.scene
    slopes = np.asarray(_pathwise(scene, jnp.asarray(design), size.pathwise, integrator(scene)))
    return [
        {"window_mesh_periods": n, "mean_force_by_pressure_angle_N_per_deg": slope}
        for n, slope in enumerate(slopes[:, 0], 1)
    ]


def errors_by_members(config: Config, model: Scene, design, size: SimpleNamespace) -> Iterator[Row]:
    """Compare the stated standard error of the mean force with the scatter of independent groups.

    The groups are parts of one large ensemble. The standard error of the scatter is listed too.
    """
    evaluator = resized(config, model, members=size.large)
    start = np.asarray(evaluator(jnp.asarray(design), series=False).start)
    pair, how = evaluator.pair(design), integrator(evaluator.scene)
    (large,) = run_members([pair], start, 0, config.ensemble.periods, how)
    means = np.asarray(large.means)[:, 0]
    for members in size.groups:
        groups = means[: len(means) // members * members].reshape(-1, members)
        stated = np.std(groups, axis=1, ddof=1) / np.sqrt(members)
        scatter = np.std(np.mean(groups, axis=1), ddof=1)
        yield {
            "members": members,
            "groups": len(groups),
            "stated_standard_error_N": np.sqrt(np.mean(stated**2)),
            "scatter_of_groups_N": scatter,
            "error_of_scatter_N": scatter / np.sqrt(2 * max(len(groups) - 1, 1)),
        }


def gradients(config: Config, model: Scene, design, size: SimpleNamespace) -> Iterator[Row]:
    """Estimate the slope of the mean force over the pressure angle, with its standard error.

    Yields a row for each size in `size.slopes`: more members, or more designs.
    """
    for designs, members in size.slopes:
        evaluator = resized(config, model, members=members, designs=designs)
        evaluator = dataclasses.replace(evaluator, differentiate=True)
        found = evaluator(jnp.asarray(design), series=False)
        errors = found.steady_state["gradient_standard_error"]
        yield {
            "designs": designs,
            "members": members,
            "gradient_N_per_deg": found.gradient["mean_force_N"]["pressure_angle_deg"],
            "standard_error_N_per_deg": errors["mean_force_N"]["pressure_angle_deg"],
        }


def designs_between(problem: Problem, result: Optimization, count: int) -> np.ndarray:
    """Return designs (count, d) on a line from the baseline to the optimum.

    Without a significant optimum (as in a reduced run) the line ends at the last design.
    """
    first = problem.point(list(result.baseline.design.values()))
    found = result.history[-1] if result.optimized is None else result.optimized.design
    end = [found[key] for key in result.baseline.design]
    shares = np.linspace(0, 1, count)[:, None]
    points = (1 - shares) * first + shares * problem.point(end)
    return np.array([problem.design(point) for point in points])


def summary(problem: Problem, result: Optimization) -> dict[str, Any]:
    """Return a record of baseline and optimum, evaluated by the verifying ensemble.

    The record includes the significance of the gain."""
    record = result.verification
    ends = {"baseline": result.baseline, "optimized": result.optimized}
    found: dict[str, Any] = {"verification": record} | {
        name: {
            "design": one.design,
            **one.response,
            **one.steady_state,
            "objective": problem.objective(one),
            "objective_standard_error": standard_error(problem, one),
        }
        for name, one in ends.items()
        if one is not None
    }
    if "combined_standard_error" in record:
        gain = 1 - record["verified_objective"]
        found["gain_in_standard_errors"] = gain / record["combined_standard_error"]
    return found


def run(job: Run) -> None:
    """Optimise, then study the baseline and the line of designs to the optimum.

    Raises `NoResultError` if the baseline has no average.
    """
    size = SIZES[job.quick]
    config = shipped("cic", *SCENE, *(QUICK if job.quick else FULL))
    search = Search(config)
    result = search.run()
    problem = result.problem
    if problem is None or not result.baseline.usable:
        raise NoResultError(f"baseline {result.baseline.status.label}")
    job.say("optimised")
    model = search.exact.scene
    designs = designs_between(problem, result, size.line)
    tables = {
        "history": result.history,
        "line": [*line(config, model, designs, size)],
        "pathwise": pathwise(resized(config, model), designs[0], size),
        "members": [*errors_by_members(config, model, designs[0], size)],
        "gradients": [*gradients(config, model, designs[0], size)],
    }
    for name, rows in tables.items():
        job.csv(f"chaos_{name}.csv", rows)
    record = summary(problem, result) | {"ensemble": config.ensemble.model_dump()}
    job.json("chaos.json", record)
    job.figure("chaos.png", panels(problem, result, tables))
    print_record(record)


def panels(problem: Problem, result: Optimization, tables: dict[str, list[Row]]) -> Figure:
    """Draw the four panels of the figure: averages, derivatives, optimisation, standard errors."""
    figure, ((a, b), (c, d)) = sheet(12.5, 9, 2, 2)
    averages(a, tables["line"])
    derivatives(b, tables["pathwise"], tables["gradients"])
    optimisation(c, problem, result)
    standard_errors(d, tables["members"], tables["gradients"])
    return figure


def column(rows: list[Row], key: str) -> np.ndarray:
    """Return the column `key` (n,) of `rows`, with NaN for entries that are not numbers."""
    return np.array([np.nan if row[key] is None else row[key] for row in rows], float)


def averages(ax: Axes, rows: list[Row]) -> None:
    """Draw the averages of one motion and of an ensemble along the line of designs."""
    share = column(rows, "share")
    ax.plot(share, column(rows, "single_mean_force_N"), ".-", color=VERMILION, lw=0.8,
           label="one motion from rest")  # fmt: skip
    ax.errorbar(share, column(rows, "mean_force_N"), column(rows, ERRORS["mean_force_N"]), fmt="o",
               color=BLUE, ms=4, capsize=2, label="ensemble, ± standard error")  # fmt: skip
    ax.set(
        xlabel="fraction of the way from baseline to optimum", ylabel="mean contact force (N)",
        ylim=(0, None), title="(a) Average along a line of designs",
    )  # fmt: skip
    ax.legend(frameon=False)


def derivatives(ax: Axes, rows: list[Row], estimates: list[Row]) -> None:
    """Draw the growing derivative of one motion over the window, and the ensemble's slope."""
    window = column(rows, "window_mesh_periods")
    by_angle = np.abs(column(rows, "mean_force_by_pressure_angle_N_per_deg"))
    ax.semilogy(window, by_angle, "-", color=VERMILION, label="one motion, differentiated")
    slope, error = (estimates[-1][k] for k in ("gradient_N_per_deg", "standard_error_N_per_deg"))
    ax.axhline(abs(slope), color=BLUE, label=f"ensemble: {slope:.1f} ± {error:.1f} N/deg")
    ax.set(
        xlabel="window (mesh periods)", ylabel="|d mean force / d pressure angle| (N/deg)",
        title="(b) Derivative at the baseline",
    )  # fmt: skip
    ax.legend(frameon=False)


def optimisation(ax: Axes, problem: Problem, result: Optimization) -> None:
    """Draw the objective over the evaluations, and both verified designs."""
    rows = result.history
    number, objective = column(rows, "evaluation"), column(rows, "objective")
    error = column(rows, "objective_standard_error")
    screened = column(rows, "start") < 0
    for chosen, color, label in ((screened, "0.55", "screening"), (~screened, BLUE, "descent")):
        ax.errorbar(number[chosen], objective[chosen], error[chosen], fmt="o", color=color, ms=4,
                   capsize=2, label=f"{label}, ± standard error")  # fmt: skip
    verified = [("baseline, verified", result.baseline, BLACK, "s")]
    verified += [("optimum, verified", result.optimized, GREEN, "D")] if result.optimized else []
    for place, (label, one, color, mark) in enumerate(verified, int(number[-1]) + 2):
        ax.errorbar([place], [problem.objective(one)], [standard_error(problem, one)], fmt=mark,
                    color=color, ms=7, capsize=3, label=label)  # fmt: skip
    ax.axhline(1, color=BLACK, lw=0.8, ls=":")
    ax.set(xlabel="evaluation", ylabel="objective (baseline = 1)", ylim=(0, None))
    ax.set_title("(c) Optimisation of the ensemble's average")
    ax.legend(frameon=False, ncols=2, loc="lower left")


def standard_errors(ax: Axes, members: list[Row], estimates: list[Row]) -> None:
    """Draw the standard errors of average and gradient over the number of motions."""
    count = column(members, "members")
    stated = column(members, "stated_standard_error_N")
    ax.loglog(count, stated, "o", color=BLUE, label="stated standard error (N)")
    ax.errorbar(1.04 * count, column(members, "scatter_of_groups_N"),
               column(members, "error_of_scatter_N"), fmt="x", color=VERMILION, ms=7, capsize=2,
               label="scatter of independent groups (N)")  # fmt: skip
    ax.loglog(count, stated[0] * np.sqrt(count[0] / count), ":", color="0.4", lw=1,
             label="∝ 1/√(motions)")  # fmt: skip
    least = estimates[0]["designs"]
    for chosen, mark, color, label in (
        ([e for e in estimates if e["designs"] == least], "s-", GREEN, "more members each"),
        ([e for e in estimates if e["members"] == estimates[0]["members"]], "D--", PURPLE,
         "more designs"),
    ):  # fmt: skip
        motions = column(chosen, "designs") * column(chosen, "members")
        errors, said = column(chosen, "standard_error_N_per_deg"), f"gradient (N/deg): {label}"
        ax.loglog(motions, errors, mark, color=color, ms=5, lw=1, label=said)
        ax.loglog(motions, errors[0] * np.sqrt(motions[0] / motions), ":", color="0.4", lw=1)
    ax.set(
        xlabel="motions: members, or designs × members", ylabel="standard error of the mean force",
        ylim=(0.3, None), title="(d) Standard error of average and gradient",
    )  # fmt: skip
    ax.legend(frameon=False)
