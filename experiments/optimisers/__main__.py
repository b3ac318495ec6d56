"""Which optimisation method reaches the optimum with the fewest simulated designs?

Writes optimisers.csv (a row per evaluation), optimisers.json (evaluations and time to 1e-6, by
problem and method) and optimisers.png. The exit code is 3 unless the package's own method solves at
least as many problems as any other.
"""

import sys

from experiments._common.driver import Run, drive, verdict

FIGURES = {"optimisers.png": "optimisers.png"}


def body(run: Run) -> int:
    """Run all methods on all problems, write, print the summary."""
    from experiments._common.tables import show
    from experiments.optimisers import figures, study

    results = study.run(run.quick, say=run.say)
    rows, reached = results.summary(), results.reached()
    run.csv("optimisers.csv", results.rows)
    run.json("optimisers.json", {"summary": rows, "solved": reached, "missing": results.missing})
    run.figure("optimisers.png", figures.solved(results))
    show("Evaluations and time to the optimum", rows)
    return verdict(run.quick or reached["slsqp"] >= max(reached.values()))


def main() -> int:
    """Run the study."""
    return drive(
        "optimisers",
        __doc__,
        body,
        quick="two problems, 15 designs per method",
        published=FIGURES,
    )


if __name__ == "__main__":
    sys.exit(main())
