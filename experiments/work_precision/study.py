"""Measures error of mean and peak force against run time.

There are three scenes: the shipped CIC and EE pairs, and a lively CIC pair (more backlash, less
damping, lower speed). A curve is one choice of contact, solver and precision, with tolerances of
transient and orbit from coarse to fine. The time is that of one whole evaluation of a design, after
compilation: transient, closed orbit, forces and gradient. The reference uses contact by search with
dopri8 at a tolerance of 1e-11. The reference's own error is estimated from other tolerances and
another solver.

The study `smoothing` measures the effect of rounding the corners of contact law and timing gear.
"""

import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from experiments._common.driver import NoResultError
from experiments._common.scenes import shipped
from experiments._common.simulation import at, evaluator_of
from experiments._common.timing import median_time
from rootsopt.response.evaluation import Evaluation, Evaluator

Row = dict[str, Any]
Say = Callable[[str], None]
SCENES: dict[str, tuple[str, tuple[str, ...]]] = {
    "cic": ("cic", ()),
    "ee": ("ee", ()),
    "lively": (
        "cic",
        (
            "scene.timing_gear.backlash_mm=0.2",
            "scene.timing_gear.damping_ratio=0.2",
            "scene.speed_rpm=2000",
        ),
    ),
}
FORCES = {"mean": "mean_force_N", "peak": "peak_force_N"}
REPEATS = 5
FINE = tuple(10.0**-k for k in range(3, 11))
ROUGH = FINE[:5]
"""Tolerances for contacts whose own error is far larger than the solver's error."""
NODES = FINE[:4]
"""Tolerances for contact by nodes. The force has steps there, at which a finer tolerance stalls."""
PERIODS = 64
"""Longest transient (mesh periods); all scenes settle within a few."""
PATIENCE = 3.0
"""Time (s) of all runs of a setting above which no further run is made."""
SINGLE = (1e-3, 1e-4, 1e-5, 2e-6)
"""Tolerances for single precision, which allows no finer tolerance."""
REFERENCE_RTOL = 1e-11
FLOOR = 1e-12
"""Relative error below which an error is drawn at this value."""
AWAY = 2e-3
"""Relative difference between the parameters of the design and those of its neighbour."""
CLOSINGS = {
    "shooting": "shooting, from rest",
    "collocation": "collocation, from rest",
    "neighbour": "collocation, from a neighbour's orbit",
}
OTHER_ORBIT = 0.3
"""Scaled distance from the reference's orbit at φ1 = 0 above which a result is on another orbit."""


def contact(name: str) -> tuple[str, ...]:
    """Return the overrides that select a contact.

    `name`: "search", "linear", "map ROLLSxRELATIVES" or "nodes COUNT"."""
    kind, _, size = name.partition(" ")
    choice = (f"solver.fidelity={kind}",)
    if kind == "map":
        rolls, relatives = size.split("x")
        return (*choice, f"solver.map_rolls={rolls}", f"solver.map_relatives={relatives}")
    return (*choice, f"solver.nodes={size}") if kind == "nodes" else choice


@dataclasses.dataclass(frozen=True)
class Curve:
    """One choice of contact, solver and precision in a scene, over its tolerances.

    `panels`: names of the panels in which the curve is drawn; `transient`: tolerance of the
    transient, if it differs from the orbit's; `closing`: how orbits are closed, by `shooting` or
    `collocation` after a transient, or from the orbit of a `neighbour` (`AWAY`). Curves with the
    same `compiled` share a compiled program.
    """

    scene: str
    panels: tuple[str, ...]
    contact: str
    method: str = "tsit5"
    precision: str = "float64"
    transient: float | None = None
    tolerances: tuple[float, ...] = FINE
    closing: str = "shooting"

    @property
    def compiled(self) -> tuple[str, str, str, str, bool]:
        """Everything that determines the compiled program."""
        closing = "shooting" if self.closing == "shooting" else "collocation"
        return self.contact, self.method, self.precision, closing, self.scene == "ee"

    def label(self, panel: str) -> str:
        """Return the name of the curve in the legend of a `panel`."""
        if panel.startswith("closing"):
            return CLOSINGS[self.closing]
        parts = [self.contact]
        if panel == "solver" or self.method != "tsit5":
            parts.append(self.method)
        if self.precision != "float64":
            parts.append(self.precision)
        if self.transient is not None:
            parts.append(f"transient {self.transient:.0e}")
        return ", ".join(parts)

    def evaluator(self) -> Evaluator:
        """Make the evaluator of the curve, at the config's tolerances."""
        choice = (f"solver.method={self.method}", f"solver.precision={self.precision}")
        orbit = "shooting" if self.closing == "shooting" else "collocation"
        choice += (f"solver.orbit={orbit}",)
        return evaluator(self.scene, *contact(self.contact), *choice)


