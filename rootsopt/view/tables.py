"""The facts of a run as tables, made from the content of the result file.

The terminal (`rootsopt.view.terminal`) and the report lay out the same tables."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rootsopt.config.reading import Config
from rootsopt.config.units import words
from rootsopt.pump.sheet import NOTE, missing, warnings
from rootsopt.response.records import message_of
from rootsopt.response.result import RESPONSES
from rootsopt.status import Standing, Status
from rootsopt.view.comparison import (
    assumption_tables,
    better_tables,
    certificate_tables,
    constraint_table,
    identified_tables,
    likeness_tables,
    rejected_table,
)
from rootsopt.view.names import (
    Record,
    Row,
    Table,
    brief,
    in_words,
    label,
    limit,
    name_and_unit,
    percent,
    quantity,
    scalars,
    stated,
    status_cell,
    statuses_in,
    table,
    value,
)

NAMES = {"baseline": "baseline", "nominal": "nominal member", "optimized": "optimised"}
"""Names of the designs in the result file of an optimisation, by their key there."""

# Headings of a record's entries.
_GROUPS = {
    "response": "contact force",
    "geometry": "geometry",
    "margins": "margins of the flank",
    "outline": "outline from a file",
    "steady_state": "motion and status",
}

# Keys of the forces that the pump sheet shows.
_SHEET_FORCES = (
    "mean_force_N",
    "peak_force_N",
    "bearing_load_max_N",
    "bearing_load_equivalent_N",
    "axial_force_max_N",
    "tilting_moment_max_N_m",
)

# Number of motions above which numbers that are equal for all of them are omitted.
_WIDEST = 6


def sections(
    result: Record, rows: Sequence[Record] = (), most: int = 200
) -> list[tuple[str, str, list[Table]]]:
    """Return (anchor, title, tables) of each part of a result that has tables.

    `result`: content of the result file; `rows`: those of a sweep, if the result does not hold
    them; `most`: number of scenes above which their table is truncated."""
    parts = [
        ("better", "A better rotor", [*better_tables(result)]),
        ("identified", "What the record tells", [*identified_tables(result)]),
        ("front", "Best compromises", front_tables(result)),
        ("numbers", "Numbers", [numbers_table(result), *gradient_tables(result)]),
        ("scenes", "Scenes", scene_tables(result, rows, most)),
        ("certificate", "Certificate of the optimum",
         [constraint_table(result), *certificate_tables(result), rejected_table(result)]),
        ("assumptions", "Where the pump runs", [*assumption_tables(result)]),
        ("tolerances", "Tolerances", [tolerance_table(result), touching_table(result)]),
        ("pump", "Pump sheet", [pump_table(result)]),
        ("likeness", "Resemblance", likeness_tables(result)),
    ]  # fmt: skip
    kept = [(anchor, name, [one for one in tables if one]) for anchor, name, tables in parts]
    return [section for section in kept if section[2]]


def tables_of(result: Record, rows: Sequence[Record] = (), most: int = 200) -> list[Table]:
    """Return the tables of all `sections` in their order, with conflicts of constraints first."""
    parts = sections(result, rows, most)
    others = [one for _, _, tables in parts for one in tables]
    return [one for one in (conflict_table(result), *others) if one]


def records_of(result: Record) -> dict[str, Record]:
    """Return the records of all designs or motions of a result, by the names that views show."""
    records: dict[str, Record] = {name: result.get(key) or {} for key, name in NAMES.items()}
    records = {name: one for name, one in records.items() if isinstance(one.get("design"), Mapping)}
    motions = enumerate(result.get("attractors") or (), start=1)
    records |= {f"motion {number}": record for number, record in motions}
    records |= {f"point {record['point']}": record for record in result.get("points") or ()}
    single = isinstance(result.get("design"), Mapping) and not records
    return {"design": result} if single else records


def numbers_table(result: Record) -> Table | None:
    """Return the numbers of all designs or motions side by side, or None for a front.

    Changes are in % of the baseline, and of the nominal member of a measured baseline."""
    records = records_of(result)
    if not records or result.get("points"):
        return None
    names = [*records]
    compared = names[0] == "baseline" and len(names) > 1
    heads = ["", *(names if len(names) > 1 else ["value"])]
    heads += ["change", *(f"from {name}" for name in names[1:-1])] if compared else []

    def row(name: str, numbers: Sequence[Any], changes: bool = True) -> Row:
        further = [percent(x, numbers[-1]) for x in numbers[:-1]] if compared and changes else []
        return [name, *map(value, numbers), *further]

    def rows(part: str) -> list[Row]:
        parts = [one.get(part) or {} for one in records.values()]
        given = [scalars({**one, **one.get("gear_rattle", {})}) for one in parts]
        keys = dict.fromkeys(key for one in given for key in one)
        changes = part != "steady_state"
        return [row(label(key), [one.get(key) for one in given], changes) for key in keys]

    basins = {"share": "share of the initial states", "reached": "reached from rest"}
    groups: list[tuple[str, list[Row]]] = [("basin", [
        row(word, [one.get(key) for one in records.values()])
        for key, word in basins.items() if "attractors" in result
    ]), ("design", rows("design"))]  # fmt: skip
    groups += [(heading, rows(part)) for part, heading in _GROUPS.items()]
    if compared and "improvement" in result:
        objectives = _objectives(result, len(names))
        groups.insert(1, ("objective", [row("relative to the baseline", objectives)]))
    states = [status_cell(str(one.get("status", ""))) for one in records.values()]
    groups[-1][1].append(["status", *states])
    if len(names) > _WIDEST:
        groups = [one for one in groups if one[0] not in ("design", "geometry")]
    title = "Coexisting motions" if "attractors" in result else "Design, force and geometry"
    return table(title, heads, groups, _messages(result, records))


def _objectives(result: Record, count: int) -> list[float | None]:
    """Return the objective of baseline, nominal member if there are 3, and optimised design."""
    gains = (result.get(key) or {} for key in ("improvement", "improvement_over_nominal"))
    gain, over = (one.get("objective") for one in gains)
    if gain is None or not math.isfinite(gain):
        return [None] * count
    last = 1 - gain
    member = [None if over is None else last / (1 - over)] if count > 2 else []
    return [1, *member, last]


def _messages(result: Record, records: Mapping[str, Record]) -> str:
    """Return the messages of several designs, and the initial states that lead to no motion."""
    lost = (result.get("lost") or {}).items()
    notes = [
        f"{100 * share:.3g} % of the initial states: {in_words(name)}." for name, share in lost
    ]
    told = {name: one.get("message") for name, one in records.items()}
    if not ("attractors" in result or "design" in result):
        same = len({*told.values()}) == 1 < len(told)
        told = {"both": next(iter(told.values()))} if same else told
        notes += [f"{name}: {text}" for name, text in told.items() if text]
    return " ".join(notes)


def gradient_tables(result: Record) -> Iterator[Table | None]:
    """Yield a table of the gradient of each design that has one, with its standard errors."""
    records = {} if result.get("points") else records_of(result)
    for name, record in records.items():
        gradient = record.get("gradient") or {}
        errors = record.get("steady_state", {}).get("gradient_standard_error") or {}
        rows = []
        for key in record["design"] if any(gradient.values()) else ():
            slopes = (
                value(slope.get(key))
                + (f" ± {value(errors[force][key])}" if key in errors.get(force, {}) else "")
                for force, slope in gradient.items()
            )
            rows.append([label(key), *slopes])
        title = "Gradient of the force" + (f", {name}" if len(records) > 1 else "")
        note = "How much each force rises if a design parameter rises by one unit of its own."
        note += " After ±: standard error." if errors else ""
        yield table(title, ["per unit of", *map(label, gradient)], [("", rows)], note)


def scene_tables(result: Record, rows: Sequence[Record], most: int) -> Iterator[Table | None]:
    """Yield tables of the scenes of a sweep, or of the speeds of an objective.

    A sweep over any keys has tables of its statuses and of its greatest forces, too."""
    designs = {name: one["speeds"] for name, one in records_of(result).items() if one.get("speeds")}
    objectives = result.get("objective_by_speed") or ()
    for name, given in ({"design": rows} if rows else designs).items():
        if name == NAMES["optimized"] and objectives:
            given = [{"speed_rpm": x["speed_rpm"], "objective": x["objective"], **row}
                     for row, x in zip(given, objectives, strict=True)]  # fmt: skip
        title = "Contact force " + ("over speed" if "speed_rpm" in given[0] else "in each scene")
        note = f"The first {most} of {len(given)} rows." if len(given) > most else ""
        title += "" if name == "design" else f", {name}"
        yield _list_table(title, given[:most], note)
    if "sweep" not in result:
        return
    counts = [[status_cell(word), str(n)] for word, n in result["statuses"].items()]
    title = f"Statuses of {result['sweep']['points']} points"
    yield table(title, ["", "points"], [("", counts)])
    usable = [row for row in rows if Status[str(row["status"]).upper()].usable]
    ranges = [_range(key, usable) for key in RESPONSES if usable]
    heads = "", "least (N)", "point", "greatest (N)", "point"
    yield table("Usable points", heads, [("", ranges)])


def _range(key: str, rows: Sequence[Record]) -> Row:
    """Return the least and greatest value of a force over some points, and where they are."""
    known = [row for row in rows if row.get(key) is not None]
    ends = [pick(known, key=lambda row: row[key]) for pick in (min, max)] if known else []
    return [words(key), *(cell for row in ends for cell in (value(row[key]), str(row["point"])))]


def _list_table(title: str, rows: Sequence[Record], note: str) -> Table | None:
    """Return a table of rows {key: value}, with a column for each key that has a value.

    The status is the second column, so that it stands beside the first on a narrow terminal. Values
    that are equal in all rows are listed below the table, except those of the first key."""
    rows = [scalars(row) for row in rows]
    order = dict.fromkeys([*[*rows[0]][:1], "status", *(key for row in rows for key in row)])
    columns = {key: [row.get(key) for row in rows] for key in order}
    columns = {key: values for key, values in columns.items() if {*values} != {None}}
    same = [
        key for key in [*columns][1:] if len({*columns[key]}) == 1 < len(rows) and key != "status"
    ]
    told = [stated(key, columns.pop(key)[0], named=True) for key in same]
    note = " ".join([note, *([f"In all rows: {', '.join(told)}."] if told else [])]).strip()
    cells = [[status_cell(str(x)) for x in values] if key == "status" else map(value, values)
             for key, values in columns.items()]  # fmt: skip
    return table(title, [*map(label, columns)], [("", [*zip(*cells, strict=True)])], note)


def conflict_table(result: Record) -> Table | None:
    """Return the constraints in conflict, with the nearest limits that can be met, or None."""
    rows = [
        [limit(row), value(row["together"]), value(row["alone"])]
        for row in (result.get("infeasible") or {}).get("conflicts") or ()
    ]
    heads = "constraint", "with the least violation", "possible with all others"
    return table("Constraints in conflict", heads, [("", rows)])


def tolerance_table(result: Record) -> Table | None:
    """Return baseline, nominal and robust optimum in fresh scenes that scatter, or None."""
    robustness = result.get("robustness") or {}
    fresh = robustness.get("fresh") or {}
    if not fresh:
        return None
    nominal = (robustness.get("nominal") or {}).get("optimized")
    known = {"baseline": result["baseline"], "robust": result["optimized"], "nominal": nominal}
    designs = [(known.get(name) or {}).get("design", {}) for name in fresh]
    keys = dict.fromkeys(key for one in designs for key in one)
    groups = [("design", [[label(key), *(value(one.get(key)) for one in designs)] for key in keys])]
    combined = [value(one.get("combined_objective")) for one in fresh.values()]
    groups.append(("robust objective", [["relative to the baseline", *combined]]))
    for name in ("objective", "mean_force_N", "peak_force_N"):
        keys = [*next(iter(fresh.values()))[name]]
        rows = [[label(key), *(value(one[name][key]) for one in fresh.values())] for key in keys]
        groups.append((label(name), rows))
    shares = [f"{100 * one['failed_share']:.3g} %" for one in fresh.values()]
    groups.append(("scenes", [["without a usable motion", *shares]]))
    count = next(iter(fresh.values()))["scenes"]
    return table(f"Designs in {count} fresh scenes", ["", *fresh], groups)


def touching_table(result: Record) -> Table | None:
    """Return how the reserve of the flanks scatters, and which tolerance costs most, or None."""
    touching = result.get("touching")
    if not touching:
        return None
    rows = [
        [
            label(one["key"]),
            *(value(one[name]) for name in ("standard_deviation", "lost_um", "lost_at_most_um")),
            f"{100 * one['share_of_variance']:.3g} %",
        ]
        for one in touching["keys"]
    ]
    first, second = (
        f"{100 * touching[f'touching_share{order}']:.3g} %" for order in ("_first_order", "")
    )
    note = (
        f"Contact reserve {brief(touching['contact_reserve_um'], 4)} µm, standard deviation "
        f"{brief(touching['standard_deviation_um'], 3)} µm, worst case "
        f"{brief(touching['worst_case_um'], 4)} µm. Of {touching['machines']} machines, {second} "
        f"touch ({first} to first order). Of {touching['simulated']} simulated ones, "
        f"{touching['simulated_touching']} touch (model: {touching['model_touching']}); their "
        f"reserves differ from the model by at most "
        f"{quantity(touching['greatest_difference_um'], 'µm')}."
    )
    heads = "", "standard deviation", "reserve lost (µm)", "lost at most (µm)", "share of variance"
    return table("Reserve under tolerances", heads, [("", rows)], note)


def pump_table(result: Record) -> Table | None:
    """Return the pump sheet and the forces of all designs that have a sheet, or None."""
    sheets = {
        name: one["pump"] | {key: x for key in _SHEET_FORCES
                             if (x := (one.get("response") or {}).get(key)) is not None}
        for name, one in records_of(result).items() if one.get("pump")
    }  # fmt: skip
    names = [*sheets]
    compared = names[:1] == ["baseline"] and len(names) > 1
    heads = ["", *(names if len(names) > 1 else ["value"]), *(["change"] if compared else [])]
    rows = []
    for key in dict.fromkeys(key for sheet in sheets.values() for key in sheet):
        for name, numbers in _apart(label(key), [sheet.get(key) for sheet in sheets.values()]):
            changes = [percent(numbers[0], numbers[-1])] if compared else []
            rows.append([name, *map(value, numbers), *changes])
    return table("Pump sheet", heads, [("", rows)], _sheet_note(result, sheets))


def _sheet_note(result: Record, sheets: Mapping[str, Record]) -> str:
    """Return the caveats of the last sheet; for a geometry alone, what could be added to it."""
    if not sheets:
        return ""
    name, sheet = [*sheets.items()][-1]
    prefix = f"{name}: " if len(sheets) > 1 else ""
    notes = ["Numbers without a unit are fractions.", *(prefix + one for one in warnings(sheet))]
    if result.get("status") == Status.GEOMETRY_ONLY.label:
        notes += [NOTE, missing(sheet)]
    return " ".join(filter(None, notes))


def _apart(name: str, given: Sequence[Any]) -> list[tuple[str, Sequence[Any]]]:
    """Return (name, values) of each row for a quantity: several rows if its values are lists."""
    if not any(isinstance(one, list | tuple) for one in given):
        return [(name, given)]
    lists = [one if isinstance(one, list | tuple) else [one] for one in given]
    count = max(map(len, lists))
    return [
        (f"{name}, {k + 1} of {count}", [one[k] if k < len(one) else None for one in lists])
        for k in range(count)
    ]


def front_tables(result: Record) -> Iterator[Table | None]:
    """Yield the points of a front with terms and rates, and their designs with active limits."""
    points = result.get("points") or ()
    base = result.get("baseline") or {}
    if "terms" not in result or not (points or base.get("terms")):
        return
    aims = {aim["name"]: aim for aim in result["terms"]}
    names = [name_and_unit(name)[0] for name in aims]
    heads = ["point", *(f"{label(name)}, {aim['sense']}" for name, aim in aims.items())]
    heads += [*(f"{names[0]} per {other}" for other in names[1:]), "status"]
    first: Row = ["baseline", *(value((base.get("terms") or {}).get(name)) for name in aims)]
    rows = [
        [str(point["point"]), *map(value, (point["terms"][name] for name in aims)),
         *map(value, point["rates"].values()), status_cell(point["status"])]
        for point in points
    ]  # fmt: skip
    note = "Rates: what one more unit of the other term costs in the first, along the front."
    notes = [note, *_gaps(result)]
    yield table("Best compromises", heads, [("", [first, *rows])], " ".join(notes))
    keys = [*points[0]["design"]] if points else []
    first = ["baseline", *(value((base.get("design") or {}).get(key)) for key in keys)]
    rows = [
        [str(point["point"]), *(_bounded(key, point) for key in keys),
         ", ".join(one for one in point["multipliers"] if " bound of " not in one)]
        for point in points
    ]  # fmt: skip
    heads = ["point", *map(label, keys), "limits that hold it"]
    note = "min, max: the parameter is at this bound."
    yield table("Designs of the best compromises", heads, [("", [first, *rows][: len(rows) + 1])],
                note) if points else None  # fmt: skip


def _bounded(key: str, point: Record) -> str:
    """Return a design parameter of a point, with the bound at which it is held."""
    sides = {"lower": "min", "upper": "max"}
    held = [word for side, word in sides.items()
            if f"{side} bound of {words(key)}" in point["multipliers"]]  # fmt: skip
    return " ".join([value(point["design"][key]), *held])


def _gaps(result: Record) -> Iterator[str]:
    """Yield a sentence per gap of a front, and one on the points that were dropped."""
    for gap in result.get("gaps") or ():
        what = "Gap" if gap["kind"] == "terms" else "Change of design"
        sure = "confirmed" if gap["confirmed"] else "not confirmed: raise pareto.refinements"
        yield (
            f"{what} between points {gap['first']} and {gap['second']}: apart by "
            f"{gap['distance']:.2g} ranges of the terms and {gap['design_distance']:.2g} of the "
            f"bounds, {sure}."
        )
    dropped = [in_words(point["status"]) for point in result.get("dropped") or ()]
    counts = [f"{dropped.count(word)} {word}" for word in dict.fromkeys(dropped)]
    if counts:
        yield f"Dropped: {', '.join(counts)}."


def effort_table(result: Record) -> Table | None:
    """Return effort and accuracy of the run, and the versions of its software."""
    records = {} if "points" in result else records_of(result)
    own = {} if "design" in records else {"run": result}
    groups = {
        name if name == "run" or len(records) > 1 else "simulation": one.get("statistics") or {}
        for name, one in (own | records).items()
    } | {"versions": result.get("versions") or {}}
    shown = [
        (name, [[label(key), value(x)] for key, x in scalars(rows).items()])
        for name, rows in groups.items()
    ]
    return table("Effort, accuracy and versions", ["", "value"], shown)


def status_table(result: Record, config: Config) -> Table | None:
    """Return the meaning of every status, those of this run first, with advice for its scene."""
    met = statuses_in(result)
    meanings = {status.label: message_of(config, status) for status in Status}
    points = {one.label: one.value for one in Standing}
    here = meanings | points
    rows = [[status_cell(word), here[word]] for word in met if word in here]
    known = here if result.get("points") else meanings
    others = [[in_words(word), text] for word, text in known.items() if word not in met]
    groups = [("in this run", rows), ("not in this run", others)]
    return table("What each status means", ["status", "meaning and advice"], groups)
