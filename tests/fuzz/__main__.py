"""`python -m tests.fuzz [NAME ...]`: run fuzzing campaigns, each with a time limit.

The exit code is 1 if a case fails, or if a campaign tries fewer cases than requested."""

import argparse
import importlib
import sys

CAMPAIGNS = {
    "configs": 50_000,
    "outlines": 1_000,
    "kills": 300,
    "resumes": 20,
    "environment": 200,
}
"""Number of cases of each campaign; the module `tests.fuzz.NAME` has `run(report, seed)`."""


def main() -> int:
    """Run the named campaigns and print their tables."""
    from tests.fuzz.report import Report

    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(CAMPAIGNS))
    parser.add_argument("--cases", type=int, help="cases of each campaign")
    parser.add_argument("--seconds", type=float, default=1800.0, help="time of each campaign (s)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    unknown = set(options.names) - set(CAMPAIGNS)
    if unknown:
        parser.error(f"no campaign {', '.join(sorted(unknown))}; valid: {', '.join(CAMPAIGNS)}")
    failed = False
    for name in options.names or CAMPAIGNS:
        report = Report(name, options.cases or CAMPAIGNS[name], options.seconds)
        importlib.import_module(f"tests.fuzz.{name}").run(report, options.seed)
        print(report.table(), flush=True)
        failed |= bool(report.failures) or report.total < report.cases
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
