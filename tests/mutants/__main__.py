"""`python -m tests.mutants`: make mistakes in a copy of the package and see which tests notice.

First come mistakes made by hand (`by_hand.yaml`), then a random choice of all mistakes that the
operators can make in the numerical modules. The exit code is 1 if one of the first is missed, or
if fewer than 95 % of the others are noticed. With --resume, known outcomes are not tried again."""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.mutants.mistakes import ROOT, Mistake, by_hand, chosen

_WANTED = 0.95
_LEFT_OUT = (".git", ".venv", "results", "dist", "build", "__pycache__", ".hypothesis")
_RECORD = ROOT / "results" / "mutants.json"
# Limit of processor time for a mistake's tests (s); an endless loop is noticed.
_SECONDS = 900


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=60, help="mistakes chosen (default 60)")
    parser.add_argument("--seed", type=int, default=16, help="of the choice (default 16)")
    parser.add_argument("--resume", action="store_true", help="keep the outcomes of earlier runs")
    options = parser.parse_args()
    known = json.loads(_RECORD.read_text()) if options.resume and _RECORD.exists() else {}
    _RECORD.parent.mkdir(exist_ok=True)
    groups = {"by hand": by_hand(), "chosen": chosen(options.seed, options.count)}
    with tempfile.TemporaryDirectory(prefix="rootsopt-mutants-") as place:
        tree = shutil.copytree(ROOT, f"{place}/tree", ignore=shutil.ignore_patterns(*_LEFT_OUT))
        for one in (one for group in groups.values() for one in group):
            if str(one) not in known:
                known[str(one)] = noticed(one, Path(tree))
                _RECORD.write_text(json.dumps(known))
            print(f"{'noticed ' if known[str(one)] else 'SURVIVED'} {one}", flush=True)
    shares = {name: sum(known[str(one)] for one in group) for name, group in groups.items()}
    for name, group in groups.items():
        print(f"{name}: {shares[name]} of {len(group)} noticed")
    enough = shares["chosen"] >= _WANTED * len(groups["chosen"])
    return int(shares["by hand"] < len(groups["by hand"]) or not enough)


def noticed(one: Mistake, tree: Path) -> bool:
    """Return whether a test fails with the mistake. Raises if it also fails without."""
    path = tree / one.file
    original = path.read_text()
    path.write_text(one.source)
    try:
        failed = _failed(one.tests, tree)
    finally:
        path.write_text(original)
    if failed and _failed(one.tests, tree):
        raise RuntimeError(f"{' '.join(one.tests)} fail without a mistake")
    return failed


def _failed(tests: tuple[str, ...], tree: Path) -> bool:
    command = [sys.executable, "-B", "-m", "pytest", "-x", "-q", "-m", "not long", *tests]
    # Programs that a mistake does not change are compiled only once, except in tests of the cache.
    cached = "tests/runtime/test_programs.py" not in tests[0]
    cache = {"JAX_COMPILATION_CACHE_DIR": f"{tree}.cache"} if cached else {}
    return bool(
        subprocess.run(
            command,
            cwd=tree,
            env=os.environ | cache | {"PYTHONPATH": str(tree)},
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (_SECONDS, _SECONDS)),
            stdout=subprocess.DEVNULL,
            check=False,
        ).returncode
    )


if __name__ == "__main__":
    sys.exit(main())
