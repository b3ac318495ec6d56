"""What can be optimised where the motion is chaotic?

    python experiments/chaos.py [-o DIR] [--quick]

In a scene that is chaotic at the baseline and at the optimum: (a) the average of a single
motion along a line of designs, against the average over an ensemble; (b) the derivative of a
single motion's average, against the slope estimated from an ensemble; (c) an optimisation
of the ensemble's average, and its verification by independent ensembles; (d) how the
standard errors fall with the members, and whether the scatter is what they say. Writes
chaos_line.csv, chaos_pathwise.csv, chaos_history.csv, chaos_members.csv,
chaos_gradients.csv, chaos.json and chaos.png.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

from rootsopt.cli import use_cache, use_float64

use_float64()
use_cache()

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax import lax  # noqa: E402
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from rootsopt import files  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.dynamics.flow import flow  # noqa: E402
from rootsopt.ensemble import ERRORS, EnsembleEvaluator  # noqa: E402
from rootsopt.members import run_members  # noqa: E402
from rootsopt.model import Model  # noqa: E402
from rootsopt.optimize.noise import standard_error  # noqa: E402
from rootsopt.optimize.problem import Problem  # noqa: E402
from rootsopt.optimize.search import Optimization, Search  # noqa: E402
from rootsopt.programs import Program  # noqa: E402

BLUE, VERMILION, GREEN, PURPLE, BLACK = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "black"
SCENE = (
    "scene.load.torque_N_m=1",
    "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.1, backlash_mm: 0.4}",
    "objective.motion=ensemble",
)
FULL = (
    "solver.fidelity=map",
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
    """Members and mesh periods of the studies beside the optimisation; `slopes`: designs and
    members of each gradient."""

    line: int
    members: int
    window: int
    pathwise: int
    large: int
    groups: tuple[int, ...]
    slopes: tuple[tuple[int, int], ...]


def _slopes(designs: int, members: int, count: int) -> tuple[tuple[int, int], ...]:
    """(designs, members) of gradients: more members, then more designs, each time twice as
    many."""
    more = [(designs, members * 2**k) for k in range(count)]
    return (*more, *((designs * 2**k, members) for k in range(1, count)))


SIZES = {
    False: Size(25, 32, 128, 96, 512, (4, 8, 16, 32, 64), _slopes(16, 4, 4)),
    True: Size(3, 4, 8, 8, 16, (4, 8), _slopes(8, 4, 1)),
}


def resized(config: Config, model: Model, **changes) -> EnsembleEvaluator:
    """An evaluator without gradients for an ensemble of another size."""
    ensemble = config.ensemble.model_copy(update=changes)
    evaluator = EnsembleEvaluator(config.model_copy(update={"ensemble": ensemble}), survey=True)
    evaluator.model, evaluator.fitted, evaluator.prepared = model, True, True
    evaluator.differentiate = False
    return evaluator


def line(config: Config, model: Model, designs: np.ndarray, size: Size) -> list[dict]:
    """Averages along a line of designs: of the motion from rest, and of an ensemble."""
    evaluator = resized(config, model, members=size.members, periods=size.window)
    settle = config.ensemble.settle_periods
    rest = np.zeros((1, 2))
    rows = []
    for share, design in zip(np.linspace(0, 1, len(designs)), designs, strict=True):
        evaluation = evaluator(jnp.asarray(design), series=False)
        pair = _pair(evaluator.model, jnp.asarray(design))
        (single,) = run_members([pair], rest, settle, size.window, evaluator.how)
        row = {"share": share, **evaluation.design, "single_mean_force_N": single.means[0, 0]}
        for name in ("mean_force_N", "peak_force_N"):
            row[name] = evaluation.response.get(name, np.nan)
            row[ERRORS[name]] = evaluation.steady_state.get(ERRORS[name], np.nan)
        rows.append(row)
    return rows


_pair = Program(Model.pair)


@Program
def _pathwise(model: Model, design, periods, how):
    """Derivative of the mean force from the motion's begin to the end of each mesh period by
    the design, along the single motion from rest."""
    pair, tangents, _ = model.pair_and_tangents(design)

    def step(carry, _):
        state, moved = carry
        out = flow(pair, state, jnp.ones(()), how, 63, tangents)
        slope, along = out.slope[:, :2], out.slope[:, 2:]
        every = slope @ moved + along
        return (out.end, every[:2]), every[2]

    start = jnp.zeros(2), jnp.zeros((2, design.shape[0]))
    _, by_design = lax.scan(step, start, length=periods)
    return jnp.cumsum(by_design, axis=0) / (1 + jnp.arange(periods))[:, None]


def pathwise(evaluator: EnsembleEvaluator, design, size: Size) -> list[dict]:
    """Growth of the single motion's derivative with the window."""
    slopes = np.asarray(
        _pathwise(evaluator.model, jnp.asarray(design), size.pathwise, evaluator.how)
    )
    return [
        {"window_mesh_periods": n, "mean_force_by_pressure_angle_N_per_deg": slope}
        for n, slope in enumerate(slopes[:, 0], 1)
    ]


