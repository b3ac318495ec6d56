"""The outcome of a run: its gains, their price, and how certain they are.

Each command has a function that takes the content of the result file and the rows of a sweep, and
returns facts."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rootsopt.errors import InputError
from rootsopt.response.result import ERRORS
from rootsopt.response.terms import RESERVES, sense_of
from rootsopt.status import Status
from rootsopt.view.comparison import elsewhere, price
from rootsopt.view.names import (
    Record,
    brief,
    in_words,
    limit,
    listed,
    name_and_unit,
    quantity,
    scalars,
    signed,
    stated,
    varied,
)

Facts = list[tuple[str, str]]
"""Heading and sentences of each fact."""
STEADY = Status.PERIODIC.label, Status.AVERAGED.label, Status.IDLE.label
"""Statuses of a motion with a steady state."""
FEW = 6
"""Maximum number of quantities that a sentence names."""
_PEAK, _RESERVE = "peak_force_N", RESERVES[0]

# Absolute change (%) below which a quantity counts as unchanged.
_SMALL = 0.05

# Quantities that other sentences cover: displaced volume, area efficiency, outer radius, reserve.
_TOLD = "theoretical_flow_l_min", "area_mm2", "root_radius_mm", _RESERVE


def optimised(result: Record, rows: Sequence[Record]) -> Facts:
    """Return facts on an optimum; an empty list without one."""
    before, after = result.get("baseline") or {}, result.get("optimized") or {}
    if not after:
        return []
    changes = [*_changes(before, after)]
    better = [words for words, _, good in changes if good][:FEW]
    worse = sorted((one for one in changes if not one[2]), key=lambda one: -one[1])
    head, *over = [*_gains(result)] or [""]
    first = ": ".join(filter(None, [head, listed(better) if better else ""]))
    gained = [first or "no reported quantity is better", *over, *reserves(before, after)]
    met = [in_words(row["name"]) for row in result.get("constraints") or ()
           if row["satisfied"] and row.get("baseline_satisfied") is False]  # fmt: skip
    if met:
        gained.append(f"limits that the baseline violates are satisfied: {listed(met)}")
    more = [f"{len(worse) - FEW} others"] if len(worse) > FEW else []
    costs = [f"no reported quantity is worse by {_SMALL} % or more"]
    if worse:
        costs = [listed([words for words, *_ in worse[:FEW]] + more)]
    optimality = result.get("optimality") or {}
    doubts = [] if optimality.get("converged", True) else [str(optimality["message"])]
    sure = [_sentence([*_certified(result)]), *_touching(result), *doubts, *_advice_of(after)]
    spread = " ".join(elsewhere(result))
    return [
        ("Gained", _sentence(gained)),
        ("Costs", _sentence([*costs, *_prices(result)])),
        ("How sure", " ".join(sure)),
        *([("Other scenes", spread)] if spread else []),
    ]


def _sentence(parts: Sequence[str]) -> str:
    """Join parts to one sentence, with semicolons between them; "" without parts."""
    joined = "; ".join(parts)
    return f"{joined[:1].upper()}{joined[1:]}." if parts else ""


def _gains(result: Record) -> Iterator[str]:
    """Yield sentences on the change of the objective."""
    member = "that of the nominal member of the family, fitted to the baseline"
    for entry, whose in ("improvement", "the baseline's"), ("improvement_over_nominal", member):
        gain = (result.get(entry) or {}).get("objective")
        if gain is not None and math.isfinite(gain):
            side = f"{abs(100 * gain):.3g} % {'below' if gain > 0 else 'above'}"
            compared = side if abs(100 * gain) >= _SMALL else "the same as"
            yield f"the objective is {compared} {whose}"


def _changes(before: Record, after: Record) -> Iterator[tuple[str, float, bool]]:
    """Yield (words, size of the change in %, whether it is better) of each change."""
    parts = "response", "pump", "geometry"
    first, last = (
        {key: x for part in parts for key, x in scalars(one.get(part) or {}).items()}
        for one in (before, after)
    )
    for key, a in first.items():
        b, sense = last.get(key), _sense(key)
        if key in _TOLD or not sense or b is None or a is None:
            continue
        change = 100 * (b - a) / abs(a) if a else math.copysign(math.inf, b - a) if b else 0.0
        if abs(change) >= _SMALL:
            shown = signed(change, "%") if a else f"0 → {stated(key, b)}"
            yield f"{name_and_unit(key)[0]} {shown}", abs(change), (change < 0) == (sense == "min")


def _sense(key: str) -> str:
    """Return `min` or `max` for a quantity of which less or more is better, "" if not known."""
    if key.endswith("_force_N") or "leakage" in key:
        return "min"
    try:
        return "max" if key == "volumetric_efficiency" else sense_of(key)
    except InputError:
        return ""


def reserves(*records: Record) -> Iterator[str]:
    """Yield a phrase on the contact reserve, if any of the `records` holds it."""
    values = [(one.get("response") or {}).get("contact_reserve_um") for one in records]
    known = [quantity(x, "µm") for x in values if x is not None]
    if known:
        verb = "is" if len(known) == 1 else "goes from"
        yield f"the reserve against contact {verb} {' to '.join(known)}"


def _prices(result: Record) -> Iterator[str]:
    """Yield a phrase on the limits whose relaxation lowers the objective most."""
    limits = [row for row in result.get("constraints") or ()
             if (row.get("relaxed_objective_percent") or 0.0) < 0]  # fmt: skip
    limits.sort(key=lambda row: row["relaxed_objective_percent"])
    shown = [f"{limit(row)} ({price(row)})" for row in limits[:FEW]]
    if shown:
        rough = "" if (result.get("optimality") or {}).get("converged") else "rough "
        yield f"{rough}price of a limit, in objective: {listed(shown)}"


def _certified(result: Record) -> Iterator[str]:
    """Yield sentences on the certificate, on the simulation from rest, and on fresh scenes."""
    optimality, check = result.get("optimality") or {}, result.get("verification") or {}
    optima = optimality.get("optima") or ()
    if optimality:
        known = "a certified optimum" if optimality["converged"] else "not an optimum"
        required = f"at most {brief(optimality['required_residual'])} required"
        yield f"{known}: first-order residual {brief(optimality['residual'], 2)}, {required}"
    else:
        yield "the design has no certificate"
    if optimality.get("converged") and optima and not check.get("rejected"):
        yield f"{optima[0]['found']} of {len(optimality['starts'])} local searches found it"
    yield from _at_vertex(optimality.get("vertex") or {})
    yield from _bounded(optimality.get("global") or {})
    searched, verified = (check.get(f"{name}_objective") for name in ("searched", "verified"))
    if verified is not None and "combined_standard_error" in check:
        error = brief(check["combined_standard_error"], 2)
        yield f"an independent ensemble gives the objective {brief(verified)} ± {error}"
    elif searched and verified is not None and check.get("status") != Status.GEOMETRY_ONLY.label:
        away = brief(abs(verified / searched - 1), 2)
        yield f"simulated again from rest, its objective agrees to {away} (relative)"
    fresh: Mapping[str, Any] = (result.get("robustness") or {}).get("fresh") or {}
    if fresh:
        means = [f"{name} {quantity(x['objective'].get('mean'), '')}" for name, x in fresh.items()]
        lost = [f"{name} {100 * x['failed_share']:.3g} %" for name, x in fresh.items()]
        yield (
            f"mean objective in {next(iter(fresh.values()))['scenes']} fresh scenes that scatter: "
            f"{listed(means)}, without a usable motion: {listed(lost)}"
        )


def _at_vertex(known: Record) -> Iterator[str]:
    """Yield sentences on an optimum at a vertex, and on the next best one; `known`: the entry."""
    if not known:
        return
    yield (
        f"it is held by {listed(known['limits'])} alone, so that the objective only chooses "
        "between vertices of the limits"
    )
    usable = [one for one in known["others"] if one["objective"] is not None]
    if usable:
        which = listed(usable[0]["limits"])
        yield f"the next best vertex has {brief(usable[0]['objective'])} ({which})"


def _bounded(known: Record) -> Iterator[str]:
    """Yield what the lower bound `known` says about all designs within the bounds."""
    if known.get("lower_bound") is None:
        return
    gap, count = brief(known["gap"], 2), known["evaluations"]
    if known["proven"]:
        yield (
            f"no design within the bounds is better by more than {gap} (objective; lower bound "
            f"from {count} designs, if the objective bends at most {brief(known['factor'], 2)} "
            "times as much as between these)"
        )
    else:
        left = f"{100 * known['volume_left']:.2g} %"
        yield f"not proven to be the best: {left} of the bounds may hold a design better by {gap}"


def simulated(result: Record, rows: Sequence[Record]) -> Facts:
    """Return facts on one simulated design."""
    response, steady = result.get("response") or {}, result.get("steady_state") or {}
    mean, peak = response.get("mean_force_N"), response.get("peak_force_N")
    force, apart = [], result.get("status") == Status.IDLE.label
    if mean is not None and peak is not None and not apart:
        times = f", {peak / mean:.3g} times the mean" if mean > 0 else ""
        force.append(f"a mean of {brief(mean)} N and a peak of {brief(peak)} N{times}")
    force += [] if apart else reserves(result)
    if (teeth := response.get("gear_force_N")) is not None:
        force.append(f"the teeth of the timing gear carry up to {brief(teeth)} N")
    if steady.get("kind") == "periodic" and steady.get("period"):
        count = steady["period"]
        words = "every mesh period" if count == 1 else f"every {count} mesh periods"
        force.append(f"the motion repeats {words}")
    said = [str(result["message"])] if apart else []
    advice = [] if apart else _advice_of(result)
    facts = {
        "Flanks" if apart else "Contact force": [*said, _sentence(force)],
        "How sure": [_sentence([*_trust(steady, result)]), *_touching(result), *advice],
    }
    return [(head, " ".join(filter(None, told))) for head, told in facts.items() if any(told)]


def _touching(result: Record) -> list[str]:
    """Return a sentence on how many machines touch under tolerances, if this is known."""
    touching = result.get("touching")
    if not touching:
        return []
    worst = touching["keys"][0]["key"]
    return [
        f"Of {touching['machines']} machines within tolerances, "
        f"{100 * touching['touching_share']:.3g} % touch; "
        f"{name_and_unit(worst)[0]} costs most of the reserve."
    ]


def _trust(steady: Record, record: Record) -> Iterator[str]:
    """Yield how reliable the numbers of a simulated design are; `steady`: its steady state."""
    if steady.get("residual") is not None and steady.get("floquet_multiplier") is not None:
        yield f"the orbit is closed to a residual of {brief(steady['residual'], 2)}"
        yield f"its largest Floquet multiplier is {brief(abs(steady['floquet_multiplier']), 3)}"
    statistics = record.get("statistics") or {}
    if (error := statistics.get("force_error")) is not None and error > 0:
        yield f"its forces are known to {brief(error, 2)} (relative)"
    away = statistics.get("gradient_disagreement")
    if away is not None and record.get("gradient"):
        yield f"halving the steps changes its derivatives by {brief(away, 2)} (relative)"
    errors = {name: steady[key] for name, key in ERRORS.items() if steady.get(key) is not None}
    if errors:
        shown = (f"{name_and_unit(name)[0]} {quantity(x, 'N')}" for name, x in errors.items())
        yield f"standard errors: {listed([*shown])}"
    elif steady.get("window_mesh_periods"):
        yield f"the numbers are those of a window of {steady['window_mesh_periods']} mesh periods"


def _advice_of(record: Record) -> list[str]:
    """Return the caveats in a usable record's message, which follow the meaning of the status."""
    status = record.get("status") or record.get("evaluation_status")
    caveats = str(record.get("message") or "").partition(". ")[2]
    return [caveats] if caveats and status in STEADY else []


