"""`rootsopt optimize`: search for the best design, and write its files and figures."""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from rootsopt.commands import cli
from rootsopt.commands.work.searching import nothing_known, progress_bar, searched
from rootsopt.config.families import family_of
from rootsopt.config.reading import Config
from rootsopt.measured import conjugacy
from rootsopt.optimize import noise
from rootsopt.optimize.design import search_of
from rootsopt.optimize.outcome import Optimization
from rootsopt.pump.sheet import check_clearances, record_of
from rootsopt.response.result import Evaluation
from rootsopt.response.sensitivity import touching
from rootsopt.scene.build import Scene
from rootsopt.scene.check import check_geometry, outline_mm
from rootsopt.scene.resemblance import likenesses
from rootsopt.view import files
from rootsopt.view.figures import chosen
from rootsopt.view.runs import RunFolder


def body(
    config: Config,
    options: argparse.Namespace,
    folder: RunFolder,
    further: Callable[[Optimization], dict[str, Any]] = lambda result: {},
) -> cli.Outcome:
    """Run `rootsopt optimize`: search for the best design, and write files into `folder`.

    `further`: returns further entries of the result file, for other commands that search. Return
    the `Outcome`. Raises `InputError` if the config or an option is invalid."""
    began = time.perf_counter()
    formats = chosen(options.export)
    check_geometry(config)
    check_clearances(config)
    bar = progress_bar("baseline, compiling", "optimising", "designs", "best objective")
    result, compiled = searched(
        "optimize", config, options, folder, search_of, bar, "the best design so far"
    )
    if result is None:
        empty = {"baseline": None, "optimized": None}
        return nothing_known(folder, "simulated", empty)
    if result.infeasible is not None:
        return cli.Outcome(False, _contradiction(result))
    ran = time.perf_counter() - began
    alike = {} if result.interrupted else _alike(config, result)
    alike |= further(result)
    data = _write(folder, config, options, result, alike, compiled, ran)
    if result.optimized is not None and formats:
        from rootsopt.view.figures.writing import write_simulated

        write_simulated(folder, _searching(config, result), formats, result.optimized)
    total = time.perf_counter() - began
    lines = [] if result.beginning is None else conjugacy.notes(config)
    lines.append(
        f"compile {compiled:.1f} s, run {ran - compiled:.1f} s, reports {total - ran:.1f} s"
    )
    return cli.Outcome(result.optimized is not None and not result.interrupted, data, lines)


def _contradiction(result) -> dict[str, Any]:
    """Return the content of the result file if no design satisfies all constraints."""
    conflict, beginning = result.infeasible, result.beginning
    return {
        "baseline": result.baseline.record(),
        "optimized": None,
        "status": result.status.label,
        "message": conflict.message,
        "infeasible": conflict.record(),
    } | ({} if beginning is None else {"beginning": beginning.record()})


def _alike(config: Config, result) -> dict:
    """Return {"resembles": classical profiles nearest to the optimised one, one row per family}.

    Return {} if the optimised family is classical itself, or if there is no optimised design."""
    config = _searching(config, result)
    if family_of(config.profile.family).classical or result.optimized is None:
        return {}

    design = list(result.optimized.design.values())
    nearest = likenesses(Scene.from_config(config).profile(jnp.asarray(design)))
    return {"resembles": [one.record() for one in nearest]}


def _designs(config: Config, result) -> dict[str, tuple[Config, Evaluation]]:
    """Return (config, evaluation) of the designs of a search by name.

    These are the baseline, the optimised design and the nominal member of a measured baseline, if
    there are such."""
    searching = _searching(config, result)
    others = {"optimized": result.optimized, "nominal": result.nominal}
    known = {name: (searching, one) for name, one in others.items() if one is not None}
    return {"baseline": (config, result.baseline)} | known


def _searching(config: Config, result) -> Config:
    """Return the config of the designs that the search varied.

    It is `config` itself, unless the baseline's profile is from a file."""
    return config if result.beginning is None else result.beginning.config


def _said(result) -> str:
    """Return a result's message, without the cost of limits that the baseline violates."""
    if result.interrupted:
        return _interrupted(result)
    if not result.baseline.usable:
        return f"baseline: {result.baseline.message}"
    if result.optimality is not None and not result.optimality.converged:
        return result.optimality.message
    if result.optimized is not None:
        return result.optimized.message
    if message := noise.message(result.verification):
        return message
    if result.verification.get("rejected"):
        return (
            "No better design held up when simulated again from rest at the tight tolerance. "
            "Raise optimizer.iterations or optimizer.screening, or tighten solver.accuracy."
        )
    return result.status.value


