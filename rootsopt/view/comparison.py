"""Tables and sentences on an optimum: comparison with the baseline, limits, certificate.

Also on the nearest profiles, on a fit to a record (`rootsopt identify`), and on an optimum over
assumed values of the scene."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rootsopt.config.units import MICROMETRE, NAMES
from rootsopt.view.names import (
    DASH,
    Cell,
    Record,
    Row,
    Table,
    brief,
    in_words,
    label,
    limit,
    listed,
    name_and_unit,
    percent,
    quantity,
    signed,
    stated,
    table,
    value,
)

# Length (mm) below which sentences state it in µm.
_MICRO = 0.1

# Estimated share of further starts with a new optimum above which more starts are recommended.
_UNSURE = 0.5


def assumption_tables(result: Mapping[str, Any]) -> Iterator[Table | None]:
    """Yield the objective at both ends of each range, and its statistics in random scenes."""
    comparison = result.get("assumptions")
    if not comparison:
        return
    rows = [
        [label_of(row["key"]), value(row["low"]), value(row["high"]),
         *(_cell(row[f"objective_{end}"]) for end in ("low", "high")),
         value(row["rank_correlation"])]
        for row in comparison["keys"]
    ]  # fmt: skip
    heads = "", "low", "high", "at low", "at high", "rank"
    note = (
        "At low, at high: objective relative to the baseline in the same scene, all else as given. "
        "Rank: correlation of the objective with the quantity over the random scenes (Spearman)."
    )
    yield table("The optimum where the pump may run", heads, [("", rows)], note)
    levels = comparison["objective_quantiles"]
    spread = {f"objective, {name_and_unit(level)[0]}": x for level, x in levels.items()}
    worst = comparison["worst"] or {}
    spread |= {"objective, worst of all scenes": worst.get("objective")}
    rows = [["better than the baseline", _share(comparison)]]
    rows += [[name, _cell(x)] for name, x in spread.items()]
    title = f"The optimum in {comparison['compared']} random scenes"
    yield table(title, ("", "optimised"), [("", rows)])


def _share(row: Mapping[str, Any]) -> str:
    share = row["share_better"]
    return DASH if share is None else f"{100 * share:.3g} %"


def _cell(objective: float | None) -> Cell:
    return Cell(value(objective), None if objective is None else objective < 1)


def elsewhere(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences that compare the optimum with the baseline in other scenes.

    The scenes are those of `assumptions`. Yield nothing if the result has no such comparison."""
    comparison = result.get("assumptions")
    if not comparison:
        return
    compared, ends = comparison["compared"], comparison["ends_compared"]
    if not compared:
        yield "No random scene within the assumptions can be compared."
    else:
        better = round(comparison["share_better"] * compared)
        low, high = (comparison["objective_quantiles"][f"quantile_{k}"] for k in (5, 95))
        yield (
            f"The optimum is better than the baseline in {better} of {compared} random scenes "
            f"within the assumptions and at {comparison['ends_better']} of {ends} ends of their "
            f"ranges: objective {brief(low, 3)} to {brief(high, 3)} (5 % to 95 % of the random "
            f"scenes), at worst {brief(comparison['worst']['objective'], 3)}."
        )
    worse = [
        _region(row | {"better": row["worse"]}, comparison)
        for row in comparison["keys"]
        if row["worse"]
    ]
    if worse:
        yield f"All else as given, it is worse {listed(worse)}."
    elif compared and comparison["share_better"] < 1:
        row = _row(comparison["decides"], comparison)
        yield f"Its objective rises most with {_sense(row)}."
    known = (result.get("robustness") or {}).get("nominal") or {}
    nominal = (known.get("optimized") or {}).get("design")
    for one in comparison["rivals"]:
        shape = ", ".join(
            f"{name_and_unit(k)[0]} {_stated(k, x)}" for k, x in one["design"].items()
        )
        region = _region(one, comparison)
        where = f" and, all else as given, {region}" if region else f", mostly with {_sense(one)}"
        share = f"{_share(one)} of the random scenes"
        name = "The nominal optimum" if one["design"] == nominal else "Another design"
        yield f"{name} ({shape}) is better than the optimum in {share}{where}."
    if comparison["not_compared"]:
        counts = Counter(
            f"baseline {in_words(row['status_baseline'])}, "
            f"optimum {in_words(row['status_optimized'])}"
            for row in comparison["not_compared"]
        )
        told = [f"{count} ({words})" for words, count in counts.items()]
        yield f"Scenes that cannot be compared: {listed(told)}."


