"""Is the optimum that of an exhaustive grid of designs, in five scenes?

Writes landscape.csv (a row per design), landscape.json and landscape.png. The exit code is 3 unless
the optimum is at most 0.1 % above the best of the grids in every scene, and searches with different
seeds of the screening agree within 1e-5.
"""

import argparse
import sys

from experiments._common.driver import Run, drive, verdict

FIGURES = {"landscape.png": "landscape.png"}
SHOWN = (
    "scene",
    "grid_designs",
    "finer_designs",
    "without_steady_state",
    "first_grid_best",
    "grid_best",
    "optimizer",
    "optimizer_over_grid_best",
    "optimizer_designs",
    "certified",
    "optima",
)


def body(run: Run) -> int:
    """Optimise, simulate the grids, write results, print the comparison."""
    from experiments._common.tables import show
    from experiments.landscape import figures, study

    results = study.run(run.quick, run.options.config, run.options.designs, run.say)
    found = [one.record() for one in results]
    run.csv("landscape.csv", [{"scene": one.name, **row} for one in results for row in one.rows])
    seeds = study.by_seed(run.options.config, 2 if run.quick else run.options.seeds, run.quick)
    apart = study.spread(seeds)
    run.json("landscape.json", {"scenes": found, "seeds": seeds, "range_over_seeds": apart})
    run.figure("landscape.png", figures.designs(results))
    rows = [
        {k: f"{v:.6f}" if k in ("grid_best", "optimizer") else v for k, v in one.items()}
        for one in found
    ]
    show("Objective of the best design, baseline = 1", rows, SHOWN)
    for row in seeds:
        row["objective"] = f"{row['objective']:.7f}"
    show(f"Searches with different seeds: relative range {apart:.1e}", seeds)
    same = run.quick or apart <= study.SAME
    return verdict(same and all(one["agrees"] for one in found))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for the config and the size of the grid."""
    parser.add_argument(
        "config", nargs="?", default="configs/cic.yaml", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--designs", type=int, default=400, help="minimum number of designs (default: 400)"
    )
    parser.add_argument(
        "--seeds", type=int, default=10, help="number of seeds of the screening (default: 10)"
    )


def main() -> int:
    """Run the study."""
    return drive(
        "landscape",
        __doc__,
        body,
        quick="one scene, a coarse grid, linear contact, one start",
        published=FIGURES,
        add_options=add_options,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