def _interrupted(result) -> str:
    """Return one or two sentences on what an interrupted search has achieved."""
    count = len(result.history)
    begin = f"The search was stopped after {count} design{'s' if count != 1 else ''}"
    if not result.baseline.usable:
        return f"{begin}, and the baseline cannot be used: {result.baseline.message}"
    if result.optimized is None:
        return f"{begin}; none of them is known to be feasible and better than the baseline."
    if result.verification["holds_up"]:
        return f"{begin}. The best of them, simulated again from rest, is reported."
    return (
        f"{begin}. The best of them is reported as the search found it: it was not simulated again "
        "from rest at the config's tolerance."
    )


def _write(folder, config, options, result, alike, compiled, ran) -> dict[str, Any]:
    """Write the files of a search; return the content of the result file."""
    searching = _searching(config, result)
    if result.optimized is not None:
        folder.write_text("optimized.yaml", _designed(searching, result.optimized).to_yaml())
    if result.robustness is not None:
        _write_robustness(folder, config, options, result.robustness)
    data: dict = {"baseline": None, "optimized": None}
    for name, (own, one) in _designs(config, result).items():
        design = [*one.design.values()]
        data[name] = one.record() | {"pump": record_of(own, design)}
        points = outline_mm(own, design)
        folder.write_csv(f"profile_{name}.csv", files.profile_columns(points))
        if one.series is not None:
            folder.write_csv(f"response_{name}.csv", files.response_columns(one.series))
    rows = result.history
    if rows:
        folder.write_csv("history.csv", {key: [row[key] for row in rows] for key in rows[0]})
    data |= alike
    if result.beginning is not None:
        data["beginning"] = result.beginning.record()
        data |= conjugacy.record(config)
    data["improvement"] = result.improvement
    if result.nominal is not None:
        data["improvement_over_nominal"] = result.improvement_over_nominal
    data["constraints"] = result.constraints
    if config.objective.speeds_rpm and result.optimized is not None:
        data["objective_by_speed"] = result.objective_by_speed
    if result.optimality is not None:
        data["optimality"] = result.optimality.record()
        if (vertex := result.optimality.vertex) is not None and vertex.keys:
            folder.write_csv("feasible.csv", vertex.columns())
    if result.robustness is not None:
        data["robustness"] = result.robustness.record()
        if result.optimized is not None and config.tolerances is not None:
            data["touching"] = touching(_designed(searching, result.optimized))
    if result.assumptions is not None:
        data["assumptions"] = result.assumptions.record()
        folder.write_csv("assumptions.csv", result.assumptions.columns())
    data["verification"] = result.verification
    # Entries that `improve` adds, such as its own status, take precedence.
    message = f"{result.cost} {_said(result)}".strip()
    data = {"status": result.status.label, "message": message} | data
    data["statistics"] = {
        "evaluations": len(rows),
        "compile_seconds": compiled,
        "run_seconds": ran - compiled,
    }
    if not options.no_figures:
        _draw(folder, config, result, data)
    return data


def _draw(folder, config: Config, result, data: dict) -> None:
    """Write the figures of a search; `data`: content of the result file."""
    from rootsopt.view.figures import comparisons, runs, sweep

    if result.optimized is not None:
        pair, rows = (result.baseline, result.optimized), result.history
        given = None if result.beginning is None else config
        runs.optimization_figures(folder, *pair, rows, _searching(config, result), given)
        vertex = None if result.optimality is None else result.optimality.vertex
        if vertex is not None and vertex.keys:
            design = data["optimized"]["design"]
            runs.feasible_figure(folder, vertex.columns(), design, data["optimality"]["vertex"])
    else:
        runs.simulation_figures(folder, result.baseline, config)
    if config.objective.speeds_rpm:
        names = {"baseline": result.baseline, "optimised": result.optimized}
        designs = {name: one.speeds for name, one in names.items() if one is not None}
        sweep.speed_figure(folder, designs, "Contact force over the speeds of the objective")
    if result.assumptions is not None:
        comparisons.spread_figure(folder, data["assumptions"], result.assumptions.columns())


def _designed(config: Config, evaluation) -> Config:
    """Return `config` with the design of an `evaluation`."""
    return config.with_design([*evaluation.design.values()])


def _write_robustness(folder, config, options, robustness) -> None:
    """Write the nominal optimum, and the files of the comparison over fresh scenes."""
    nominal = robustness.nominal.optimized
    if nominal is not None:
        folder.write_text("nominal.yaml", _designed(config, nominal).to_yaml())
    if not robustness.fresh:
        return
    columns = dict(robustness.scenes)
    for name, one in robustness.fresh.items():
        columns |= {f"{name}_{key}": values for key, values in one.values.items()}
    folder.write_csv("tolerances.csv", columns)
    if not options.no_figures:
        from rootsopt.view.figures.comparisons import distributions

        designs = {name: one.values for name, one in robustness.fresh.items()}
        count = len(next(iter(robustness.scenes.values())))
        made = distributions(designs, f"Contact force in {count} fresh scenes")
        folder.write_figure("figures/tolerances.png", made)
