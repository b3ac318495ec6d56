"""`python -m tests.reference [NAME ...]`: store the package's results of the cases.

`pytest tests/studies/test_reference.py` compares the present results with those stored."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from tests.reference import package
from tests.reference.cases import CASES, Case
from tests.reference.compare import ChangedError, differences, limits

FILE = Path(__file__).with_name("reference.json")
"""The file of stored results."""
# Relative changes of the speed that represent rounding.
_NUDGES = (1e-13, -1e-13, 3e-13, -3e-13)


def read() -> dict[str, dict[str, Any]]:
    return json.loads(FILE.read_text())["results"] if FILE.exists() else {}


def write(results: dict[str, dict[str, Any]]) -> None:
    """Store results: numbers with all their digits, a line for each case."""
    head = {"call": package.CALL, "versions": package.versions()}
    body = ",\n".join(f"{json.dumps(name)}: {json.dumps(one)}" for name, one in results.items())
    FILE.write_text(f'{json.dumps(head)[:-1]},\n"results": {{\n{body}\n}}}}\n')


def result_of(case: Case) -> dict[str, Any]:
    """Return the package's result of a case, and how far rounding changes it."""
    found = package.evaluate(case.config, case.overrides)
    rounding: dict[str, float] = {}
    for nudge in _NUDGES if case.nudged else ():
        moved = differences(package.evaluate(case.config, case.overrides, nudge), found)
        rounding = {name: max(rounding.get(name, 0.0), off) for name, off in moved.items()}
    return {"config": case.config, "overrides": case.overrides, **found, "rounding": rounding}


def check(case: Case, results: dict[str, Any]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the differences of a case from its stored result, and those allowed.

    Raises `ChangedError`."""
    result = results[case.name]
    if (case.config, case.overrides) != (result["config"], result["overrides"]):
        raise ChangedError("the case itself; store it again by its name")
    return differences(package.evaluate(case.config, case.overrides), result), limits(result)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.reference", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases whose name begins so")
    parser.add_argument("--missing", action="store_true", help="only cases without a stored result")
    options = parser.parse_args()
    package.start()
    results, failed = read(), 0
    for case in CASES:
        known = options.missing and case.name in results
        if known or not case.name.startswith(tuple(options.names) or ""):
            continue
        try:
            results[case.name] = found = result_of(case)
        except ChangedError as error:
            print(f"{case.name}: NOT STORED, as it depends on rounding: {error}", flush=True)
            failed += 1
            continue
        print(f"{case.name}: {found['status']}, by rounding {found['rounding']}", flush=True)
        write({one.name: results[one.name] for one in CASES if one.name in results})
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
