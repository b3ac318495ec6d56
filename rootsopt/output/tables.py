"""Tables for the terminal: evaluations, geometries, sweeps, and comparisons with the baseline.

They are plain ASCII and fit into 80 columns, so that they look the same in a pipe or a log.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from rootsopt.output.labels import DASH
from rootsopt.output.labels import change as _change
from rootsopt.output.labels import fitting as _plain
from rootsopt.output.labels import in_words as _words
from rootsopt.output.labels import label_of as _label
from rootsopt.output.labels import name_and_unit as _split
from rootsopt.output.labels import number as _number
from rootsopt.response.evaluation import Evaluation
from rootsopt.response.sensitivity import MICROMETRE
from rootsopt.status import Status

_SHEET_FORCES = (
    "mean_force_N",
    "peak_force_N",
    "bearing_load_max_N",
    "bearing_load_equivalent_N",
    "axial_force_max_N",
    "tilting_moment_max_N_m",
)
"""Keys of the forces that the pump sheet shows."""
_STATISTICS = {
    "mean": "mean",
    "sigma": "standard deviation",
    "quantile_95": "95 % quantile",
    "worst": "worst",
}
_WIDEST_DESIGN = 5
"""Number of design parameters above which the table of a front leaves out the designs."""
_UNSURE = 0.5
"""Estimated share of further starts with a new optimum above which the table recommends more
starts."""
_Rows = Iterable[tuple[str | Text, ...]]


def comparison_table(
    baseline: Evaluation,
    optimized: Evaluation,
    constraints: list[dict[str, Any]],
    improvement: Mapping[str, float],
) -> RenderableType:
    """Return a table that compares the optimised design with the baseline.

    Changes are in % of the baseline. `constraints`: one row {name, baseline, optimized, limit,
    unit, sense, satisfied, active} per constraint; `improvement`: reductions of the objective and
    the forces, as fractions of the baseline."""
    table = _table("Optimised rotor against baseline", "baseline", "optimised", "change")
    first, second = baseline.record(), optimized.record()
    _group(table, "design", _pairs(first["design"], second["design"]))
    _group(table, "geometry", _pairs(first["geometry"], second["geometry"]))
    response = _pairs(first["response"], second["response"])
    _group(table, "response", [_objective(improvement), *response])
    for heading, *rows in _gradients(first["gradient"], second["gradient"]):
        _group(table, heading, [row[:3] for row in _pairs(*rows)])
    for heading, *rows in _errors(first["steady_state"], second["steady_state"]):
        _group(table, heading, [row[:3] for row in _pairs(*rows)])
    _group(table, "constraints", map(_constraint, constraints))
    _group(
        table,
        "status",
        [
            *(row[:3] for row in _pairs(first["steady_state"], second["steady_state"])),
            ("status", _status(baseline), _status(optimized)),
        ],
    )
    notes = [("baseline", baseline.message), ("optimised", optimized.message)]
    if baseline.message == optimized.message:
        notes = [("both", baseline.message)]
    return Group(table, *(Text(f"{name}: {message}") for name, message in notes))


def nominal_table(
    baseline: Mapping[str, Any],
    nominal: Mapping[str, Any],
    optimized: Mapping[str, Any],
    improvement: Mapping[str, float],
    over_nominal: Mapping[str, float],
) -> RenderableType:
    """Return a table of a measured baseline, its nominal member and the optimised design.

    `baseline`, `nominal`, `optimized`: records in the result file; `improvement`, `over_nominal`:
    reductions with respect to baseline and nominal member. Changes are in % of each."""
    columns = "baseline", "nominal", "optimised", "change", "from nominal"
    table = _table("Measured rotor, nominal member of the family, and optimum", *columns)
    first, least = (1 - one.get("objective", math.nan) for one in (improvement, over_nominal))
    rows = [("objective (baseline = 1)", 1.0, first / least, first)]
    records = baseline, nominal, optimized
    places = [("response", key) for key in _SHEET_FORCES[:2]]
    places += [("geometry", key) for key in ("seal_width_mm", "area_efficiency")]
    for group, key in places:
        rows.append((_label(key), *(one.get(group, {}).get(key) for one in records)))
    for name, *cells in rows:
        changes = _change(cells[0], cells[2]), _change(cells[1], cells[2])
        table.add_row(name, *map(_number, cells), *changes)
    return table


def pump_table(records: Mapping[str, Mapping[str, Any]]) -> RenderableType:
    """Return the pump sheet of several designs side by side.

    `records`: their records in the result file, by the name of the column. A pump sheet shows the
    entry `pump` and the forces. With two designs, a last column shows the change in % of the
    first."""
    sheets = []
    for record in records.values():
        forces = ((key, record.get("response", {}).get(key)) for key in _SHEET_FORCES)
        sheets.append(record.get("pump", {}) | {key: x for key, x in forces if x is not None})
    compared = len(sheets) == 2
    table = _table("Pump sheet", *records, *(["change"] if compared else []))
    _group(table, "pump", _pairs(*sheets) if compared else _singles(sheets[0]))
    return table


def optimality_table(
    optimality: Mapping[str, Any], constraints: list[dict[str, Any]]
) -> RenderableType:
    """Return a table of the certificate of the optimum.

    It shows the first-order conditions, the effect of each active limit, the active branches of the
    objective, and the optima that the starts found. `optimality`, `constraints`: these entries of
    the result file."""
    table = _table("Certificate of the optimum", "value", "objective")
    word = optimality["reason"].replace("_", " ")
    _group(
        table,
        "first-order conditions",
        [
            ("residual (of the unit box)", _number(optimality["residual"]), word),
            ("better nearby, promised (relative)", _number(optimality["promised_decrease"]), ""),
            ("violation (scaled)", _number(optimality["violation"]), ""),
        ],
    )
    prices = [row for row in constraints if abs(row.get("multiplier", 0.0)) > 0]
    rough = "" if optimality["converged"] else " (rough, because this is no optimum)"
    _group(table, f"price of a limit{rough}", map(_price, prices))
    held = optimality["held_by"]
    if len(held) > 1:
        _group(table, "branches that hold the optimum (share)", map(_held, held))
    _group(table, "starts", map(_start, optimality["starts"]))
    _group(table, "distinct optima", _optima(optimality))
    return Group(table, Text(optimality["message"]))


def sensitivity_table(rows: list[dict[str, Any]]) -> RenderableType:
    """Return a table of how small changes of the scene change the forces and the objective.

    `rows`: entry `sensitivities` of `optimality` in the result file."""
    table = _table("Sensitivity of the optimum", "mean, N", "peak, N", "objective")
    for row in rows:
        length = row["unit"] == "mm" and row["step"] == MICROMETRE
        step = "+1 um" if length else "+1 %"
        forces = (f"{row[key]:+.3g}" for key in ("mean_force_N", "peak_force_N"))
        share = row.get("objective_percent")
        change = DASH if share is None else f"{share:+.3g} %"
        table.add_row(f"{row['quantity']} {step}", *forces, change)
    return table


def robustness_table(
    robustness: Mapping[str, Any], designs: Mapping[str, Mapping[str, float]]
) -> RenderableType:
    """Return a table of baseline, nominal and robust optimum over many scattered scenes.

    `robustness`: this entry of the result file; `designs`: design of `baseline` and `robust`."""
    fresh = robustness["fresh"]
    scenes = next(iter(fresh.values()))["scenes"]
    table = _table(f"Baseline and optima in {scenes} fresh scenes", *fresh)
    known = dict(designs)
    if robustness["nominal"]["optimized"] is not None:
        known["nominal"] = robustness["nominal"]["optimized"]["design"]
    keys = [*next(iter(known.values()))]
    cells = ((_label(key), *(_number(known[name][key]) for name in fresh)) for key in keys)
    _group(table, "design", cells)
    combined = [_number(one["combined_objective"]) for one in fresh.values()]
    _group(table, "robust objective", [("relative to the baseline", *combined)])
    for name in ("objective", "mean_force_N", "peak_force_N"):
        rows = (
            (word, *(_number(one[name][key]) for one in fresh.values()))
            for key, word in _STATISTICS.items()
        )
        _group(table, _label(name), rows)
    shares = [f"{100 * one['failed_share']:.3g} %" for one in fresh.values()]
    _group(table, "scenes", [("without a usable motion", *shares)])
    return table


def conflict_table(rows: list[dict[str, Any]]) -> RenderableType:
    """Return a table of constraints in conflict, with the nearest limits that can be met.

    `rows`: entry `conflicts` of `infeasible` in the result file."""
    table = _table("Constraints in conflict", "least violation", "with all others")
    for row in rows:
        unit = f" {row['unit']}" if row["unit"] else ""
        name = f"{row['name']} {row['sense']} {_number(row['limit'])}{unit}"
        table.add_row(name, _number(row["together"]), _number(row["alone"]))
    return table


def rejected_table(rows: list[dict[str, Any]]) -> RenderableType:
    """Return a table of the designs that did not hold up when simulated again from rest.

    `rows`: entry `rejected` of `verification` in the result file."""
    table = _table("Rejected designs", "in the search", "from rest", "reason")
    for row in rows:
        design = ", ".join(f"{_label(key)} {_number(x)}" for key, x in row["design"].items())
        same = row["verified_objective"] is not None
        reason = "another motion" if same else row["status"].replace("_", " ")
        reason += f" ({len(row['attempts'])} attempts)"
        numbers = (_number(row[f"{word}_objective"]) for word in ("searched", "verified"))
        table.add_row(design, *numbers, Text(reason, style="bold red"))
    return table


def _price(row: Mapping[str, Any]) -> tuple[str, ...]:
    step = f"{row['relaxed_by']:+g} {row['unit']}".strip()
    name = f"{_words(row['name'])} {row['sense']} {_number(row['limit'])} {row['unit']}".strip()
    return name, step, f"{row['relaxed_objective_percent']:+.3g} %"


def _held(row: Mapping[str, Any]) -> tuple[str, ...]:
    at = "" if row["speed_rpm"] is None else f"{_number(row['speed_rpm'])} rpm"
    if "scene" in row:
        at = f"scene {row['scene']} of the sample"
    if row["rotation_deg"] is not None:
        at += f" peak of {_number(row['force_N'])} N at {row['rotation_deg']:.2f} deg"
    return at.strip() or "motion", f"{row['share']:.3f}", _number(row["objective"])


def _start(row: Mapping[str, Any]) -> tuple[str, ...]:
    word = row["reason"].replace("_", " ")
    count = f"{row['evaluations']} designs"
    return f"start {row['start']}: {word}", count, _number(row["objective"])


def _optima(optimality: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows = []
    for number, one in enumerate(optimality["optima"], start=1):
        times = f"{one['found']} of {len(optimality['starts'])} starts"
        rows.append((f"optimum {number}", times, _number(one["objective"])))
    share = optimality["unseen"]["share_of_starts"]
    if rows:
        name = "chance that a further start finds a new one"
        if share is None or share > _UNSURE:
            name += " (few starts: raise optimizer.starts)"
        rows.append((name, "unknown" if share is None else f"{100 * share:.3g} %", ""))
    return rows


def evaluation_table(evaluation: Evaluation) -> RenderableType:
    """Return a table of all results of one design in one scene."""
    record = evaluation.record()
    table = _table("Simulation of the rotor pair", "value")
    _group(table, "design", _singles(record["design"]))
    _group(table, "geometry", _singles(record["geometry"]))
    _group(table, "response", _singles(record["response"]))
    for heading, rows in _gradients(record["gradient"]):
        _group(table, heading, _singles(rows))
    for heading, rows in _errors(record["steady_state"]):
        _group(table, heading, _singles(rows))
    steady = _singles(record["steady_state"])
    _group(table, "status", [*steady, ("status", _status(evaluation))])
    _group(table, "statistics", _singles(record["statistics"]))
    return Group(table, Text(evaluation.message))


def sweep_table(rows: list[dict[str, Any]]) -> RenderableType:
    """Return a table of one design at many speeds.

    `rows`: one per speed, as `Part.row` returns them."""
    columns = "mean, N", "peak, N", "period", "multiplier", "status"
    table = _table("Contact force over speed", *columns)
    table.columns[0].header = Text("speed, rpm")
    keys = "mean_force_N", "peak_force_N", "period", "floquet_multiplier"
    for row in rows:
        table.add_row(_number(row["speed_rpm"]), *(_number(row[key]) for key in keys), _word(row))
    return table


def speeds_table(
    baseline: list[dict[str, Any]],
    optimized: list[dict[str, Any]] = (),  # type: ignore[assignment]
    objectives: list[dict[str, float]] = (),  # type: ignore[assignment]
) -> RenderableType:
    """Return a table that compares the optimised design with the baseline at each speed.

    Without an optimised design, the table shows the baseline alone. `baseline`, `optimized`: one
    row per speed, as in the entry `speeds` of the result file; `objectives`: one row per speed, as
    in the entry `objective_by_speed` of the result file."""
    if not optimized:
        return sweep_table(baseline)
    columns = "mean, N", "opt.", "peak, N", "opt.", "objective", "status"
    table = _table("Contact force over speed, baseline and optimised (opt.)", *columns)
    table.columns[0].header = Text("speed, rpm")
    for first, second, one in zip(baseline, optimized, objectives, strict=True):
        forces = (row[key] for key in ("mean_force_N", "peak_force_N") for row in (first, second))
        cells = (*forces, one["objective"])
        table.add_row(_number(first["speed_rpm"]), *map(_number, cells), _word(second))
    return table


def _word(row: Mapping[str, Any]) -> Text:
    """Return the status label of a `row` as coloured text."""
    usable = Status[row["status"].upper()].usable
    return Text(row["status"], style="bold green" if usable else "bold red")


def attractor_table(rows: list[dict[str, Any]], lost: Mapping[str, float]) -> RenderableType:
    """Return a table of coexisting motions, one column per motion.

    `rows`: one {attractor, share, reached, status, ...} per motion. `lost`: share of the initial
    states that lead to no motion, by status label."""
    table = _table("Coexisting motions", *(f"motion {row['attractor']}" for row in rows))
    labels = {
        "share": "share of initial states",
        "reached": "reached from rest",
        "status": "status",
    }
    for key in rows[0] if rows else ():
        if key != "attractor":
            cells = ["yes" if row[key] is True else _number(row[key]) for row in rows]
            table.add_row(labels.get(key, _label(key)), *(c.replace("False", "no") for c in cells))
    notes = [f"{share:.1%} of the initial states: {label}" for label, share in lost.items()]
    return Group(table, *map(Text, notes))


def geometry_table(record: Mapping[str, Any]) -> RenderableType:
    """Return a table of the geometry of one profile, from its entries in the result file."""
    table = _table("Rotor profile", "value")
    _group(table, "design", _singles(record.get("design", {})))
    _group(table, "geometry", _singles(record.get("geometry", {})))
    if "margins" in record:
        _group(table, "margins of the flank", _singles(record["margins"]))
    if "outline" in record:
        _group(table, "outline", _singles(record["outline"]))
    if "pump" in record:
        _group(table, "pump", _singles(record["pump"]))
    if record.get("status"):
        _group(table, "status", [("status", str(record["status"]))])
    return Group(table, Text(record.get("message") or ""))


def front_table(record: Mapping[str, Any]) -> RenderableType:
    """Return tables of a front: terms, rates and status of each point, the designs, and the gaps.

    `record`: the front as in the result file."""
    aims = record["terms"]
    names = [aim["name"] for aim in aims]
    words = [_split(name)[0] for name in names]
    columns = [f"{_label(aim['name'])} ({aim['sense']})" for aim in aims]
    columns += [f"{words[0]} per {other}" for other in words[1:]]
    table = _table("Best compromises", *columns, "status")
    table.columns[0].header = Text("point")
    base = [_number(record["baseline"]["terms"].get(name)) for name in names]
    table.add_row("baseline", *base, *[DASH] * len(names))
    table.add_section()
    for point in record["points"]:
        certified = point["status"] == "certified"
        cells = [point["terms"][name] for name in names] + [*point["rates"].values()]
        word = Text(point["status"], style="bold green" if certified else "bold red")
        table.add_row(str(point["point"]), *map(_number, cells), word)
    if not record["points"]:
        return Group(table)
    keys = [*record["points"][0]["design"]]
    parts: list[RenderableType] = [table]
    if len(keys) <= _WIDEST_DESIGN:
        designs = _table("Their designs (min, max: at that bound)", *map(_label, keys), "limits")
        designs.columns[0].header = Text("point")
        for point in record["points"]:
            limits = [name for name in point["multipliers"] if " bound of " not in name]
            cells = [_bounded(key, point) for key in keys]
            designs.add_row(str(point["point"]), *cells, ", ".join(limits) or DASH)
        parts.append(designs)
    return Group(*parts, *map(Text, _notes(record)))


def _bounded(key: str, point: Mapping[str, Any]) -> str:
    """Return a design parameter of a point, with the bound at which it is held."""
    name = _words(key.removesuffix("_mm").removesuffix("_deg"))
    sides = {"lower": "min", "upper": "max"}
    held = [
        word for side, word in sides.items() if f"{side} bound of {name}" in point["multipliers"]
    ]
    return " ".join([_number(point["design"][key]), *held])


def _notes(record: Mapping[str, Any]) -> list[str]:
    """Return one line per gap of a front, and one about the points that were dropped."""
    notes = []
    for gap in record["gaps"]:
        what = "gap" if gap["kind"] == "terms" else "change of design"
        sure = "confirmed" if gap["confirmed"] else "not confirmed: raise pareto.refinements"
        notes.append(
            f"{what} between points {gap['first']} and {gap['second']}: apart by "
            f"{gap['distance']:.2g} ranges of the terms and {gap['design_distance']:.2g} of the "
            f"bounds, {sure}"
        )
    count: dict[str, int] = {}
    for point in record["dropped"]:
        count[point["status"]] = count.get(point["status"], 0) + 1
    dropped = ", ".join(f"{n} {_words(word)}" for word, n in count.items())
    return [*notes, f"dropped: {dropped}"] if dropped else notes


def likeness_table(
    rows: list[dict[str, Any]], title: str = "The optimised profile resembles"
) -> RenderableType:
    """Return a table of the designs of several families that are nearest to a profile.

    `title`: that of the table; `rows`: one per profile family, as in the entry `resembles` of the
    result file."""
    distances = "largest distance, um", "RMS distance, um"
    table = _table(title, *distances, "nearest member")
    for row in rows:
        cells = [f"{key} {_number(value)}" for key, value in row["design"].items()]
        if row["inset_um"]:
            cells.insert(0, f"inset {row['inset_um'] / 1e3:.3g} mm")
        design = ", ".join(cells)
        away = _number(row["departure_um"]), _number(row["departure_rms_um"])
        table.add_row(row["family"], *away, design)
    return table


def beginning_table(record: Mapping[str, Any]) -> RenderableType:
    """Return a table of the fitted profiles from which a search could begin, and where it began.

    `record`: entry `beginning` of the result file."""
    table = likeness_table(record["considered"], "Nearest to the outline of the baseline")
    return Group(table, Text(record["message"]))


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, box=box.ASCII, title_justify="left", title_style="bold")
    table.add_column("", overflow="fold")
    for column in columns:
        table.add_column(column, justify="right", overflow="fold")
    return table


def _group(table: Table, name: str, rows: _Rows) -> None:
    """Add a heading and its `rows` to a table. Without rows, add a row "none" with dashes."""
    rows = list(rows) or [("none", *[DASH] * (len(table.columns) - 1))]
    table.add_section()
    table.add_row(Text(name, style="bold"))
    for label, *cells in rows:
        cells = [cell if isinstance(cell, Text) else Text(cell) for cell in cells]
        table.add_row(Text(f"  {label}"), *cells)


def _singles(values: Mapping[str, Any]) -> list[tuple[str, ...]]:
    return [(_label(key), _number(value)) for key, value in _plain(values).items()]


def _pairs(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows = []
    first, second = _plain(first), _plain(second)
    for key in dict.fromkeys([*first, *second]):
        a, b = first.get(key), second.get(key)
        rows.append((_label(key), _number(a), _number(b), _change(a, b)))
    return rows


def _objective(improvement: Mapping[str, float]) -> tuple[str, ...]:
    gain = improvement.get("objective")
    label = "objective (baseline = 1)"
    if gain is None or not math.isfinite(gain):
        return label, DASH, DASH, DASH
    return label, "1", _number(1 - gain), _change(1.0, 1 - gain)


def _constraint(row: Mapping[str, Any]) -> tuple[str | Text, ...]:
    unit = f" {row['unit']}" if row.get("unit") else ""
    label = f"{_words(row['name'])} {row['sense']} {_number(row['limit'])}{unit}"
    if not row["satisfied"]:
        verdict = Text("violated", style="bold red")
    else:
        word = "active" if row.get("active") else "satisfied"
        verdict = Text("met by all" if row.get("always") else word, style="green")
    before = Text(_number(row["baseline"]))
    if row.get("baseline_satisfied") is False:
        own = row.get("baseline_limit")
        before.append(" violated" if own is None else f" > {_number(own)}", style="bold red")
    return label, before, _number(row["optimized"]), verdict


def _status(evaluation: Evaluation) -> Text:
    style = "bold green" if evaluation.usable else "bold red"
    return Text(evaluation.status.label, style=style)


def _gradients(*gradients: Mapping[str, Mapping[str, float]]) -> list[tuple]:
    """Return one tuple (heading, rows for each of the `gradients`) per response.

    Rows are {label: derivative}. Without gradients, return a single heading without rows."""
    found = dict.fromkeys(response for gradient in gradients for response in gradient)
    groups = []
    for response in found:
        name, unit = _split(response)
        rows = (_per_unit(gradient.get(response, {}), unit) for gradient in gradients)
        groups.append((f"gradient of the {name}", *rows))
    return groups or [("gradient", *({} for _ in gradients))]


def _errors(*steady_states: Mapping[str, Any]) -> list[tuple]:
    """Return the same tuples as `_gradients`, for the standard errors of gradients.

    Return an empty list if no steady state has such errors."""
    errors = [steady.get("gradient_standard_error", {}) for steady in steady_states]
    groups = _gradients(*errors) if any(errors) else []
    return [(f"standard error of the {heading}", *rows) for heading, *rows in groups]


def _per_unit(row: Mapping[str, float], unit: str) -> dict[str, float]:
    """Return the derivatives in `row` with labels as keys.

    `unit`: unit of the response. An example of a label is "d/d(pressure angle), N/deg"."""
    labels = ((key, *_split(key)) for key in row)
    return {
        f"d/d({name}), {f'{unit}/{per}' if per else unit}": row[key] for key, name, per in labels
    }


plain_table, status_text = _table, _word
"""Empty table and coloured status for tables that other modules make."""