def evaluator(scene: str, *overrides: str) -> Evaluator:
    """Make the evaluator of a `scene` (its name) with further `overrides`."""
    name, settings = SCENES[scene]
    periods = f"solver.max_mesh_periods={PERIODS}"
    return evaluator_of(shipped(name, *settings, periods, *overrides))


FULL = (
    Curve("cic", ("contact",), "map 768x24"),
    Curve("cic", ("contact",), "map 192x12"),
    Curve("cic", ("contact",), "linear", tolerances=ROUGH),
    Curve("cic", ("contact",), "nodes 100", tolerances=NODES),
    Curve("cic", ("contact",), "nodes 400", tolerances=NODES),
    Curve("cic", ("contact", "solver", "closing cic"), "search"),
    Curve("cic", ("contact", "solver"), "map 384x16"),
    Curve("cic", ("solver",), "search", "dopri5"),
    Curve("cic", ("solver",), "search", "dopri8"),
    Curve("cic", ("solver",), "search", "kvaerno5", tolerances=FINE[:5]),
    Curve("cic", ("solver",), "search", transient=1e-6),
    Curve("cic", ("solver",), "map 384x16", precision="float32", tolerances=SINGLE),
    Curve("cic", ("closing cic",), "search", closing="collocation"),
    Curve("cic", ("closing cic",), "search", closing="neighbour"),
    Curve("ee", ("ee",), "search", "dopri8"),
    Curve("ee", ("ee", "closing ee"), "search"),
    Curve("ee", ("ee",), "map 384x16"),
    Curve("ee", ("closing ee",), "search", closing="collocation"),
    Curve("ee", ("ee",), "linear", tolerances=ROUGH),
    Curve("ee", ("ee",), "nodes 400", tolerances=NODES),
    Curve("lively", ("lively",), "search", "dopri8"),
    Curve("lively", ("lively", "closing lively"), "search"),
    Curve("lively", ("lively",), "map 384x16"),
    Curve("lively", ("closing lively",), "search", closing="collocation"),
    Curve("lively", ("closing lively",), "search", closing="neighbour"),
    Curve("lively", ("lively",), "map 192x12"),
    Curve("lively", ("lively",), "linear", tolerances=ROUGH),
    Curve("lively", ("lively",), "nodes 400", tolerances=NODES),
)
QUICK = (Curve("cic", ("contact",), "linear", tolerances=(1e-3, 1e-7, 1e-9)),)


def warm_up(curves: Iterable[Curve], say: Say) -> float:
    """Compile the programs of all curves, two at a time; return the time taken (s)."""
    began = time.perf_counter()
    different = {curve.compiled: curve for curve in curves}
    count = itertools.count(1)

    def one(curve: Curve) -> None:
        curve.evaluator()(series=False)
        taken = time.perf_counter() - began
        say(f"compiled {next(count)}/{len(different)} ({taken:.0f} s): {curve.compiled}")

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(one, different.values()))
    return time.perf_counter() - began


@dataclasses.dataclass(frozen=True)
class Reference:
    """Evaluation of the reference, and the reference's own relative error by name of the force."""

    found: Evaluation
    error: dict[str, float]


def errors(found: Evaluation, truth: Evaluation) -> dict[str, float]:
    """Return the errors of mean and peak force, by name, relative to `truth`."""
    return {
        name: abs(found.response[key] / truth.response[key] - 1) for name, key in FORCES.items()
    }


