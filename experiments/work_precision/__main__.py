"""What does accuracy cost in run time?

Writes work_precision.csv, work_precision.json, work_precision.png (contacts and solvers) and
work_precision_orbits.png (ways to close orbits).
"""

import sys

from experiments._common.driver import OK, Run, drive

FIGURES = {
    "work_precision.png": "work_precision.png",
    "work_precision_orbits.png": "work_precision_orbits.png",
}


def body(run: Run) -> int:
    """Measure errors and times, write results, print the table."""
    from experiments._common.tables import show
    from experiments.work_precision import figures, study

    results = study.run(run.quick, run.say)
    run.csv("work_precision.csv", results.rows)
    summary = {
        "references": {
            scene: {"response": r.found.response, "gradient": r.found.gradient, "error": r.error}
            for scene, r in results.references.items()
        },
        "compile_seconds": results.compile_seconds,
        "quick": run.quick,
    }
    run.json("work_precision.json", summary)
    for name, titles in zip(FIGURES, (figures.TITLES, figures.CLOSED), strict=True):
        if figures.panels_of(results, titles):
            run.figure(name, figures.errors(results, titles))
    show("Work and precision", results.rows)
    left_out = [row for row in results.rows if row["status"] != "periodic"]
    total = len(results.rows)
    print(f"{len(left_out)} of {total} runs are left out of the curves; see `status`")
    return OK


def main() -> int:
    """Run the study."""
    return drive(
        "work_precision",
        __doc__,
        body,
        quick="one program and few tolerances",
        published=FIGURES,
    )


if __name__ == "__main__":
    sys.exit(main())