def _row(key: str, comparison: Mapping[str, Any]) -> Mapping[str, Any]:
    return next(row for row in comparison["keys"] if row["key"] == key)


def _sense(row: Mapping[str, Any]) -> str:
    """Return the change of a quantity that raises the objective, with the rank correlation."""
    rank = row["rank_correlation"] or 0.0
    word = "more" if rank > 0 else "less"
    return f"{word} {named(row['key'])} (rank correlation {brief(rank, 2)})"


def _region(row: Mapping[str, Any], comparison: Mapping[str, Any]) -> str:
    """Return where a design is better (`row`: key and parts of its range), in words."""
    key, span = row["key"], _row(row["key"], comparison)
    parts = [_part(key, piece, span) for piece in row["better"]]
    return f"where the {named(key)} {' or '.join(parts)}" if parts else ""


def _part(key: str, piece: Sequence[float], span: Mapping[str, Any]) -> str:
    start, stop = (_stated(key, x) for x in piece)
    below, above = piece[0] == span["low"], piece[1] == span["high"]
    phrases = {
        (True, True): "has any value",
        (True, False): f"is below {stop}",
        (False, True): f"is above {start}",
        (False, False): f"is between {start} and {stop}",
    }
    return f"is {start}" if start == stop else phrases[below, above]


def _stated(key: str, given: float) -> str:
    unit = name_and_unit(key)[1]
    if unit == "mm" and abs(given) < _MICRO:
        return f"{brief(1e3 * given, 2)} µm"
    return quantity(float(f"{given:.3g}"), unit)


def named(key: str) -> str:
    """Return the name of an assumed quantity in words."""
    return NAMES.get(key) or name_and_unit(key)[0]


def label_of(key: str) -> str:
    """Return the name of an assumed quantity, with its unit in parentheses."""
    unit = name_and_unit(key)[1]
    return f"{named(key)} ({unit})" if unit else named(key)


WORTH = 1e-4
"""Relative decrease of the objective below which a rotor does not count as better."""
NOTHING_BETTER = (
    "With the same displacement, outer diameter and seal width, the family of the search has no "
    "better rotor: try `--set optimizer.family=free_form`, or allow a narrower tip land with "
    "`--set constraints.seal_width_min_mm`."
)
"""Message of a search that has found no better rotor."""

# Quantities that are compared, by the entry of a record that holds them.
_ROWS = (
    ("response", ("mean_force_N", "peak_force_N")),
    ("pump", ("volumetric_efficiency", "flow_ripple", "displaced_volume_cm3")),
    ("geometry", ("seal_width_mm",)),
)


