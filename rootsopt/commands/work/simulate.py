"""`rootsopt simulate`: simulate one design, and write its motion, forces and figures."""

import argparse

from rootsopt.commands import cli
from rootsopt.config.reading import Config
from rootsopt.measured import conjugacy
from rootsopt.pump.sheet import check_clearances, record_of
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import alone
from rootsopt.response.sensitivity import touching
from rootsopt.scene.check import check_geometry, outline_mm
from rootsopt.view import files, tables
from rootsopt.view.figures import chosen
from rootsopt.view.runs import RunFolder


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt simulate`: simulate the design, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if the config or an option is invalid."""
    formats = chosen(options.export)
    check_geometry(config)
    check_clearances(config)
    with cli.waiting("compiling and simulating"):
        evaluation = Evaluator.of_objective(alone(config))()
    folder.write_csv("profile_design.csv", files.profile_columns(outline_mm(config)))
    if evaluation.series is not None:
        folder.write_csv("response_design.csv", files.response_columns(evaluation.series))
    data = evaluation.record() | conjugacy.record(config)
    if config.pump is not None or config.scene.bearings is not None:
        data["pump"] = record_of(config, [*evaluation.design.values()])
    if config.tolerances is not None and (scattered := touching(config)) is not None:
        data["touching"] = scattered
    if formats:
        from rootsopt.view.figures.writing import write_simulated

        write_simulated(folder, config, formats, evaluation)
    if not options.no_figures:
        from rootsopt.view.figures import runs

        runs.simulation_figures(folder, evaluation, config)
    shown = [*tables.tables_of(data), tables.effort_table(data)]
    return cli.Outcome(evaluation.usable, data, conjugacy.notes(config), tables=shown)
