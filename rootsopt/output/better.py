"""The tables of `rootsopt improve`: your rotor against a better one."""

from collections.abc import Iterator, Mapping
from typing import Any

from rootsopt.output.names import DASH, Row, Table, in_words, label, percent, table, value

WORTH = 1e-4
"""Relative change of the objective below which no rotor counts as a better one."""
NOTHING_BETTER = (
    "With the same displacement, outer diameter and seal width, the family of the search has no "
    "better rotor: try `--set optimizer.family=free_form`, or allow a narrower tip land with "
    "`--set constraints.seal_width_min_mm`."
)
"""Message if there is none."""
_ROWS = (
    ("response", ("mean_force_N", "peak_force_N")),
    ("pump", ("volumetric_efficiency", "flow_ripple", "displaced_volume_cm3")),
    ("geometry", ("seal_width_mm",)),
)
"""Quantities that are compared, by the entry of a record that holds them."""


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


__all__ = ["NOTHING_BETTER", "WORTH", "better_tables"]
