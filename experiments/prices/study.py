"""Compares the price of every limit with the optima found when the limit is moved.

In each case, the optimum of a config is found with its certificate. Each constraint or bound with a
multiplier is then moved by a small step in both directions, and the search starts again from the
screening. The central difference of the two optimal objectives is compared with the multiplier."""

from collections.abc import Callable
from typing import Any, NamedTuple

from experiments._common.driver import NoResultError
from experiments._common.scenes import CIC
from rootsopt.config import load
from rootsopt.optimize.optimality import RESIDUAL
from rootsopt.optimize.outcome import Optimization
from rootsopt.optimize.search import Search

Row = dict[str, Any]
AGREES = 0.02
"""Relative difference of price and difference quotient below which they agree."""
QUICK = (
    "optimizer.screening=4",
    "optimizer.starts=1",
)
"""Overrides of a reduced run."""


class Limit(NamedTuple):
    """A limit that is moved: its name in the report, its `value`, the `step`, and the override.

    `override`: text in which `{}` stands for the limit."""

    name: str
    value: float
    step: float
    override: str


class Case(NamedTuple):
    """A config with active limits: title, overrides of configs/cic.yaml, and limits to move."""

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


def run(quick: bool, say: Callable[[str], None] = lambda text: None) -> list[Row]:
    """Return one row per limit of all cases, with price and difference quotient.

    `quick`: only the first limit of the first case, from one start. Raises `NoResultError` if a
    search ends without a certificate, or if a limit has no price."""
    rows: list[Row] = []
    for case in CASES[:1] if quick else CASES:
        least = QUICK if quick else ()
        held = [one.override.format(one.value) for one in case.limits]
        middle = _solved(case.title, [*case.overrides, *held, *least])
        for k, one in enumerate(case.limits[:1] if quick else case.limits):
            price = _price(middle, one.name, case.title)
            ends = []
            for side in (-1, 1):
                moved = one.override.format(one.value + side * one.step)
                ends.append(_value(_solved(case.title, [
                    *case.overrides, *held[:k], moved, *held[k + 1 :], *least])))  # fmt: skip
            quotient = (ends[1] - ends[0]) / (2 * one.step)
            rows.append(_row(case, one, middle, price, quotient))
            say(f"{case.title}, {one.name}: {price:.5g} by multiplier, {quotient:.5g} by moving")
    return rows


def _row(case: Case, one: Limit, middle: Optimization, price: float, quotient: float) -> Row:
    assert middle.optimality is not None
    return {
        "case": case.title,
        "limit": one.name,
        "value": one.value,
        "step": one.step,
        "objective": _value(middle),
        "price": price,
        "by_moving": quotient,
        "difference": abs(price / quotient - 1) if quotient else float("nan"),
        "equal_peaks": len(middle.optimality.holders),
        "residual": middle.optimality.certificate.residual,
    }


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


def _price(found: Optimization, name: str, title: str) -> float:
    for row in found.constraints:
        if row["name"] == name and row.get("multiplier"):
            return row["multiplier"]
    raise NoResultError(f"{title}: {name} has no price at the optimum")


def kept(rows: list[Row]) -> bool:
    """Return whether all prices agree with the optima of moved limits."""
    return all(row["difference"] <= AGREES for row in rows)
