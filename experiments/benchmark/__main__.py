"""How fast is rootsopt compared with SciPy and Numba, and how much memory does it need?

Writes benchmark.csv, benchmark.json and benchmark.png, and ends with the table of targets.
"""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from experiments._common.driver import OK, Run, drive

if TYPE_CHECKING:
    from experiments.benchmark.study import Parts

FIGURES = {"benchmark.png": "benchmark.png"}
COLUMNS = (
    "part",
    "tool",
    "what",
    "designs",
    "per_design_ms",
    "run_s",
    "build_s",
    "compile_s",
    "value_error",
    "gradient_error",
    "peak_memory_MB",
    "settings",
    "note",
)


def body(run: Run) -> int:
    """Run all parts, write results and print tables; with --part, run one part in this process."""
    from experiments.benchmark import study

    options = run.options
    if options.part is not None:
        known = json.loads(options.known.read_text())
        found = study.run_part(options.part, run.quick, options.size, known)
        run.folder.write_json(study.RESULT, found)
        return OK
    report(run, study.run(run.quick, options.gpu, run.say))
    return OK


def report(run: Run, parts: "Parts") -> None:
    """Write and print the findings of all parts."""
    from experiments._common.tables import show
    from experiments.benchmark import figures
    from experiments.benchmark.targets import targets

    goals = targets(parts.rows)
    # Columns in their usual order; those that only some rows have come last.
    keys = dict.fromkeys([*COLUMNS, *(key for one in parts.rows for key in one)])
    run.csv("benchmark.csv", parts.rows, keys)
    run.json(
        "benchmark.json",
        {
            "rows": parts.rows,
            "targets": goals,
            "not_measured": parts.failed,
            "reference": parts.known,
            "quick": run.quick,
            "processors": os.cpu_count(),
        },
    )
    run.figure("benchmark.png", figures.figure_of(parts.rows))
    show("Benchmark", parts.rows, COLUMNS)
    for name, reason in parts.failed.items():
        print(f"not measured: {name}: {reason}")
    show("Targets", goals)
    print(f"{run.seconds:.0f} s; written to {run.folder.path}")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the GPU option, and the options that the study passes to the processes of its parts."""
    parser.add_argument("--gpu", action="store_true", help="large batches on a GPU as well")
    inner = parser.add_argument_group("used by the study itself, for one part's process")
    inner.add_argument("--part", metavar="NAME")
    inner.add_argument("--size", type=int, default=0)
    inner.add_argument("--known", type=Path, metavar="FILE")


def main() -> int:
    """Run the study."""
    return drive(
        "benchmark",
        __doc__,
        body,
        quick="small sizes",
        published=FIGURES,
        add_options=add_options,
        precision=False,
    )


if __name__ == "__main__":
    sys.exit(main())
