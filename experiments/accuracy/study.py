"""Measures error and time of random designs and scenes at several values of `solver.accuracy`.

Profiles are EE, and CIC with random pressure angle, involute and tip land, with two to four lobes.
Scenes vary speed, load, backlash and damping. The errors are those of mean, peak and RMS force, and
of their derivatives with respect to the profile parameters, relative to the largest derivative of
the same force. The reference is collocation at a tolerance of 1e-12, whose forces agree with those
by shooting (`experiments._common.shooting`). Scenes without a reference are replaced by other
random scenes.
"""

import contextlib
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments._common.driver import Run
from experiments._common.scenes import CIC, MEASURES, shipped
from experiments._common.shooting import closed
from experiments._common.simulation import evaluator_of
from experiments._common.style import BLACK, BLUE, VERMILION, sheet
from experiments._common.tables import Row, show
from experiments._common.timing import processor_time
from rootsopt.config import load
from rootsopt.errors import InputError
from rootsopt.response.result import Evaluation
from rootsopt.status import Status

# Values of `solver.accuracy`.
REQUESTS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)

# Setting of the reference, and relative difference from the forces by shooting above which it is
# no reference.
SHARP, CHECKED = "solver.rtol=1e-12", 1e-7

# Number of scenes of a full and of a reduced run, and number of timed evaluations.
COUNT, QUICK_COUNT, REPEATS = 60, 1, 3


def scenes(seed: int) -> Iterator[tuple[str, list[str]]]:
    """Yield (name of a shipped config, random overrides) without end."""
    draw = np.random.default_rng(seed)
    while True:
        family = "ee" if draw.uniform() < 0.25 else "cic"
        lobes = int(draw.integers(2, 5))
        values: dict[str, Any] = {
            "profile.lobes": lobes,
            "scene.speed_rpm": round(10 ** draw.uniform(2.5, 3.7), 1),
            "scene.load.torque_N_m": round(10 ** draw.uniform(0.3, 1.5), 3),
            "scene.timing_gear.backlash_mm": round(draw.uniform(0.02, 0.3), 3),
            "scene.timing_gear.damping_ratio": round(draw.uniform(0.1, 0.8), 3),
        }
        if family == "cic":
            radius = load(CIC).profile.pitch_radius_mm
            angle, tip = draw.uniform(25, 42), draw.uniform(0.5, 5.0)
            longest = radius * np.sin(np.radians(angle)) * (np.pi / 2 / lobes - np.radians(tip))
            values |= {
                "profile.pressure_angle_deg": round(angle, 2),
                "profile.tip_arc_angle_deg": round(tip, 2),
                "profile.involute_length_mm": round(draw.uniform(0.1, 0.9) * longest, 2),
            }
        yield family, [f"{key}={value}" for key, value in values.items()]


def error(found: Evaluation, truth: Evaluation) -> float:
    """Return the largest relative error of forces and derivatives, inf if there are none."""
    if found.status is not Status.PERIODIC:
        return np.inf
    off = [abs(found.response[name] / truth.response[name] - 1) for name in MEASURES]
    for name in MEASURES:
        if name in truth.gradient:  # EE has no parameters
            one, other = (np.array(list(x.gradient[name].values())) for x in (found, truth))
            off.append(np.max(np.abs(one - other)) / np.max(np.abs(other)))
    return float(max(off))


def measure(family: str, overrides: list[str]) -> Iterator[Row]:
    """Measure one scene. Yield a row for each accuracy; none if the scene has no reference."""
    finest = evaluator_of(shipped(family, *overrides, f"solver.accuracy={REQUESTS[-1]}"))
    near = finest(series=False)
    sharp = evaluator_of(shipped(family, *overrides, SHARP))
    truth = sharp(start=near.start, series=False)
    if not (truth.status is near.status is Status.PERIODIC):
        return
    pair, period = sharp.pair([*truth.design.values()]), int(truth.steady_state["period"])
    forces = np.array([truth.response[name] for name in MEASURES])
    if np.max(np.abs(closed(pair, truth.state, period).forces / forces - 1)) > CHECKED:
        return
    for wanted in REQUESTS:
        tool = evaluator_of(shipped(family, *overrides, f"solver.accuracy={wanted}"))
        seconds, found = processor_time(functools.partial(tool, series=False), REPEATS)
        yield {
            "family": family,
            "scene": " ".join(overrides),
            "accuracy": wanted,
            "status": found.status.label,
            "error": error(found, truth),
            "seconds": seconds,
        }


def summary(rows: list[Row]) -> list[Row]:
    """Return, for each accuracy: share of scenes within it, errors, and time."""
    # Arrays of shape (accuracies, scenes).
    pairs = np.reshape([(row["error"], row["seconds"]) for row in rows], (-1, len(REQUESTS), 2))
    errors, seconds = pairs.T
    usual = seconds[REQUESTS.index(1e-5)]
    return [
        {
            "accuracy": wanted,
            "scenes": off.size,
            "within": float(np.mean(off <= wanted)),
            "median_error": float(np.median(off)),
            "error_of_95_percent": float(np.quantile(off, 0.95, method="lower")),
            "median_ms": 1e3 * float(np.median(times)),
            "time_over_usual": float(np.median(times / usual)),
        }
        for wanted, off, times in zip(REQUESTS, errors, seconds, strict=True)
    ]


def errors(rows: list[Row], table: list[Row]) -> Figure:
    """Draw the errors of all scenes, and the time relative to the usual accuracy.

    `table`: summary of the `rows`."""
    figure, ((left, right),) = sheet(10.0, 4.4, columns=2)
    asked = np.array([row["accuracy"] for row in rows])
    reached = np.clip([row["error"] for row in rows], 1e-12, 1.0)
    shifted = asked * 10 ** np.random.default_rng(0).uniform(-0.2, 0.2, len(asked))
    left.loglog(shifted, reached, "o", color=BLUE, mfc="none", ms=4, label="a scene")
    line = REQUESTS[-1], REQUESTS[0]
    left.loglog(line, line, "-", color=BLACK, lw=1, label="accuracy asked for")
    left.set(
        xlabel="solver.accuracy (points spread for legibility)", xlim=left.get_xlim()[::-1],
        ylabel="relative error of forces and gradient, the largest",
    )  # fmt: skip
    left.legend(fontsize=8)
    right.semilogx(REQUESTS, [row["time_over_usual"] for row in table], "s-", color=VERMILION)
    right.set(
        xlabel="solver.accuracy", xlim=right.get_xlim()[::-1],
        ylabel="time of an evaluation, over that at 1e-5 (median)", ylim=(0, None),
    )  # fmt: skip
    figure.suptitle(f"{table[0]['scenes']} random designs and scenes, from rest", fontsize=11)
    return figure


def run(job: Run) -> bool:
    """Measure random scenes until enough of them have a reference; write all rows and the table.

    Returns whether 95 % of the errors are within each accuracy."""
    rows: list[Row] = []
    done, count, drawn = 0, QUICK_COUNT if job.quick else COUNT, scenes(0)
    while done < count:
        family, overrides = next(drawn)
        with contextlib.suppress(InputError):  # an impossible geometry
            new = [*measure(family, overrides)]
            rows += new
            done += bool(new)
            job.say(f"{done}/{count} {family} " + " ".join(f"{row['error']:.0e}" for row in new))
    table = summary(rows)
    job.csv("accuracy.csv", rows)
    job.json("accuracy.json", {"table": table})
    job.figure("accuracy.png", errors(rows, table))
    show("Accuracy asked for and reached", table)
    return all(row["within"] >= 0.95 for row in table)
