"""`rootsopt attractors`: find the coexisting motions of one scene, and write their files."""

import argparse

import numpy as np

from rootsopt.commands import cli
from rootsopt.config.reading import Config
from rootsopt.response.attractors import find
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.records import message_of
from rootsopt.scene.check import check_geometry
from rootsopt.view import files
from rootsopt.view.runs import RunFolder


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt attractors`: find the coexisting motions, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if the config is invalid."""
    check_geometry(config)
    with cli.waiting("compiling and simulating"):
        basins = find(Evaluator.of(config), series=True)
    rows = [{"attractor": number} | row for number, row in enumerate(basins.summary(), 1)]
    folder.write_csv("attractors.csv", files.row_columns(rows))
    relative, rate = np.meshgrid(1e3 * basins.relative, basins.rate)
    columns = {
        "relative_rotation_mrad": relative.ravel(),
        "relative_speed_rad_s": rate.ravel(),
        # 0: the initial state leads to no reported motion.
        "attractor": basins.leads_to.ravel() + 1,
    }
    folder.write_csv("basins.csv", columns)
    for number, one in enumerate(basins.attractors, 1):
        if one.evaluation.series is not None:
            response = files.response_columns(one.evaluation.series)
            folder.write_csv(f"response_{number}.csv", response)
    if not options.no_figures:
        from rootsopt.view.figures.sweep import basin_figures

        basin_figures(folder, basins, config)

    data = {
        "attractors": basins.records(),
        "lost": basins.lost,
        "status": basins.status.label,
        "message": message_of(config, basins.status),
    }
    return cli.Outcome(any(one.evaluation.usable for one in basins.attractors), data)
