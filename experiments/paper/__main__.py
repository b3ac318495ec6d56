"""Which scene gives the paper's contact forces, and how far do they determine it?

Writes paper.csv, paper_motions.csv, paper_definitions.csv, paper_slices.csv, paper_profile.csv,
paper.json, paper_force.png, paper_spectrum.png and paper_uniqueness.png. With --search, it searches
for further scenes instead, and writes paper_search.csv, paper_search.json and paper_search.png. The
exit code is then 3 if no such scene is found. Results: docs/paper.md.
"""

import argparse
import sys
from typing import TYPE_CHECKING, Any

from experiments._common.driver import OK, Run, drive, verdict

if TYPE_CHECKING:
    from experiments.paper.scene import Response

FIGURES = {
    f"paper_{name}.png": f"paper_{name}.png"
    for name in ("force", "spectrum", "uniqueness", "search")
}


def print_forces(name: str, found: "Response") -> None:
    """Print values, forces and errors of a response, under the title `name`."""
    from experiments.paper.scene import FAMILIES, FORCES

    print(f"{name}: misfit {found.misfit:.2%}, values {[float(f'{v:.5g}') for v in found.values]}")
    for family, one, row, errors, period in zip(
        FAMILIES, found.evaluations, found.forces, found.errors, found.periods, strict=True
    ):
        multiplier = one.steady_state.get("floquet_multiplier")
        print(
            f"  {family:4}{one.status.label}, period {period}, multiplier {multiplier}: "
            + ", ".join(
                f"{key} {value:.1f} ({error:+.2%})"
                for key, value, error in zip(FORCES, row, errors, strict=True)
            )
        )


def reproduce(run: Run) -> int:
    """Simulate the values in the shipped configs, write results, print them."""
    import numpy as np

    from experiments.paper import figures, study
    from experiments.paper.scene import FAMILIES, summary

    results = study.run(run.quick, run.say, print_forces)
    found = results.shipped
    run.csv("paper.csv", [study.row_of(found)])
    for name, made in zip(("force", "spectrum"), figures.force_figures(found), strict=True):
        run.figure(f"paper_{name}.png", made)
    record: dict[str, Any] = {"shipped": summary(found)}
    if found.slopes is not None:
        record["slopes"] = dict(zip(FAMILIES, found.slopes, strict=True))
        singular = np.linalg.svd(found.slopes.reshape(4, -1))
        record |= {"singular_values": singular[1], "free_directions": singular[2][4:]}
    record |= {name: summary(other) for name, other in results.others.items()}
    for name, rows in results.tables.items():
        run.csv(f"paper_{name}.csv", rows)
    made = figures.uniqueness_figure(results.alone, results.solved)
    run.figure("paper_uniqueness.png", made)
    run.json("paper.json", record | {"seconds": run.seconds})
    return OK


def search(run: Run) -> int:
    """Search for values of the quantities, write results, print the best values."""
    from experiments.paper import figures, study
    from experiments.paper.scene import FAMILIES, FORCES, QUANTITIES, summary

    options, lowest = run.options, QUANTITIES[-1].low
    least = lowest if options.least_clearance is None else options.least_clearance
    found = study.look(run.quick, options.seed, least, run.say)
    columns: dict[str, Any] = {q.key: found.values[:, k] for k, q in enumerate(QUANTITIES)}
    for k, family in enumerate(FAMILIES):
        columns |= {f"{family}_{name}": found.forces[:, k, j] for j, name in enumerate(FORCES)}
        columns[f"{family}_period"] = found.periods[:, k]
    run.folder.write_csv("paper_search.csv", columns | {"misfit": found.misfits})
    run.figure("paper_search.png", figures.search_figure(found))
    record: dict[str, Any] = {}
    for periods, (searched, response) in found.polished.items():
        print_forces(f"periods {periods}, searched to {searched:.1%}", response)
        record[f"periods {periods}"] = summary(response) | {"searched_misfit": searched}
    record |= {
        "scenes": len(found.values),
        "seed": options.seed,
        "least_clearance_mm": least,
        "least_searched_misfit": found.misfits.min(),
        "search_seconds": found.seconds,
        "seconds": run.seconds,
    }
    run.json("paper_search.json", record)
    if not (run.quick or found.enough):
        run.say(f"nothing within {study.TARGET:.0%} found; try another --seed")
    return verdict(run.quick or found.enough)


def body(run: Run) -> int:
    """Simulate the shipped values or, with --search, search for other values."""
    return search(run) if run.options.search else reproduce(run)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options for the search and its settings."""
    parser.add_argument("--search", action="store_true", help="search for other values")
    parser.add_argument("--seed", type=int, default=0, help="seed of the search (default: 0)")
    parser.add_argument(
        "--least-clearance", type=float, metavar="MM", help="smallest flank clearance searched"
    )


def main() -> int:
    """Run the study."""
    return drive(
        "paper",
        __doc__,
        body,
        quick="linear contact, each quantity changed twice; one generation of a search",
        published=FIGURES,
        add_options=add_options,
        cache=True,
    )


if __name__ == "__main__":
    sys.exit(main())