def better_tables(result: Mapping[str, Any]) -> Iterator[Table | None]:
    """Yield the comparison of a file's rotor with a better one, and the gain left after errors.

    Yield nothing unless the run is one of `rootsopt improve` that has found a better rotor."""
    told, pair = result.get("improve"), [result.get(key) or {} for key in ("baseline", "optimized")]
    if not (told and pair[1]):
        return
    gain = (result.get("improvement") or {}).get("objective")
    inset, numbers = told["inset_mm"], {}
    numbers[f"objective ({', '.join(told['aims'])})"] = 1.0, None if gain is None else 1 - gain
    for part, keys in _ROWS:
        numbers |= {label(key): [(one.get(part) or {}).get(key) for one in pair] for key in keys}
    outer = [2 * (one["geometry"]["outer_radius_mm"] - inset) for one in pair]
    numbers |= {"outer diameter as cut (mm)": outer, "inset of the flanks (mm)": [inset, inset]}
    designs = {label(key): [one["design"].get(key) for one in pair] for key in pair[1]["design"]}
    fit, family = told["fit"], result.get("beginning") or told["fit"]
    groups: list[tuple[str, list[Row]]] = [
        (
            name,
            [[key, *map(value, (a, b)), percent(a, b)] for key, (a, b) in given.items() if a or b],
        )
        for name, given in (("", numbers), (f"family {in_words(family['family'])}", designs))
    ]
    note = f'"Your rotor" is the {in_words(fit["family"])} profile that is nearest to the outline, '
    note += f"at most {fit['departure_um']:.2g} µm from it, not the outline itself."
    if gain is not None and abs(gain) < WORTH:
        note += f" {NOTHING_BETTER}"
    heads = "", "your rotor", "a better one", "change"
    yield table("Your rotor against a better one", heads, groups, note)
    rows: list[Row] = [
        [one["case"], *map(value, (one["baseline"], one["optimized"])),
         percent(one["baseline"], one["optimized"]),
         DASH if one["share"] is None else f"{100 * one['share']:.3g} %"]
        for one in told["cases"]
    ]  # fmt: skip
    heads = "both rotors", "your rotor", "a better one", "change", "share of the gain"
    yield table("The objective with errors of manufacture", heads, [("", rows)], told["message"])


def identified_tables(result: Mapping[str, Any]) -> Iterator[Table | None]:
    """Yield fitted quantities, what the record leaves open, and helpful further measurements."""
    known = result.get("parameters")
    if not known:
        return
    rows: list[Row] = [
        [label_of(key), value(one["value"]), value(one["standard_error"]),
         " … ".join(map(value, one["interval_95"])),
         Cell(f"at the {one['at_bound']} bound", False) if one["at_bound"] else ""]
        for key, one in known.items()
    ]  # fmt: skip
    heads = "", "value", "standard error", "95 % interval", ""
    yield table("Quantities that fit the record", heads, [("", rows)], str(result["message"]))
    rows = [[one["words"], value(one["standard_error"]),
             Cell("determined", True) if one["determined"] else Cell("not determined", False)]
            for one in result["combinations"]]  # fmt: skip
    note = "Standard error: as a share of the range in which the search begins."
    yield table("Combinations of the quantities", ("", "standard error", ""), [("", rows)], note)
    rows = [[", ".join(stated(key, x, named=True) for key, x in one["at"].items()) or "the config",
             value(one["period"]), value(one["floquet_multiplier"]),
             "from rest" if one["reached_from_rest"] else Cell("not from rest", False),
             value(one["other_motions"])]
            for one in result["motions"]]  # fmt: skip
    heads = "at", "period (mesh periods)", "largest multiplier", "reached", "others that coexist"
    yield table("Motions that the record shows", heads, [("", rows)])
    rows = [[f"{name_and_unit(one['column'])[0]} at {one['scene.speed_rpm']:g} rpm",
             *map(value, one["standard_errors"].values())]
            for one in result["further"]]  # fmt: skip
    note = "Standard errors if this is measured as well, over a turn, with the record's error."
    yield table("What to measure next", ("", *map(label_of, known)), [("", rows)], note)
    rows = [[f"{100 * one['relative_misfit']:.3g} %", *map(value, one["values"].values())]
            for one in result["optima"]]  # fmt: skip
    title = "Other scenes that fit nearly as well"
    yield table(title, ("misfit", *map(label_of, known)), [("", rows)])


def identified(
    result: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]
) -> list[tuple[str, str]]:
    """Return facts on a fit to a record."""
    fitted = []
    for key, one in (result.get("parameters") or {}).items():
        (name, unit), error = name_and_unit(key), one["standard_error"]
        if error is None:
            fitted.append(f"{name} {quantity(one['value'], unit)} (not determined)")
        else:
            fitted.append(f"{name} {brief(one['value'])} ± {brief(error, 2)} {unit}".strip())
    said = str(result["message"]).partition(". ")[2]
    return [("Found", f"{listed(fitted)}."), ("How sure", said)] if fitted else []


