"""How far the values found for the paper's silent quantities are determined.

Motions that coexist, other definitions of mean and maximum, each quantity changed alone, and
each changed with the others solved for again.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from experiments.paper_scene import (
    FAMILIES,
    PAPER,
    QUANTITIES,
    Pairs,
    Response,
    compensated,
    config_of,
    polished,
)
from rootsopt import basins
from rootsopt.evaluate import CHAOS_WINDOW, Evaluator, lyapunov_program, unsettled
from rootsopt.model import design_vector

WINDOWS = ((0.0, 0.1), (0.0, 0.2), (0.05, 0.2), (0.1, 0.2), (0.1, 0.8))
"""Begin and end (s) of the windows that mean and maximum may have been taken over."""
THINNINGS = (1, 3, 15)
"""Only every so manieth of the samples of the window is kept."""
GRID = ("attractors.relatives=24", "attractors.rates=18")
Notify = Callable[[str], None]


def row_of(response: Response) -> dict[str, Any]:
    """Values, forces, periods and misfit in a line."""
    row: dict[str, Any] = {q.key: v for q, v in zip(QUANTITIES, response.values, strict=True)}
    for family, (mean, peak), period, one in zip(
        FAMILIES, response.forces, response.periods, response.evaluations, strict=True
    ):
        row |= {
            f"{family}_status": one.status.label,
            f"{family}_period": period,
            f"{family}_multiplier": one.steady_state.get("floquet_multiplier"),
            f"{family}_mean_force_N": mean,
            f"{family}_peak_force_N": peak,
        }
    return row | {"misfit": response.misfit}


def motions(values: ArrayLike) -> list[dict[str, Any]]:
    """The motions that coexist with these values, a row each."""
    rows = []
    for family in FAMILIES:
        found = basins.find(Evaluator(config_of(family, values, *GRID)))
        rows += [{"pair": family} | row for row in found.summary()]
        rows += [{"pair": family, "status": k, "share": v} for k, v in found.lost.items()]
    return rows


def definitions(values: ArrayLike) -> list[dict[str, Any]]:
    """Mean and maximum over windows of one motion from rest, start-up included or not, at
    several sampling rates: a row for each window and rate."""
    runs = []
    for family in FAMILIES:
        evaluator = Evaluator(config_of(family, values))
        pair = evaluator.pair(design_vector(evaluator.config))
        window = lyapunov_program(pair, np.zeros(2), CHAOS_WINDOW, evaluator.transient)
        *_, series = unsettled(pair, window, True)
        assert series is not None
        runs.append(series)
    rows = []
    for begin, end in WINDOWS:
        for thinning in THINNINGS:
            forces = []
            for run in runs:
                inside = (run.time >= begin) & (run.time < end)
                force = run.force[inside][::thinning]
                forces.append([np.mean(force), np.max(force)])
            rate = 1 / (thinning * (runs[0].time[1] - runs[0].time[0]))
            row: dict[str, Any] = {"begin_s": begin, "end_s": end, "rate_Hz": rate}
            for family, (mean, peak) in zip(FAMILIES, forces, strict=True):
                row |= {f"{family}_mean_force_N": mean, f"{family}_max_force_N": peak}
            rows.append(row | {"misfit": np.max(np.abs(np.array(forces) / PAPER - 1))})
    return rows


def slices(
    pairs: Pairs, values: ArrayLike, changes: Sequence[float], notify: Notify
) -> list[dict[str, Any]]:
    """Each quantity changed alone by a share of itself: a row for each change."""
    rows = []
    for number, quantity in enumerate(QUANTITIES):
        for change in changes:
            at = np.array(values, float)
            at[number] *= 1 + change
            rows.append({"changed": quantity.key, "change": change})
            rows[-1] |= row_of(pairs(at, slopes=False))
        notify(f"{quantity.key} changed alone")
    return rows


def profile(
    pairs: Pairs,
    found: Response,
    step: float,
    count: int,
    within: float,
    limit: float,
    notify: Notify,
) -> list[dict[str, Any]]:
    """Each quantity moved away by factors of 1 ± `step`, `count` times at most each way, the
    others solved for again from where they were, until the misfit stays above `limit`: a row
    for each place. A misfit `within` is not lowered further."""
    rows = []
    for number, quantity in enumerate(QUANTITIES):
        for factor in (1 / (1 + step), 1 + step):
            last = found
            for _ in range(count):
                at = last.values[number] * factor
                if last.slopes is None or not quantity.low <= at <= quantity.high:
                    break
                guess = compensated(last.values, last.slopes, number, factor)
                last = polished(pairs, guess, held=[number], within=within, steps=4)
                change = last.values[number] / found.values[number] - 1
                rows.append({"changed": quantity.key, "change": change} | row_of(last))
                if last.misfit > limit:
                    break
        notify(f"{quantity.key} changed, the others solved for again")
    return rows