def errors_by_members(config: Config, model: Model, design, size: Size) -> list[dict]:
    """Stated standard error of the mean force, and the scatter of independent groups of
    members, taken from one large ensemble, with the standard error of that scatter."""
    evaluator = resized(config, model, members=size.large)
    design = jnp.asarray(design)
    start = evaluator(design, series=False)
    pair = _pair(evaluator.model, design)
    (large,) = run_members([pair], start.state, 0, config.ensemble.periods, evaluator.how)  # pyright: ignore[reportArgumentType]
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


def gradients(config: Config, model: Model, design, size: Size) -> list[dict]:
    """Gradient of the mean force by the pressure angle with its stated standard error, from
    more members or from more designs."""
    rows = []
    for designs, members in size.slopes:
        evaluator = resized(config, model, members=members, designs=designs)
        evaluator.differentiate = True
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
    """Baseline and optimum, by the verifying ensemble, and how significant their difference is."""
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


def draw(along, slopes, members, estimates, problem: Problem, result: Optimization) -> Figure:
    """The four panels."""
    figure = Figure(figsize=(12.5, 9), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    (a, b), (c, d) = figure.subplots(2, 2)

    def column(rows, key):
        return np.array([np.nan if row[key] is None else row[key] for row in rows], float)

    share = column(along, "share")
    a.plot(share, column(along, "single_mean_force_N"), ".-", color=VERMILION, lw=0.8,
           label="one motion from rest")  # fmt: skip
    a.errorbar(share, column(along, "mean_force_N"), column(along, ERRORS["mean_force_N"]), fmt="o",
               color=BLUE, ms=4, capsize=2, label="ensemble, ± standard error")  # fmt: skip
    a.set(xlabel="share of the way from baseline to optimum", ylabel="mean contact force (N)")
    a.set_ylim(0, None)
    a.set_title("(a) Average along a line of designs")
    a.legend(frameon=False)

    window = column(slopes, "window_mesh_periods")
    by_angle = np.abs(column(slopes, "mean_force_by_pressure_angle_N_per_deg"))
    b.semilogy(window, by_angle, "-", color=VERMILION, label="one motion, differentiated")
    slope, error = (estimates[-1][k] for k in ("gradient_N_per_deg", "standard_error_N_per_deg"))
    b.axhline(abs(slope), color=BLUE, label=f"ensemble: {slope:.1f} ± {error:.1f} N/deg")
    b.set(xlabel="window (mesh periods)", ylabel="|d mean force / d pressure angle| (N/deg)")
    b.set_title("(b) Derivative at the baseline")
    b.legend(frameon=False)

    rows = result.history
    number, objective = column(rows, "evaluation"), column(rows, "objective")
    error = column(rows, "objective_standard_error")
    screened = column(rows, "start") < 0
    for chosen, color, label in ((screened, "0.55", "screening"), (~screened, BLUE, "descent")):
        c.errorbar(number[chosen], objective[chosen], error[chosen], fmt="o", color=color, ms=4,
                   capsize=2, label=f"{label}, ± standard error")  # fmt: skip
    last = number[-1] + 2
    verified = [("baseline, verified", result.baseline, BLACK, "s")]
    verified += [("optimum, verified", result.optimized, GREEN, "D")] if result.optimized else []
    for offset, (label, one, color, mark) in enumerate(verified):
        c.errorbar([last + offset], [problem.objective(one)],
                   [standard_error(problem, one)], fmt=mark, color=color, ms=7, capsize=3,
                   label=label)  # fmt: skip
    c.axhline(1, color=BLACK, lw=0.8, ls=":")
    c.set(xlabel="evaluation", ylabel="objective (baseline = 1)")
    c.set_ylim(0, None)
    c.set_title("(c) Optimisation of the ensemble's average")
    c.legend(frameon=False, ncols=2, loc="lower left")

    count = column(members, "members")
    stated = column(members, "stated_standard_error_N")
    d.loglog(count, stated, "o", color=BLUE, label="stated standard error (N)")
    d.errorbar(1.04 * count, column(members, "scatter_of_groups_N"),
               column(members, "error_of_scatter_N"), fmt="x", color=VERMILION, ms=7, capsize=2,
               label="scatter of independent groups (N)")  # fmt: skip
    d.loglog(count, stated[0] * np.sqrt(count[0] / count), ":", color="0.4", lw=1,
             label="∝ 1/√(motions)")  # fmt: skip
    least = estimates[0]["designs"]
    for chosen, mark, color, label in (
        ([e for e in estimates if e["designs"] == least], "s-", GREEN, "more members each"),
        ([e for e in estimates if e["members"] == estimates[0]["members"]], "D--", PURPLE,
         "more designs"),
    ):  # fmt: skip
        motions = column(chosen, "designs") * column(chosen, "members")
        errors = column(chosen, "standard_error_N_per_deg")
        d.loglog(motions, errors, mark, color=color, ms=5, lw=1, label=f"gradient (N/deg): {label}")
        d.loglog(motions, errors[0] * np.sqrt(motions[0] / motions), ":", color="0.4", lw=1)
    d.set(
        xlabel="motions: members, or designs × members", ylabel="standard error of the mean force"
    )
    d.set_ylim(0.3, None)
    d.set_title("(d) Standard error of average and gradient")
    d.legend(frameon=False)
    for ax in (a, b, c, d):
        ax.grid(color="0.92", linewidth=0.6)
        ax.set_axisbelow(True)
    return figure


def main() -> int:
    arguments = argparse.ArgumentParser(description="What can be optimised in a chaotic scene.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/chaos"))
    arguments.add_argument("--quick", action="store_true", help="few members, short windows")
    options = arguments.parse_args()
    folder = files.ResultFolder(options.output)
    size, began = SIZES[options.quick], time.perf_counter()
    config = load("configs/cic.yaml", [*SCENE, *(QUICK if options.quick else FULL)])
    search = Search(config)
    result = search.run()
    seconds = {"optimization": time.perf_counter() - began}
    problem = result.problem
    if problem is None or not result.baseline.usable:
        print(f"baseline {result.baseline.status.label}", file=sys.stderr)
        return 3
    model = search.exact.model
    first = problem.point(list(result.baseline.design.values()))
    # Without a significant optimum (as in a quick run) the line leads to the last design.
    end = list((result.optimized or result.baseline).design.values())
    if result.optimized is None:
        end = [result.history[-1][key] for key in result.baseline.design]
    shares = np.linspace(0, 1, size.line)[:, None]
    points = (1 - shares) * first + shares * problem.point(end)
    designs = np.array([problem.design(point) for point in points])
    began = time.perf_counter()
    along = line(config, model, designs, size)
    seconds["line"] = time.perf_counter() - began
    began = time.perf_counter()
    slopes = pathwise(resized(config, model), designs[0], size)
    seconds["pathwise"] = time.perf_counter() - began
    began = time.perf_counter()
    members = errors_by_members(config, model, designs[0], size)
    seconds["members"] = time.perf_counter() - began
    began = time.perf_counter()
    estimates = gradients(config, model, designs[0], size)
    seconds["gradients"] = time.perf_counter() - began
    for name, rows in (
        ("line", along), ("pathwise", slopes), ("history", result.history), ("members", members),
        ("gradients", estimates),
    ):  # fmt: skip
        folder.write_csv(f"chaos_{name}.csv", files.row_columns(rows))
    found = summary(problem, result) | {
        "scene": list(SCENE),
        "ensemble": config.ensemble.model_dump(),
        "seconds": seconds,
        "versions": files.versions(),
    }
    folder.write_json("chaos.json", found)
    folder.write_figure("chaos.png", draw(along, slopes, members, estimates, problem, result))
    for key, value in found.items():
        print(f"{key}: {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
