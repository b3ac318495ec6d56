"""Tables and sentences of an optimum beside its baseline, and of what fits a record.

They are those of `rootsopt improve`, of `rootsopt identify`, and those over what is assumed about
the scene."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rootsopt.response.sensitivity import NAMES
from rootsopt.view.names import (
    DASH,
    Cell,
    Row,
    Table,
    brief,
    in_words,
    label,
    listed,
    name_and_unit,
    percent,
    quantity,
    stated,
    table,
    value,
)

# Length (mm) below which sentences state it in µm.
_MICRO = 0.1


def assumption_tables(result: Mapping[str, Any]) -> Iterator[Table | None]:
    """Yield the objective at both ends of each range, and its statistics in random scenes."""
    found = result.get("assumptions")
    if not found:
        return
    rows = [
        [label_of(row["key"]), value(row["low"]), value(row["high"]),
         *(_cell(row[f"objective_{end}"]) for end in ("low", "high")),
         value(row["rank_correlation"])]
        for row in found["keys"]
    ]  # fmt: skip
    heads = "", "low", "high", "at low", "at high", "rank"
    note = (
        "At low, at high: objective relative to the baseline in the same scene, all else as given. "
        "Rank: correlation of the objective with the quantity over the random scenes (Spearman)."
    )
    yield table("The optimum where the pump may run", heads, [("", rows)], note)
    levels = found["objective_quantiles"]
    spread = {f"objective, {name_and_unit(level)[0]}": x for level, x in levels.items()}
    worst = found["worst"] or {}
    spread |= {"objective, worst of all scenes": worst.get("objective")}
    rows = [["better than the baseline", _share(found)]]
    rows += [[name, _cell(x)] for name, x in spread.items()]
    title = f"The optimum in {found['compared']} random scenes"
    yield table(title, ("", "optimised"), [("", rows)])


def _share(row: Mapping[str, Any]) -> str:
    share = row["share_better"]
    return DASH if share is None else f"{100 * share:.3g} %"


def _cell(objective: float | None) -> Cell:
    return Cell(value(objective), None if objective is None else objective < 1)


def elsewhere(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on an optimum over what is assumed; none without a comparison."""
    found = result.get("assumptions")
    if not found:
        return
    compared, ends = found["compared"], found["ends_compared"]
    if not compared:
        yield "No random scene within the assumptions can be compared."
    else:
        better = round(found["share_better"] * compared)
        low, high = (found["objective_quantiles"][f"quantile_{k}"] for k in (5, 95))
        yield (
            f"The optimum is better than the baseline in {better} of {compared} random scenes "
            f"within the assumptions and at {found['ends_better']} of {ends} ends of their ranges: "
            f"objective {brief(low, 3)} to {brief(high, 3)} (5 % to 95 % of the random scenes), at "
            f"worst {brief(found['worst']['objective'], 3)}."
        )
    worse = [
        _region(row | {"better": row["worse"]}, found) for row in found["keys"] if row["worse"]
    ]
    if worse:
        yield f"All else as given, it is worse {listed(worse)}."
    elif compared and found["share_better"] < 1:
        row = _row(found["decides"], found)
        yield f"Its objective rises most with {_sense(row)}."
    known = (result.get("robustness") or {}).get("nominal") or {}
    nominal = (known.get("optimized") or {}).get("design")
    for one in found["rivals"]:
        shape = ", ".join(
            f"{name_and_unit(k)[0]} {_stated(k, x)}" for k, x in one["design"].items()
        )
        region = _region(one, found)
        where = f" and, all else as given, {region}" if region else f", mostly with {_sense(one)}"
        share = f"{_share(one)} of the random scenes"
        name = "The nominal optimum" if one["design"] == nominal else "Another design"
        yield f"{name} ({shape}) is better than the optimum in {share}{where}."
    if found["not_compared"]:
        rows = [[in_words(row[f"status_{who}"]) for who in ("baseline", "optimized")]
                for row in found["not_compared"]]  # fmt: skip
        counts = Counter(f"baseline {first}, optimum {last}" for first, last in rows)
        told = [f"{count} ({words})" for words, count in counts.items()]
        yield f"Scenes that cannot be compared: {listed(told)}."


def _row(key: str, found: Mapping[str, Any]) -> Mapping[str, Any]:
    return next(row for row in found["keys"] if row["key"] == key)


def _sense(row: Mapping[str, Any]) -> str:
    """Return in which direction a quantity changes an objective, with its rank correlation."""
    rank = row["rank_correlation"] or 0.0
    word = "more" if rank > 0 else "less"
    return f"{word} {named(row['key'])} (rank correlation {brief(rank, 2)})"


def _region(row: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    """Return where a design is better (`row`: key and parts of its range), in words."""
    key, span = row["key"], _row(row["key"], found)
    parts = [_part(key, piece, span) for piece in row["better"]]
    return f"where the {named(key)} {' or '.join(parts)}" if parts else ""


def _part(key: str, piece: Sequence[float], span: Mapping[str, Any]) -> str:
    start, stop = (_stated(key, x) for x in piece)
    below, above = piece[0] == span["low"], piece[1] == span["high"]
    found = f"is between {start} and {stop}"
    if below and above:
        found = "has any value"
    elif above or below:
        found = f"is above {start}" if above else f"is below {stop}"
    if start == stop:
        found = f"is {start}"
    return found


def _stated(key: str, given: float) -> str:
    unit = name_and_unit(key)[1]
    if unit == "mm" and abs(given) < _MICRO:
        return f"{brief(1e3 * given, 2)} µm"
    return quantity(float(f"{given:.3g}"), unit)


def named(key: str) -> str:
    """Return the name of an assumed quantity in words."""
    return NAMES.get(key) or name_and_unit(key)[0]


def label_of(key: str) -> str:
    """Return this name with the unit in parentheses."""
    unit = name_and_unit(key)[1]
    return f"{named(key)} ({unit})" if unit else named(key)


WORTH = 1e-4
"""Relative change of the objective below which no rotor counts as a better one."""
NOTHING_BETTER = (
    "With the same displacement, outer diameter and seal width, the family of the search has no "
    "better rotor: try `--set optimizer.family=free_form`, or allow a narrower tip land with "
    "`--set constraints.seal_width_min_mm`."
)
"""Message if there is none."""

# Quantities that are compared, by the entry of a record that holds them.
_ROWS = (
    ("response", ("mean_force_N", "peak_force_N")),
    ("pump", ("volumetric_efficiency", "flow_ripple", "displaced_volume_cm3")),
    ("geometry", ("seal_width_mm",)),
)


def better_tables(result: Mapping[str, Any]) -> Iterator[Table | None]:
    """Yield the comparison of a rotor from a file with a better one, and what errors leave of it.

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
    """Yield the fitted quantities, what the record does not tell, and what would."""
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
    found = []
    for key, one in (result.get("parameters") or {}).items():
        (name, unit), error = name_and_unit(key), one["standard_error"]
        if error is None:
            found.append(f"{name} {quantity(one['value'], unit)} (not determined)")
        else:
            found.append(f"{name} {brief(one['value'])} ± {brief(error, 2)} {unit}".strip())
    said = str(result["message"]).partition(". ")[2]
    return [("Found", f"{listed(found)}."), ("How sure", said)] if found else []