def constraint_table(result: Record) -> Table | None:
    """Return the constraints of an optimisation, with the price of each limit."""
    rows = []
    for row in result.get("constraints") or ():
        word = "met by all" if row.get("always") else "active" if row.get("active") else "satisfied"
        verdict = Cell(word if row["satisfied"] else "violated", bool(row["satisfied"]))
        before = Cell(value(row["baseline"]))
        if row.get("baseline_satisfied") is False:
            own = row.get("baseline_limit")
            beyond = "violated" if own is None else f"> {value(own)}"
            before = Cell(f"{before.text} {beyond}", False)
        rows.append([limit(row), before, value(row["optimized"]), verdict, price(row)])
    heads = "", "baseline", "optimised", "verdict", "price of a limit"
    note = (
        "Price: change of the objective if the limit is relaxed by the step, to first order. An "
        "empty price: the limit does not hold the optimum back."
    )
    optimality = result.get("optimality") or {}
    if optimality and not optimality.get("converged"):
        note += " The design is no optimum, so prices are rough."
    return table("Constraints", heads, [("", rows)], note)


def price(row: Record) -> str:
    """Return the price of a limit in words: the change of the objective for a step of the limit."""
    change = row.get("relaxed_objective_percent")
    if change is None or not row.get("multiplier"):
        return ""
    return f"{signed(change, '%')} for {signed(row['relaxed_by'], row.get('unit') or '')}"


def certificate_tables(result: Record) -> Iterator[Table | None]:
    """Yield tables on the optimum: conditions, active branches, starts, sensitivities."""
    optimality = result.get("optimality")
    if not optimality:
        return
    good = bool(optimality["converged"])
    conditions: list[Row] = [
        ["residual of the first-order conditions (of the unit box)",
         Cell(value(optimality["residual"]), good),
         f"at most {value(optimality['required_residual'])}"],
        ["better nearby, promised (relative)", value(optimality.get("promised_decrease"))],
        ["violation of a constraint (scaled)", value(optimality["violation"]), "0"],
        ["why the search stopped", Cell(in_words(optimality["reason"]), good)],
        ["method", str(optimality["method"])],
    ]  # fmt: skip
    heads = "", "value", "at an optimum"
    yield table("First-order conditions", heads, [("", conditions)], optimality["message"])
    held = [_held(one) for one in optimality.get("held_by") or ()]
    note = "Peaks, speeds or motions that are equal at the optimum: none falls alone."
    heads = "branch", "share", "its objective"
    yield table("What holds the optimum", heads, [("", held if len(held) > 1 else [])], note)
    starts: list[Row] = [
        [f"start {one['start']}", Cell(in_words(one["reason"]), one["reason"] == "converged"),
         str(one["evaluations"]), value(one["objective"])]
        for one in optimality.get("starts") or ()
    ]  # fmt: skip
    optima: list[Row] = [
        [f"optimum {number}", f"found by {one['found']} of {len(starts)} starts", "",
         value(one["objective"])]
        for number, one in enumerate(optimality.get("optima") or (), start=1)
    ]  # fmt: skip
    heads = "", "why it ended", "designs", "objective"
    groups = [("starts", starts), ("distinct optima", optima)]
    whole = optimality.get("global")
    proven = whole is not None and whole["proven"]
    yield table("Local searches", heads, groups, "" if proven else _unseen(optimality))
    yield _whole(whole) if whole else None
    yield _vertices(result) if "vertex" in optimality else None
    rows = [_sensitive(one) for one in optimality.get("sensitivities") or ()]
    heads = "", "mean force (N)", "peak force (N)", "objective (%)"
    note = "What a small change of the scene does to the optimised design."
    yield table("Sensitivity to the scene", heads, [("", rows)], note)


