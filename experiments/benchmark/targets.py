"""Targets of the benchmark, compared with the times measured in a finished run."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from experiments.benchmark.job import ACCURACY, GRADIENT_ACCURACY, Row


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """Return the exponent of a power law fitted to (size, time); `None` for fewer than two
    points."""
    if len(points) < 2:
        return None
    x, y = np.log(np.array(points)).T
    return float(np.polyfit(x, y, 1)[0])


@dataclasses.dataclass(frozen=True)
class Lookup:
    """Looks up measured times of a finished run by tool and task."""

    rows: list[Row]

    def best(self, tool: str, what: str) -> Row | None:
        """Return the fastest row with sufficient accuracy for the task `what`, or `None`.

        Rows of all tools whose names start with `tool` are considered."""
        rows = [r for r in self.rows if r["tool"].startswith(tool) and r["what"] == what]
        fine = [
            r
            for r in rows
            if (r.get("value_error") or 0.0) <= ACCURACY
            and (r.get("gradient_error") or 0.0) <= GRADIENT_ACCURACY
        ]
        return min(fine, key=lambda r: r["per_design_ms"], default=None)

    def ratio(self, slow: tuple[str, str], fast: tuple[str, str]) -> float | None:
        """Return the time per design of `slow` divided by that of `fast`, each a (tool, task)."""
        one, other = self.best(*slow), self.best(*fast)
        return one["per_design_ms"] / other["per_design_ms"] if one and other else None

    def seconds(self, what: str) -> float | None:
        """Return the time (s) of the first task whose name ends with `what`."""
        found = [r["run_s"] for r in self.rows if r["what"].endswith(what)]
        return found[0] if found else None

    def revolutions(self) -> list[tuple[float, float]]:
        """Return (revolutions, seconds) of each run."""
        rows = [r for r in self.rows if r["part"] == "revolutions"]
        return [(r["revolutions"], r["run_s"]) for r in rows]

    def batches(self, what: str, part: str = "batch") -> list[tuple[float, float]]:
        """Return (designs, seconds) of the batches."""
        rows = [r for r in self.rows if r["part"].startswith(f"{part} ") and r["what"] == what]
        return [(r["designs"], r["run_s"]) for r in rows]


def targets(rows: list[Row]) -> list[Row]:
    """Return a row per target, with the measured value; `reached` is `None` if not measured."""
    look = Lookup(rows)
    both, value, one, many = "value+gradient", "value", "rootsopt, ", "rootsopt, batch of 256"
    single = Lookup([r for r in rows if r["part"] == "single" or r["tool"].startswith("(")])
    orbit = next((r for r in rows if r["tool"] == "orbit"), None)
    limits = (
        ("value + gradient, speed-up over (a)", ">=", 200.0,
         single.ratio(("(a)", both), (one, both)), "one design"),
        ("the same in a batch of 256", ">=", 200.0,
         look.ratio(("(a)", both), (many, both)), "per design"),
        ("value + gradient, speed-up over (b)", ">=", 1.0,
         single.ratio(("(b)", both), (one, both)), "one design"),
        ("the same in a batch of 256", ">=", 1.0,
         look.ratio(("(b)", both), (many, both)), "per design"),
        ("one value, in units of (b)'s time", "<=", 3.0,
         single.ratio((one, value), ("(b)", value)), "one design"),
        ("a value in a batch of 256, in units of (b)'s time", "<=", 1.0,
         look.ratio((many, value), ("(b)", value)), "per design"),
        ("value + gradient on the orbit (ms)", "<=", 50.0,
         milli(orbit["run_s"]) if orbit else None, "to 1e-6, one core"),
        ("exponent of cost over revolutions", "<=", 1.1,
         exponent(look.revolutions()), "1 is linear"),
        ("exponent of cost over batch size", "<=", 1.1,
         exponent(look.batches(both)), "value + gradient"),
        ("main job, cold process (s)", "<=", 20.0, look.seconds(", cold"), "no cache"),
        ("main job, programs cached (s)", "<=", 8.0, look.seconds(", cached"), "second run"),
    )  # fmt: skip
    compare = {">=": lambda x, y: x >= y, "<=": lambda x, y: x <= y, "<": lambda x, y: x < y}
    return [
        {
            "target": name,
            "limit": f"{sign} {limit:g}",
            "figure": figure,
            "reached": None if figure is None else bool(compare[sign](figure, limit)),
            "note": note,
        }
        for name, sign, limit, figure, note in limits
    ]


def milli(seconds: float | None) -> float | None:
    """Convert seconds to milliseconds."""
    return None if seconds is None else 1e3 * seconds
