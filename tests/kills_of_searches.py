"""Kill `rootsopt optimize` at random instants, and resume it until it ends.

`python -m tests.kills_of_searches` does so with a nominal and a robust search. The result must be
that of a run that was never killed, to the last bit; the exit code is 1 if it is not.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FEW = (
    "solver.fidelity=linear",
    "optimizer.screening=4",
    "optimizer.starts=2",
    "optimizer.iterations=12",
)
SEARCHES = {
    "nominal": FEW,
    "robust": (
        *FEW,
        "optimizer.starts=1",
        "tolerances.over.scene.load.torque_N_m.relative_normal=0.05",
        "tolerances.samples=4",
        "tolerances.check_samples=8",
    ),
}
"""Overrides of `configs/cic.yaml`, by name."""
_OWN = "seconds", "statistics", "run", "versions"
"""Entries of the result file that differ between runs of the same search."""


def command(place: Path, overrides: tuple[str, ...], *more: str) -> list[str]:
    """The command of a search into the folder `place`."""
    options = [word for one in overrides for word in ("--set", one)]
    run = [sys.executable, "-m", "rootsopt.optimize", "configs/cic.yaml", "-o", str(place)]
    return [*run, "--no-figures", *options, *more]


def plain(tree: Any) -> Any:
    """A result without the entries that tell one run from another."""
    if isinstance(tree, dict):
        return {key: plain(value) for key, value in tree.items() if key not in _OWN}
    return [plain(one) for one in tree] if isinstance(tree, list) else tree


def found(place: Path) -> dict[str, Any]:
    """All that a search has found: result file, history and designs, as text or exact numbers."""
    texts = ("history.csv", "optimized.yaml", "tolerances.csv", "response_optimized.csv")
    read = {name: (place / name).read_text() for name in texts if (place / name).exists()}
    return read | {"result": plain(json.loads((place / "result.json").read_text()))}


def killed(place: Path, overrides: tuple[str, ...], longest: float, wanted: int, rng) -> int:
    """Run a search that is killed after at most `longest` seconds, up to `wanted` times.

    It is resumed until it ends. Returns the number of kills."""
    kills = 0
    checkpoint = place.with_name(f".{place.name}.checkpoint")
    while True:
        more = ["--resume"] if checkpoint.exists() else []
        process = subprocess.Popen(
            command(place, overrides, *more), cwd=ROOT,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            process.wait(rng.uniform(0.2, longest) if kills < wanted else None)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
            continue
        if process.returncode:
            _, said = process.communicate()
            raise RuntimeError(f"exit code {process.returncode}: {said}")
        return kills


def main() -> int:
    """Kill each search until the wanted number of kills is reached; print what is found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20, help="kills of each search (20)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    wrong = 0
    for name, overrides in SEARCHES.items():
        with tempfile.TemporaryDirectory() as parent:
            whole = Path(parent) / "whole"
            subprocess.run(command(whole, overrides), cwd=ROOT, check=True, capture_output=True)
            began = time.monotonic()
            subprocess.run(
                command(whole, overrides, "--overwrite"), cwd=ROOT, check=True, capture_output=True
            )
            longest, expected = time.monotonic() - began, found(whole)
            kills = runs = differ = 0
            while kills < options.kills:
                place = Path(parent) / f"killed{runs}"
                kills += killed(place, overrides, longest, options.kills - kills, rng)
                differ += found(place) != expected
                runs += 1
            print(f"{name}: {kills} kills in {runs} runs, {differ} results differ", flush=True)
            wrong += differ
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
