"""Compares the price of every limit with the optima found when the limit is moved.

In each case, the optimum of a config is found with its certificate. Each constraint or bound with a
multiplier is then moved by a small step in both directions, and the search starts again from the
screening. The central difference of the two optimal objectives is compared with the multiplier."""

from typing import NamedTuple

from experiments._common.driver import NoResultError, Run
from experiments._common.scenes import CIC
from experiments._common.tables import Row, show
from rootsopt.config import load
from rootsopt.optimize.optimality import RESIDUAL
from rootsopt.optimize.outcome import Optimization
from rootsopt.optimize.search import Search

# Relative difference of price and difference quotient below which they agree.
AGREES = 0.02

# Overrides of a reduced run.
QUICK = (
    "optimizer.screening=4",
    "optimizer.starts=1",
)


class Limit(NamedTuple):
    """A limit that is moved: its name in the report, its `value`, the `step`, and the override.

    `override`: text in which `{}` stands for the limit."""

    name: str
    value: float
    step: float
    override: str


class Case(NamedTuple):
    """Hold a config with active limits: its title, overrides of `CIC`, and limits to move."""

    title: str
    overrides: tuple[str, ...]
    limits: tuple[Limit, ...]


_AREA = Limit("area efficiency", 0.43446, 2e-4, "constraints.area_efficiency_min={}")
_SEAL = Limit("seal width", 2.0, 0.02, "constraints.seal_width_min_mm={}")
CASES = (
    Case(
        "shipped scene",
        (),
        (
            _AREA,
            _SEAL,
            Limit(
                "lower bound of involute length",
                *(0.8, 0.05),
                "optimizer.bounds.involute_length_mm=[{}, 30]",
            ),
        ),
    ),
    Case(
        "narrow bounds of the pressure angle",
        (),
        (
            Limit(
                "lower bound of pressure angle",
                *(28.0, 0.1),
                "optimizer.bounds.pressure_angle_deg=[{}, 45]",
            ),
        ),
    ),
    Case(
        "two lobes: equal peaks",
        ("profile.lobes=2",),
        (Limit("area efficiency", 0.50884, 2e-4, "constraints.area_efficiency_min={}"),),
    ),
    Case(
        "mean force, ceiling of the peak",
        ("objective.peak_weight=0",),
        (Limit("peak force", 205.0, 0.5, "constraints.terms.peak_force_N.max={}"),),
    ),
    Case(
        "floor of the displaced volume",
        ("constraints.area_efficiency_min=0.3",),
        (Limit("displaced volume", 540.0, 0.5, "constraints.terms.displaced_volume_cm3.min={}"),),
    ),
)


def _solved(title: str, overrides: list[str]) -> Optimization:
    found = Search(load(CIC, overrides)).run()
    if found.optimality is None or not found.optimality.converged:
        raise NoResultError(
            f"{title}: the search with {', '.join(overrides)} ended as {found.status.label}, "
            f"but a residual below {RESIDUAL:g} is needed"
        )
    return found


def _value(found: Optimization) -> float:
    assert found.problem is not None
    assert found.optimized is not None
    return found.problem.objective(found.optimized)


def _price(found: Optimization, one: Limit, title: str) -> float:
    for row in found.constraints:
        if row["name"] == one.name and row.get("multiplier"):
            return row["multiplier"]
    raise NoResultError(f"{title}: {one.name} has no price at the optimum")


def run(job: Run) -> bool:
    """Compare price and difference quotient of every limit of all cases; write a row for each.

    A reduced run takes the first limit of the first case, from one start. Raises `NoResultError` if
    a search ends without a certificate, or if a limit has no price. Returns whether all agree."""
    rows: list[Row] = []
    for case in CASES[:1] if job.quick else CASES:
        held = [*case.overrides, *(one.override.format(one.value) for one in case.limits)]
        least = QUICK if job.quick else ()
        middle = _solved(case.title, [*held, *least])
        for one in case.limits[:1] if job.quick else case.limits:
            # The last of several overrides of a key counts.
            ends = [
                _value(_solved(case.title, [*held, one.override.format(value), *least]))
                for value in (one.value - one.step, one.value + one.step)
            ]
            price, quotient = _price(middle, one, case.title), (ends[1] - ends[0]) / (2 * one.step)
            rows.append(
                {
                    "case": case.title,
                    "limit": one.name,
                    "value": one.value,
                    "step": one.step,
                    "objective": _value(middle),
                    "price": price,
                    "by_moving": quotient,
                    "difference": abs(price / quotient - 1) if quotient else float("nan"),
                }
            )
            job.say(f"{case.title}, {one.name}: {price:.5g}, by moving {quotient:.5g}")
    job.csv("prices.csv", rows)
    show("Change of the objective per unit of a limit", rows)
    return all(row["difference"] <= AGREES for row in rows)
