"""What fits a record: tables and sentences."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rootsopt.view.comparison import label_of
from rootsopt.view.names import (
    Cell,
    Row,
    Table,
    brief,
    listed,
    name_and_unit,
    quantity,
    stated,
    table,
    value,
)


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