def reference(scene: str, curve: Curve, check: Curve, say: Say) -> Reference:
    """Evaluate a scene as accurately as the program of `curve` can.

    The reference's error is estimated from an evaluation at ten times the tolerance, and from the
    solver of `check`. Raises `NoResultError` unless the orbit is periodic.
    """
    found = at(curve.evaluator(), REFERENCE_RTOL)(series=False)
    if not found.usable:
        raise NoResultError(f"the reference of scene {scene} ended as {found.status.label}")
    others = [at(curve.evaluator(), 1e-10), at(check.evaluator(), REFERENCE_RTOL)]
    off = [errors(other(series=False), found) for other in others]
    worst = {name: max(e[name] for e in off) for name in FORCES}
    say(f"reference of {scene}: {found.response}, good to {worst}")
    return Reference(found, worst)


def verdict(found: Evaluation, truth: Evaluation) -> str:
    """Return the status of an evaluation as text, or a note that it is not on the reference's
    orbit."""
    if not found.usable:
        return found.status.label
    same = found.steady_state["period"] == truth.steady_state["period"]
    assert found.state is not None
    assert truth.state is not None
    far = np.max(np.abs(np.asarray(found.state, float) - truth.state)) > OTHER_ORBIT
    return "periodic" if same and not far else "other orbit"


def measure(curve: Curve, truth: Evaluation, repeats: int) -> list[dict[str, Any]]:
    """Measure a curve; return a row per tolerance."""
    rows = []
    tool = curve.evaluator()
    for rtol in curve.tolerances:
        # Fits the map to the motion.
        tool, found = at(tool, rtol, curve.transient).fit(series=False)
        call = functools.partial(tool, series=False)
        if curve.closing == "neighbour":
            design = np.asarray(tool.config.design, float)
            beside = tool(design * (1 + AWAY), series=False)
            call = functools.partial(tool, design, start=beside.state, series=False)
            call()  # It may have a program to compile.
        seconds, found = median_time(call, repeats if found.usable else 1, PATIENCE)
        status = verdict(found, truth)
        off = errors(found, truth) if status == "periodic" else dict.fromkeys(FORCES, math.nan)
        rows.append(
            {
                "scene": curve.scene,
                "contact": curve.contact,
                "method": curve.method,
                "precision": curve.precision,
                "closing": curve.closing,
                "rtol": rtol,
                "transient_rtol": curve.transient or rtol,
                "status": status,
                "seconds": seconds,
                "mean_error": off["mean"],
                "peak_error": off["peak"],
                "transient_mesh_periods": found.statistics["transient_mesh_periods"],
                "solver_steps": found.statistics["solver_steps"],
                "orbit_steps": found.statistics.get("orbit_steps"),
                "newton_steps": found.statistics.get("newton_steps"),
            }
        )
    return rows


@dataclasses.dataclass(frozen=True)
class Results:
    """Curves with their rows, references by scene, and time of compilation (s)."""

    measured: list[tuple[Curve, list[Row]]]
    references: dict[str, Reference]
    compile_seconds: float

    @property
    def rows(self) -> list[Row]:
        """Rows of all curves."""
        return [row for _, part in self.measured for row in part]


def run(quick: bool, say: Say = lambda text: None) -> Results:
    """Measure all curves; a reduced run takes one program and few tolerances."""
    curves = QUICK if quick else FULL
    compiling = warm_up(curves, say)
    references, measured = {}, []
    for scene in dict.fromkeys(curve.scene for curve in curves):
        own = [curve for curve in curves if curve.scene == scene]
        tight = next((curve for curve in own if curve.method == "dopri8"), own[0])
        check = next((c for c in own if c.contact == tight.contact and c is not tight), tight)
        references[scene] = reference(scene, tight, check, say)
    for number, curve in enumerate(curves, 1):
        rows = measure(curve, references[curve.scene].found, 2 if quick else REPEATS)
        measured.append((curve, rows))
        say(f"{number}/{len(curves)} {curve.scene}: {curve.label('')}")
    return Results(measured, references, compiling)
