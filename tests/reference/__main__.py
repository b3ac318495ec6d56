"""`python -m tests.reference [NAME ...]`: evaluate the cases again and compare with stored results.

Prints the greatest relative difference of each quantity, and the cases in which one is too great.
The exit code is 1 if there is such a case. With --write it writes the results instead."""

import argparse
import sys
import time
from collections.abc import Iterator
from typing import Any

from tests.reference import kept, package
from tests.reference.cases import CASES, Case
from tests.reference.compare import ChangedError, differences, limits

_NUDGES = (1e-13, -1e-13, 3e-13, -3e-13)
"""Relative changes of the speed that represent rounding."""


def result_of(case: Case) -> dict[str, Any]:
    """Return the package's result of a case, and how far rounding changes it."""
    found = package.evaluate(case.config, case.overrides)
    rounding: dict[str, float] = {}
    for nudge in _NUDGES if case.nudged else ():
        moved = differences(package.evaluate(case.config, case.overrides, nudge), found)
        rounding = {name: max(rounding.get(name, 0.0), off) for name, off in moved.items()}
    how = {"config": case.config, "overrides": case.overrides}
    return how | found | {"rounding": rounding}


def written(cases: list[Case]) -> int:
    """Write the results of the cases beside those stored already; return the exit code."""
    results, failed = kept.read(), 0
    for case, said in _in_turn(cases):
        try:
            results[case.name] = result_of(case)
        except ChangedError as error:
            print(f"{said}: NOT KEPT, as it depends on rounding: {error}", flush=True)
            failed += 1
            continue
        found = results[case.name]
        most = {name: f"{off:.1e}" for name, off in found["rounding"].items() if off}
        period = found["steady_state"].get("period", "-")
        print(f"{said}: {found['status']}, period {period}, by rounding {most}", flush=True)
        kept.write({one.name: results[one.name] for one in CASES if one.name in results})
    return int(failed > 0)


def compared(cases: list[Case]) -> int:
    """Evaluate the cases again and print their differences from the stored results.

    Returns the exit code."""
    results, failed, worst = kept.read(), 0, {}
    for case, said in _in_turn(cases):
        try:
            off, allowed = check(case, results)
        except ChangedError as error:
            off, allowed = {}, {}
            failed += 1
            print(f"{said}: FAILED: {error}", flush=True)
            continue
        beyond = {name: f"{x:.1e}" for name, x in off.items() if not x <= allowed[name]}
        failed += bool(beyond)
        print(f"{said}: " + (f"FAILED: {beyond}" if beyond else "as kept"), flush=True)
        for name, x in off.items():
            if allowed[name] < 1e-2:
                worst[name] = max(worst.get(name, (0.0, "")), (x, case.name))
    for name, (x, where) in worst.items():
        print(f"{name:<11} at most {x:.1e} apart ({where})")
    print(f"{failed} of {len(cases)} cases failed")
    return int(failed > 0)


def check(case: Case, results: dict[str, Any]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the differences of a case from its stored result, and those allowed.

    Raises `ChangedError`."""
    if case.name not in results:
        raise ChangedError("nothing is kept; run with --write")
    result = results[case.name]
    if (case.config, case.overrides) != (result["config"], result["overrides"]):
        raise ChangedError("the case itself; run with --write and its name")
    return differences(package.evaluate(case.config, case.overrides), result), limits(result)


def _in_turn(cases: list[Case]) -> Iterator[tuple[Case, str]]:
    """Yield each case with a line of progress, which has the time of the case before."""
    began = time.monotonic()
    for number, case in enumerate(cases):
        yield case, f"{time.monotonic() - began:6.0f} s  {number + 1}/{len(cases)} {case.name}"


def main() -> int:
    """Compare or write the named cases, or all without a name."""
    parser = argparse.ArgumentParser(prog="python -m tests.reference", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases whose name begins so")
    parser.add_argument("--write", action="store_true", help="keep what the package gives now")
    parser.add_argument("--missing", action="store_true", help="only cases without a kept result")
    parser.add_argument("--list", action="store_true", help="print the cases and their overrides")
    options = parser.parse_args()
    names = tuple(options.names) or ("",)
    cases = [case for case in CASES if case.name.startswith(names)]
    if options.missing:
        cases = [case for case in cases if case.name not in kept.read()]
    if not cases:
        parser.error("no case is left; --list shows those that there are")
    if options.list:
        for case in cases:
            print(f"{case.name}: {case.config} {' '.join(case.overrides)}")
        return 0
    package.start()
    return written(cases) if options.write else compared(cases)


if __name__ == "__main__":
    sys.exit(main())
