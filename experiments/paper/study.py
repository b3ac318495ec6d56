"""Simulates the paper's scene, and studies how far its forces determine the omitted quantities.

Section 4 of the paper gives the mean and maximum contact force of a CIC and an EE pair. It does not
give the rotors' length, load, timing gear or backlash. `run` simulates the values of
`configs/paper_cic.yaml` and `configs/paper_ee.yaml` from rest. It searches for coexisting motions,
and applies other definitions of mean and maximum. It changes each quantity alone, then with the
others solved for again. `search` searches for other values in the box of plausible ones.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from experiments._common.driver import NoResultError, Run
from experiments._common.scenes import FORCES
from experiments._common.simulation import evaluator_of
from experiments._common.tables import Row, show
from experiments.paper.scene import (
    FAMILIES,
    PAPER,
    QUANTITIES,
    Response,
    compensated,
    config_of,
    polished,
    respond,
)
from rootsopt.dynamics.window import PERIODS
from rootsopt.identification.fit import identify
from rootsopt.response import attractors
from rootsopt.response.evaluation import lyapunov_program, unsettled_status
from rootsopt.response.records import unsettled
from rootsopt.scene import design_vector
from rootsopt.status import Status

# Windows (start, end in s) over which the paper may have taken mean and maximum.
WINDOWS = ((0.0, 0.1), (0.0, 0.2), (0.05, 0.2), (0.1, 0.2), (0.1, 0.8))

# Sampling rates the paper may have used: every n-th sample of the window.
THINNINGS = (1, 3, 15)

# Overrides that set the grid of initial states in the search for coexisting motions.
GRID = ("attractors.relatives=24", "attractors.rates=18")

# Other values of the quantities, found by searches. The study solves them for the paper's forces
# again.
OTHERS = {
    "tight play": (330.0, 5.6142, 7252.4, 0.77, 0.41829, 0.076577),
    "low gear damping": (361.942, 6.5715, 27871.46, 0.6085, 0.8734, 0.225),
    "short rotor": (253.46, 5.6804, 16489.5, 0.9866, 1.0063, 0.2879),
    "light load": (300.23, 0.21735, 31959.0, 0.93524, 0.99737, 0.29273),
}

# Relative changes of each quantity alone. Keys: whether the run is reduced.
CHANGES = {False: (-0.1, -0.05, -0.02, -0.01, 0.01, 0.02, 0.05, 0.1), True: (-1e-3, 1e-3)}

# Relative step of a quantity along its profile (see `profile`), and maximum number of steps in
# each direction.
STEP, COUNT = 0.04, 6

# Misfit below which a point of the profile is accepted, and misfit above which the profile ends.
WITHIN, LIMIT = 5e-3, 0.03

# Relative error of a force above which a search has no result.
TARGET = 0.1

# Number of local fits of a search.
STARTS = 8
Say = Callable[[str], None]


def motions(values: ArrayLike) -> Iterator[Row]:
    """Find the coexisting motions with these values; yield a row per motion."""
    for family in FAMILIES:
        found = attractors.find(evaluator_of(config_of(family, values, *GRID)))
        lost = ({"status": k, "share": v} for k, v in found.lost.items())
        yield from ({"pair": family} | row for row in (*found.summary(), *lost))


def definitions(values: ArrayLike) -> Iterator[Row]:
    """Apply definitions of mean and maximum to one motion from rest, with and without start-up.

    Yields a row per window and sampling rate.
    """
    runs = []
    for family in FAMILIES:
        evaluator = evaluator_of(config_of(family, values))
        pair = evaluator.pair(design_vector(evaluator.config))
        how = evaluator.scene.solver.transient
        window = jax.device_get(lyapunov_program(pair, np.zeros(2), PERIODS, how))
        status = Status.of(int(unsettled_status(pair, window)))
        *_, series = unsettled(pair, status, window, series=True)
        assert series is not None
        runs.append(series)
    for (begin, end), thinning in itertools.product(WINDOWS, THINNINGS):
        rate = 1 / (thinning * (runs[0].time[1] - runs[0].time[0]))
        row: Row = {"begin_s": begin, "end_s": end, "rate_Hz": rate, "misfit": 0.0}
        for family, run, paper in zip(FAMILIES, runs, PAPER, strict=True):
            force = run.force[(run.time >= begin) & (run.time < end)][::thinning]
            own = np.array([np.mean(force), np.max(force)])
            row |= dict(zip((f"{family}_mean_force_N", f"{family}_max_force_N"), own, strict=True))
            row["misfit"] = np.maximum(row["misfit"], np.max(np.abs(own / paper - 1)))
        yield row


def slices(values: np.ndarray, changes: Sequence[float], say: Say) -> Iterator[Row]:
    """Change each quantity alone by the relative `changes`; yield a row per change."""
    for quantity, unit in zip(QUANTITIES, np.eye(len(QUANTITIES)), strict=True):
        for change in changes:
            row = {"changed": quantity.key, "change": change}
            yield row | row_of(respond(values * (1 + change * unit), slopes=False))
        say(f"{quantity.key} changed alone")


def profile(found: Response, say: Say) -> Iterator[Row]:
    """Move each quantity away from its value, and solve for the other quantities again.

    Each solution starts from the last solution. A quantity moves by factors of 1 ± `STEP`, at most
    `COUNT` times in each direction, until the misfit stays above `LIMIT`. Yields a row per point.
    """
    for number, quantity in enumerate(QUANTITIES):
        for factor in (1 / (1 + STEP), 1 + STEP):
            last = found
            for _ in range(COUNT):
                at = last.values[number] * factor
                if last.slopes is None or not quantity.low <= at <= quantity.high:
                    break
                guess = compensated(last.values, last.slopes, number, factor)
                last = polished(guess, held=[number], within=WITHIN, steps=4)
                change = last.values[number] / found.values[number] - 1
                yield {"changed": quantity.key, "change": change} | row_of(last)
                if last.misfit > LIMIT:
                    break
        say(f"{quantity.key} changed, the others solved for again")


def row_of(response: Response) -> Row:
    """Return a row with values, forces, periods and misfit of a response."""
    row: Row = {q.key: v for q, v in zip(QUANTITIES, response.values, strict=True)}
    for family, (mean, peak), one in zip(
        FAMILIES, response.forces, response.evaluations, strict=True
    ):
        row |= {
            f"{family}_status": one.status.label,
            f"{family}_period": int(one.steady_state.get("period", 0)),
            f"{family}_multiplier": one.steady_state.get("floquet_multiplier"),
            f"{family}_mean_force_N": mean,
            f"{family}_peak_force_N": peak,
        }
    return row | {"misfit": response.misfit}


def run(job: Run) -> bool:
    """Simulate the shipped values or, with --search, search for other values."""
    return search(job) if job.options.search else reproduce(job)


def reproduce(job: Run) -> bool:
    """Simulate the shipped values, and study how far the paper's forces determine them.

    A reduced run only changes each quantity alone. Raises `NoResultError` unless both motions are
    periodic.
    """
    from experiments.paper import figures

    values = [config_of("cic").value(quantity.key) for quantity in QUANTITIES]
    found = respond(values, not job.quick, series=True, give_up_early=False)
    if not all(one.status is Status.PERIODIC for one in found.evaluations):
        raise NoResultError("the shipped values must give two periodic motions, but do not")
    responses = {"shipped": found}
    tables = {"slices": [*slices(found.values, CHANGES[job.quick], job.say)]}
    if not job.quick:
        responses |= {name: polished(start) for name, start in OTHERS.items()}
        tables["motions"] = [*motions(found.values)]
        tables["definitions"] = [*definitions(found.values)]
        tables["profile"] = [*profile(found, job.say)]
    record: dict[str, Any] = {name: row_of(one) for name, one in responses.items()}
    if found.slopes is not None:
        singular = np.linalg.svd(found.slopes.reshape(4, -1))
        record |= {"singular_values": singular[1], "free_directions": singular[2][4:]}
        record["slopes"] = dict(zip(FAMILIES, found.slopes, strict=True))
    for name, rows in tables.items():
        job.csv(f"paper_{name}.csv", rows)
    job.csv("paper.csv", [row_of(found)])
    job.json("paper.json", record)
    made = figures.uniqueness_figure(tables["slices"], tables.get("profile", []))
    for name, one in zip(job.published, (*figures.force_figures(found), made), strict=True):
        job.figure(name, one)
    show("Values, forces and motions", [{"": k} | row_of(one) for k, one in responses.items()])
    return True


def search(job: Run) -> bool:
    """Search for other values of the quantities by `identify`; write and print the best.

    It begins at the shipped values. A reduced run makes one local fit. Returns whether some values
    give all four forces within the relative error `TARGET`."""
    seed, least = job.options.seed, job.options.least_clearance
    bounds = {q.key: (q.low, q.high) for q in QUANTITIES}
    bounds[QUANTITIES[-1].key] = least or QUANTITIES[-1].low, QUANTITIES[-1].high
    config = config_of("cic")
    record = {
        "profile.family": [*FAMILIES],
        **{f"profile.{key}": [x, None] for key, x in config.profile.parameters.items()},
        **dict(zip(FORCES, PAPER.T, strict=True)),
    }
    found = identify(
        config, record, bounds, starts=1 if job.quick else STARTS, seed=seed, progress=job.say
    )
    best = {key: one["value"] for key, one in found.parameters.items()}
    rows = [{"misfit": found.fit["relative_misfit"]} | best] if best else []
    rows += [{"misfit": one["relative_misfit"]} | one["values"] for one in found.optima]
    job.json("paper_search.json", {"seed": seed, "solved": rows} | found.record())
    show("Values that give the paper's forces", rows)
    return any(row["misfit"] <= TARGET for row in rows)