def _vertices(result: Record) -> Table | None:
    """Return the table on the vertices of the limits, the best first."""
    known, own = result["optimality"]["vertex"], result["optimized"]["design"]
    rows: list[Row] = [
        [*map(value, one["design"].values()), value(one["objective"]), ", ".join(one["limits"])]
        for one in known["others"]
    ]
    rows.insert(0, [*map(value, own.values()), "optimum", ", ".join(known["limits"])])
    heads = [*map(label, own), "objective", "held by"]
    note = "Where as many limits meet as there are parameters, the objective only chooses a vertex."
    return table("Vertices of the limits", heads, [("", rows)], note)


def _whole(bound: Record) -> Table | None:
    """Return the table on the lower `bound` of all designs within the bounds."""
    rows: list[Row] = [
        ["lower bound of the objective", value(bound["lower_bound"])],
        ["distance of the optimum from it", Cell(value(bound["gap"]), bool(bound["proven"]))],
        ["designs", str(bound["evaluations"])],
        ["designs without a usable motion", str(bound["unusable"])],
        ["jumps between motions", str(bound["jumps"])],
        ["regions left", str(bound["regions_left"])],
        ["their share of the bounds", f"{100 * bound['volume_left']:.2g} %"],
    ]
    return table("All designs within the bounds", ("", "value"), [("", rows)], bound["assumption"])


def _held(one: Record) -> Row:
    speed, rotation = one.get("speed_rpm"), one.get("rotation_deg")
    parts = [
        "" if speed is None else stated("speed_rpm", speed),
        f"scene {one['scene']} of the sample" if "scene" in one else "",
        "" if rotation is None else f"peak of {value(one['force_N'])} N at {rotation:.2f}°",
    ]
    name = ", ".join(filter(None, parts)) or "motion"
    return [name, f"{one['share']:.3f}", value(one["objective"])]


def _unseen(optimality: Record) -> str:
    share = (optimality.get("unseen") or {}).get("share_of_starts")
    if share is None:
        return "So few starts do not tell how many optima are left to find: raise optimizer.starts."
    more = ": raise optimizer.starts" if share > _UNSURE else ""
    return (
        f"About {brief(100 * share, 2)} % of further starts would find an optimum that no start "
        f"has found yet{more}."
    )


def _sensitive(one: Record) -> Row:
    step = "+1 µm" if one["unit"] == "mm" and one["step"] == MICROMETRE else "+1 %"
    keys = "mean_force_N", "peak_force_N", "objective_percent"
    changes = (value(None) if one.get(key) is None else signed(one[key], "") for key in keys)
    return [f"{one['quantity']} {step}", *changes]


def rejected_table(result: Record) -> Table | None:
    """Return the designs that did not hold up when simulated again from rest, or None."""
    rows = []
    for row in (result.get("verification") or {}).get("rejected") or ():
        same = row["verified_objective"] is not None
        reason = "another motion" if same else in_words(row["status"])
        reason = Cell(f"{reason} ({len(row['attempts'])} attempts)", good=False)
        numbers = (value(row[f"{word}_objective"]) for word in ("searched", "verified"))
        rows.append([_design(row["design"]), *numbers, reason])
    heads = "design", "objective in the search", "from rest", "reason"
    return table("Rejected designs", heads, [("", rows)])


def _design(design: Mapping[str, float]) -> str:
    return ", ".join(f"{label(key)} {value(x)}" for key, x in design.items())


def likeness_tables(result: Record) -> list[Table | None]:
    """Return the family members nearest to the result's profile, and to an outline from a file."""
    begun = result.get("beginning") or {}
    return [
        _likeness("Nearest profiles of the families", result.get("resembles") or (), ""),
        _likeness("Nearest to the outline of the baseline", begun.get("considered") or (),
                  begun.get("message", "")),
    ]  # fmt: skip


def _likeness(title: str, rows: Sequence[Record], note: str) -> Table | None:
    cells = []
    for row in rows:
        inset = {"inset_mm": row["inset_um"] / 1e3} if row.get("inset_um") else {}
        away = value(row["departure_um"]), value(row["departure_rms_um"])
        cells.append([in_words(row["family"]), *away, _design(inset | row["design"])])
    heads = "family", "largest distance (µm)", "RMS distance (µm)", "nearest member"
    return table(title, heads, [("", cells)], note)
