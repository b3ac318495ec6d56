"""Figure of the chaotic scene: averages, derivatives, optimisation and standard errors."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments._common.style import BLACK, BLUE, GREEN, PURPLE, VERMILION, grid_below, sheet
from experiments.chaos.study import Results
from rootsopt.optimize.noise import standard_error
from rootsopt.optimize.outcome import Optimization
from rootsopt.optimize.problem import Problem
from rootsopt.response.ensemble import ERRORS

Rows = list[dict]


def panels(results: Results) -> Figure:
    """Draw the four panels of the figure: averages, derivatives, optimisation, standard errors."""
    figure, axes = sheet(12.5, 9, 2, 2)
    (a, b), (c, d) = axes
    averages(a, results.line)
    derivatives(b, results.pathwise, results.gradients)
    optimisation(c, results.problem, results.optimization)
    standard_errors(d, results.members, results.gradients)
    for ax in axes.flat:
        grid_below(ax)
    return figure


def column(rows: Rows, key: str) -> np.ndarray:
    """Return the column `key` (n,) of `rows`, with NaN for entries that are not numbers."""
    return np.array([np.nan if row[key] is None else row[key] for row in rows], float)


def averages(ax: Axes, rows: Rows) -> None:
    """Draw the averages of one motion and of an ensemble along the line of designs."""
    share = column(rows, "share")
    ax.plot(share, column(rows, "single_mean_force_N"), ".-", color=VERMILION, lw=0.8,
           label="one motion from rest")  # fmt: skip
    ax.errorbar(share, column(rows, "mean_force_N"), column(rows, ERRORS["mean_force_N"]), fmt="o",
               color=BLUE, ms=4, capsize=2, label="ensemble, ± standard error")  # fmt: skip
    ax.set(xlabel="fraction of the way from baseline to optimum", ylabel="mean contact force (N)")
    ax.set_ylim(0, None)
    ax.set_title("(a) Average along a line of designs")
    ax.legend(frameon=False)


def derivatives(ax: Axes, rows: Rows, estimates: Rows) -> None:
    """Draw the growing derivative of one motion over the window, and the ensemble's slope."""
    window = column(rows, "window_mesh_periods")
    by_angle = np.abs(column(rows, "mean_force_by_pressure_angle_N_per_deg"))
    ax.semilogy(window, by_angle, "-", color=VERMILION, label="one motion, differentiated")
    slope, error = (estimates[-1][k] for k in ("gradient_N_per_deg", "standard_error_N_per_deg"))
    ax.axhline(abs(slope), color=BLUE, label=f"ensemble: {slope:.1f} ± {error:.1f} N/deg")
    ax.set(xlabel="window (mesh periods)", ylabel="|d mean force / d pressure angle| (N/deg)")
    ax.set_title("(b) Derivative at the baseline")
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
    last = number[-1] + 2
    verified = [("baseline, verified", result.baseline, BLACK, "s")]
    verified += [("optimum, verified", result.optimized, GREEN, "D")] if result.optimized else []
    for offset, (label, one, color, mark) in enumerate(verified):
        ax.errorbar([last + offset], [problem.objective(one)],
                   [standard_error(problem, one)], fmt=mark, color=color, ms=7, capsize=3,
                   label=label)  # fmt: skip
    ax.axhline(1, color=BLACK, lw=0.8, ls=":")
    ax.set(xlabel="evaluation", ylabel="objective (baseline = 1)")
    ax.set_ylim(0, None)
    ax.set_title("(c) Optimisation of the ensemble's average")
    ax.legend(frameon=False, ncols=2, loc="lower left")


def standard_errors(ax: Axes, members: Rows, estimates: Rows) -> None:
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
        errors = column(chosen, "standard_error_N_per_deg")
        said = f"gradient (N/deg): {label}"
        ax.loglog(motions, errors, mark, color=color, ms=5, lw=1, label=said)
        ax.loglog(motions, errors[0] * np.sqrt(motions[0] / motions), ":", color="0.4", lw=1)
    ax.set(
        xlabel="motions: members, or designs × members", ylabel="standard error of the mean force"
    )
    ax.set_ylim(0.3, None)
    ax.set_title("(d) Standard error of average and gradient")
    ax.legend(frameon=False)