def traced(result: Record, rows: Sequence[Record]) -> Facts:
    """Return facts on a front."""
    points, aims = result.get("points") or [], result.get("terms") or []
    if not points:
        return []
    ranges = []
    for key in (aim["name"] for aim in aims):
        values = [point["terms"][key] for point in points]
        low, high = brief(min(values)), stated(key, max(values))
        ranges.append(f"{name_and_unit(key)[0]} from {low} to {high}")
    facts = [("Best compromises", f"{len(points)} points: {listed(ranges)}.")]
    rated = [one for one in points if any(x is not None for x in one["rates"].values())]
    if rated:
        point, first = rated[len(rated) // 2], aims[0]["name"]
        shown = []
        for key, rate in point["rates"].items():
            (name, unit), step = name_and_unit(key), 1 if name_and_unit(key)[1] else 0.01
            if rate is not None:
                change = signed(step * rate, name_and_unit(first)[1])
                shown.append(f"{change} for {signed(step, unit)} of {name}")
        costs = f"The {name_and_unit(first)[0]} at point {point['point']}: {listed(shown)}."
        facts.append(("Costs", costs))
    certified = result.get("status") != Status.NOT_CONVERGED.label
    return [*facts, ("How sure", str(result["message"]))] if certified else facts


def ranked(rows: Sequence[Record]) -> tuple[str, list[Record]]:
    """Return the quantity that ranks the rows of a sweep, and the rows that have it, worst first.

    It is the peak force or, if no flanks touch, the contact reserve."""

    def known(key: str, falling: bool) -> list[Record]:
        given = [row for row in rows if row.get(key) is not None and math.isfinite(row[key])]
        return sorted(given, key=lambda row: row[key], reverse=falling)

    peaks, reserves = known(_PEAK, True), known(_RESERVE, False)
    if reserves and not (peaks and peaks[0][_PEAK]):
        return _RESERVE, reserves
    return _PEAK, peaks


def swept(result: Record, rows: Sequence[Record]) -> Facts:
    """Return facts on a sweep: where the force or the reserve is least and greatest, how many are
    steady."""
    key, known = ranked(rows)
    axes, ends = varied(rows) if rows else [], []
    for word, pick in (("lowest", min), ("highest", max)) if known and axes else ():
        row = pick(known, key=lambda one: one[key])
        where = [stated(axis, row.get(axis), named=True) for axis in axes]
        ends.append(f"{word}, {stated(key, row[key])}, at {listed(where)}")
    statuses = [str(row.get("status")) for row in rows]
    steady = sum(one in STEADY for one in statuses)
    others = [f"{statuses.count(one)} {in_words(one)}" for one in {*statuses} - {*STEADY}]
    rest = f" The others: {listed(sorted(others))}." if others else ""
    sure = f"{steady} of {len(rows)} scenes have a steady state.{rest}"
    name = name_and_unit(key)[0].capitalize()
    extremes = [(name, f"It is {'; '.join(ends)}.")] if ends else []
    return [*extremes, ("How sure", sure)] if rows else []


def coexisting(result: Record, rows: Sequence[Record]) -> Facts:
    """Return facts on coexisting motions."""
    motions, words = result.get("attractors") or [], []
    for number, row in enumerate(motions[:FEW], start=1):
        peak = (row.get("response") or {}).get("peak_force_N")
        force = "no force known" if peak is None else f"peak force {brief(peak)} N"
        rest = ", reached from rest" if row.get("reached") else ""
        share = f"{100 * row['share']:.3g} % of the initial states"
        words.append(f"motion {number} ({in_words(row['status'])}): {force}, {share}{rest}")
    count = "one motion was found" if len(motions) == 1 else f"{len(motions)} motions coexist"
    lost = sum((result.get("lost") or {}).values())
    sure = "Every initial state of the grid leads to a reported motion."
    if lost:
        sure = f"{100 * lost:.3g} % of the initial states lead to no reported motion."
    return [("Motions", _sentence([count, *words])), ("How sure", sure)] if motions else []


def drawn(result: Record, rows: Sequence[Record]) -> Facts:
    """Return facts on a geometry."""
    shape, sheet = result["geometry"], result.get("pump") or {}
    keys = "displaced_volume_cm3", "flow_ripple"
    pumped = [stated(key, sheet[key], named=True) for key in keys if key in sheet]
    share = f"{100 * shape['area_efficiency']:.4g} % of the circle of this radius pumps"
    words = [stated("outer_radius_mm", shape["outer_radius_mm"], named=True), share, *pumped]
    return [("Rotor", _sentence(words)), ("How sure", str(result["message"]))]
