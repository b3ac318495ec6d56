"""`python -m tests.mutants`: make mistakes in a copy of the package and see which tests notice.

First come mistakes made by hand (tests/mutants/by_hand.py). Then comes a seeded choice of all
mistakes that the operators can make in the numerical modules. The exit code is 1 if one of the
first is missed, or if fewer than 95 % of the others are noticed. The tree itself is not changed.
With --resume, a run continues from the recorded outcomes of an earlier one."""

import argparse
import dataclasses
import json
import signal
import sys
import tempfile
from pathlib import Path

_WANTED = 0.95
ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    """Run the mutants, print the table, return the exit code."""
    options = _options()
    # End as after Ctrl-C: remove the copy and end the running tests.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    from tests.mutants.by_hand import by_hand
    from tests.mutants.trial import Copy, Outcome

    left_out = 0
    tasks = [] if options.only_chosen else [("by hand", one) for one in by_hand(ROOT)]
    if not options.only_by_hand:
        # Its operators are those of a package that mistakes by hand do without.
        from tests.mutants.candidates import chosen
        from tests.mutants.equivalent import equivalents

        left_out = len(equivalents())
        tasks += [("chosen", one) for one in chosen(ROOT, options.seed, options.count)]
    if options.only:
        tasks = [
            task
            for task in tasks
            if any(word in f"{task[1].key} {task[1].file} {task[1].was}" for word in options.only)
        ]
    if options.list:
        for group, one in tasks:
            print(f"{one.key} {group:<8} {one.file}:{one.line} {one.function}")
            print(f"    {one.was}\n -> {one.becomes}")
        return 0
    known = _recorded(options.record) if options.resume else {}
    if options.again:
        known = {key: one for key, one in known.items() if one.noticed}
    options.record.parent.mkdir(parents=True, exist_ok=True)
    outcomes: dict[str, list[Outcome]] = {"by hand": [], "chosen": []}
    with tempfile.TemporaryDirectory(prefix="rootsopt-mutants-") as folder:
        cache = options.cache or Path(folder) / "cache"
        copy = Copy(ROOT, Path(folder) / "tree", cache, options.seconds)
        for number, (group, one) in enumerate(tasks, start=1):
            outcome = known.get(one.key)
            if outcome is None:
                place, change = f"{one.file}:{one.line}", f"{one.was}  ->  {one.becomes}"
                if one.source is None:
                    outcome = Outcome(one.key, place, change, "void", "the text is not there", 0.0)
                else:
                    outcome = copy.trial(one.key, place, change, one.file, one.source, one.tests)
                with options.record.open("a") as file:
                    file.write(json.dumps(dataclasses.asdict(outcome)) + "\n")
            outcomes[group].append(outcome)
            print(f"{number}/{len(tasks)} {one.key} {outcome.row()}", flush=True)
        every = [one for group in outcomes.values() for one in group]
        _control(copy, every)
    print("\nSummary")
    good = True
    for group, found in outcomes.items():
        noticed = [one for one in found if one.noticed]
        if not found:
            continue
        ends = sum(one.verdict == "timeout" for one in found)
        share = len(noticed) / len(found)
        print(f"{group}: {len(noticed)} of {len(found)} noticed ({share:.1%}), {ends} without end")
        good &= share >= (1.0 if group == "by hand" else _WANTED)
        for one in found:
            if not one.noticed:
                print(f"  {one.key} {one.row()}")
    if not options.only_by_hand:
        print(f"equivalent, passed over: {left_out} (tests/mutants/equivalent.yaml)")
    return 0 if good else 1


def _control(copy, outcomes) -> None:
    """Withdraw the verdict `caught` if the test also fails without any change."""
    tests = sorted({one.by for one in outcomes if one.by.startswith("tests/")})
    failed = copy.failing(tests)
    for one in outcomes:
        if one.by in failed:
            one.verdict, one.by = "void", f"{one.by} fails without the change"


def _recorded(path: Path):
    from tests.mutants.trial import Outcome

    if not path.exists():
        return {}
    rows = (json.loads(line) for line in path.read_text().splitlines())
    return {row["key"]: Outcome(**row) for row in rows}


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=60, help="mutants chosen (default 60)")
    parser.add_argument("--seed", type=int, default=16, help="of the choice (default 16)")
    parser.add_argument("--seconds", type=int, default=900,
                        help="processor time for a mutant's tests (s, default 900)")  # fmt: skip
    parser.add_argument("--only", action="append", default=[], metavar="TEXT",
                        help="only those with TEXT in key, file or line (repeatable)")  # fmt: skip
    parser.add_argument("--only-by-hand", action="store_true", help="not those chosen by seed")
    parser.add_argument("--only-chosen", action="store_true", help="not those made by hand")
    parser.add_argument("--list", action="store_true", help="show the mutants, run nothing")
    parser.add_argument("--record", type=Path, default=ROOT / "results/mutants.jsonl",
                        help="where outcomes are kept (default results/mutants.jsonl)")  # fmt: skip
    parser.add_argument("--resume", action="store_true", help="take outcomes from the record")
    parser.add_argument("--again", action="store_true",
                        help="with --resume: try those again that no test noticed")  # fmt: skip
    parser.add_argument("--cache", type=Path, help="folder of compiled programs to keep")
    return parser.parse_args()


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit("stopped; what is done is in the record: go on with --resume")
