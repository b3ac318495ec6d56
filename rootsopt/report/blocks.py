"""Tables of a report, made from the result file."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rootsopt.output.labels import fitting, in_words
from rootsopt.report.gather import Case, Run
from rootsopt.report.names import label, percent, value
from rootsopt.response.records import message_of
from rootsopt.status import Status
from rootsopt.tradeoffs.front import Standing

_WIDEST = 6
"""Number of cases above which the table omits the numbers of each case."""
_MOST_ROWS = 200
"""Number of scenes above which the table of a sweep is truncated."""
_GOOD = {"satisfied", "active", "met by all", "certified", "converged", "geometry_only"}


@dataclasses.dataclass(frozen=True)
class Cell:
    """A cell of a table: its text, and whether its content is favourable (None: neutral)."""

    text: str
    good: bool | None = None


@dataclasses.dataclass(frozen=True)
class Block:
    """A table: title, headings of its columns, groups of rows, and a note below it.

    `groups`: (heading of the group or "", rows) for each group; the first cell of a row is its
    heading."""

    title: str
    heads: tuple[str, ...]
    groups: tuple[tuple[str, tuple[tuple[Cell, ...], ...]], ...]
    note: str = ""


def block(
    title: str,
    heads: Sequence[str],
    groups: Iterable[tuple[str, Iterable[Sequence[Cell | str]]]],
    note: str = "",
) -> Block:
    """Return a table with this `title`, without its empty groups.

    `heads`: headings of the columns; `note`: text below the table. Cells may be given as text."""
    found = []
    for heading, rows in groups:
        cells = tuple(
            tuple(cell if isinstance(cell, Cell) else Cell(cell) for cell in row) for row in rows
        )
        if cells:
            found.append((heading, cells))
    return Block(title, tuple(heads), tuple(found), note)


def status_cell(word: str) -> Cell:
    """Return the cell of a status: its label in words, marked favourable or not."""
    known = {status.label: status.usable or status is Status.GEOMETRY_ONLY for status in Status}
    known |= {one.label: one is Standing.CERTIFIED for one in Standing}
    return Cell(in_words(word), known.get(word, word in _GOOD))


def result_block(run: Run) -> Block | None:
    """Return the numbers of all cases side by side, or None if they are in other tables."""
    cases = [case for case in run.cases if case.record]
    if not cases or len(cases) > _WIDEST or run.result.get("points"):
        return None
    compared = len(cases) > 1 and cases[0].name == "baseline"
    heads = ["", *([case.name for case in cases] if len(cases) > 1 else ["value"])]
    heads += ["change", *(f"from {case.name}" for case in cases[1:-1])] if compared else []

    def rows(given: Sequence[Mapping[str, Any]], changes: bool = True) -> list[list[str | Cell]]:
        found = []
        kept = [fitting(one) for one in given]
        for key in dict.fromkeys(key for one in kept for key in one):
            numbers = [one.get(key) for one in kept]
            row: list[str | Cell] = [label(key), *map(value, numbers)]
            if compared:
                row += [percent(x, numbers[-1]) if changes else "" for x in numbers[:-1]]
            found.append(row)
        return found

    def of(name: str) -> list[Mapping[str, Any]]:
        return [case.record.get(name) or {} for case in cases]

    groups: list[tuple[str, list]] = [
        ("design", rows([case.design for case in cases])),
        ("contact force", rows(of("response"))),
        ("geometry", rows(of("geometry"))),
        ("margins of the flank", rows(of("margins"))),
        ("outline from a file", rows(of("outline"))),
        ("steady state", rows(of("steady_state"), changes=False)),
    ]
    state = ["status", *(status_cell(str(case.record.get("status", ""))) for case in cases)]
    groups[-1][1].append([*state, *[""] * (len(cases) - 1)] if compared else state)
    return block("Design, force and geometry", heads, groups)


def gradient_blocks(run: Run) -> list[Block]:
    """Return a table of the gradient of each case that has one, with its standard errors."""
    blocks = []
    for case in run.cases:
        gradient = case.record.get("gradient") or {}
        if not any(gradient.values()):
            continue
        errors = case.record.get("steady_state", {}).get("gradient_standard_error") or {}
        heads = ["per unit of", *map(label, gradient)]
        rows = []
        for key in case.design:
            row = [label(key)]
            for name in gradient:
                text = value(gradient[name].get(key))
                if key in errors.get(name, {}):
                    text += f" ± {value(errors[name][key])}"
                row.append(text)
            rows.append(row)
        title = "Gradient of the force"
        title += f", {case.name}" if len(run.cases) > 1 else ""
        note = "How much each force rises if a design parameter rises by one unit of its own."
        blocks.append(block(title, heads, [("", rows)], note))
    return blocks


def pump_block(run: Run) -> Block | None:
    """Return the pump sheet of all cases that have one, or None."""
    sheets = {case.name: case.record.get("pump") for case in run.cases}
    sheets = {name: sheet for name, sheet in sheets.items() if sheet}
    if not sheets:
        return None
    names = list(sheets)
    heads = ["", *(names if len(names) > 1 else ["value"])]
    compared = names[:1] == ["baseline"] and len(names) == 2
    rows = []
    for key in dict.fromkeys(key for sheet in sheets.values() for key in sheet):
        for name, numbers in _apart(label(key), [sheet.get(key) for sheet in sheets.values()]):
            row = [name, *map(value, numbers)]
            if compared:
                row.append(percent(*numbers))
            rows.append(row)
    heads += ["change"] if compared else []
    note = "Numbers without a unit are fractions."
    return block("Pump sheet", heads, [("", rows)], note)


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


def list_block(title: str, rows: Sequence[Mapping[str, Any]], note: str = "") -> Block | None:
    """Return a table of rows {key: value}, with one column for each key that has a value in some
    row."""
    keys = [key for key in dict.fromkeys(key for row in rows for key in row)
            if any(fitting(row).get(key) is not None for row in rows)]  # fmt: skip
    if not keys:
        return None
    shown = []
    for row in rows:
        cells: list[str | Cell] = []
        for key in keys:
            text = row.get(key)
            cells.append(status_cell(str(text)) if key == "status" else value(text))
        shown.append(cells)
    return block(title, [label(key) for key in keys], [("", shown)], note)


def front_block(run: Run) -> Block | None:
    """Return the points of a front with terms, rates and designs, or None."""
    points = run.result.get("points")
    if not points:
        return None
    names = [aim["name"] for aim in run.result["terms"]]
    words = [label(name) for name in names]
    heads = ["point", *words]
    heads += [f"{words[0]} per {other}" for other in words[1:]]
    heads += [*map(label, points[0]["design"]), "status"]
    rows: list[list[str | Cell]] = []
    base = (run.result.get("baseline") or {}).get("terms") or {}
    if base:
        design = (run.result.get("baseline") or {}).get("design") or {}
        blank = [""] * (len(names) - 1)
        cells = [value(base.get(name)) for name in names] + blank
        rows.append(["baseline", *cells, *map(value, design.values()), ""])
    for point in points:
        numbers = [point["terms"][name] for name in names]
        numbers += [*point["rates"].values(), *point["design"].values()]
        state = status_cell(point["status"])
        rows.append([str(point["point"]), *map(value, numbers), state])
    note = "Rates: what one more unit of the other term costs in the first, along the front."
    return block("Best compromises", heads, [("", rows)], note)


def likeness_block(run: Run) -> Block | None:
    """Return the family members nearest to the profile, or None without a search for them."""
    found = run.result.get("resembles")
    found = found or (run.result.get("beginning") or {}).get("considered")
    rows = [
        [row["family"], value(row["departure_um"]), value(row["departure_rms_um"]),
         ", ".join(f"{label(key)} {value(x)}" for key, x in _with_inset(row).items())]
        for row in found or ()
    ]  # fmt: skip
    if not rows:
        return None
    heads = "family", "largest distance (µm)", "RMS distance (µm)", "nearest member"
    return block("Nearest profiles of the families", heads, [("", rows)])


def _with_inset(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the design of a family member, with its inset (mm) if it has one."""
    inset = row.get("inset_um")
    return row["design"] | ({"inset_mm": inset / 1e3} if inset else {})


def attractor_block(run: Run) -> Block | None:
    """Return the coexisting motions, one row each, or None."""
    rows = []
    for number, record in enumerate(run.result.get("attractors") or (), start=1):
        steady = record.get("steady_state") or {}
        rows.append(
            {"motion": number, "share_of_initial_states": record.get("share"),
             "reached_from_rest": record.get("reached"), **record.get("response", {}),
             "period": steady.get("period"),
             "floquet_multiplier": steady.get("floquet_multiplier"),
             "status": record.get("status")}
        )  # fmt: skip
    if not rows:
        return None
    lost = run.result.get("lost") or {}
    note = "; ".join(f"{100 * share:.3g} % of the initial states: {in_words(name)}"
                     for name, share in lost.items())  # fmt: skip
    return list_block("Coexisting motions", rows, note)


def speeds_blocks(run: Run) -> list[Block]:
    """Return tables of the scenes of a sweep, or of the speeds of an objective."""
    blocks = []
    for name, rows in scene_rows(run).items():
        title = "Contact force in each scene" + (f", {name}" if name else "")
        shown = rows[:_MOST_ROWS]
        note = f"The first {_MOST_ROWS} of {len(rows)} rows." if len(rows) > _MOST_ROWS else ""
        found = list_block(title, shown, note)
        blocks += [found] if found is not None else []
    return blocks


def scene_rows(run: Run) -> dict[str, Sequence[Mapping[str, Any]]]:
    """Return the rows of each design, one per scene; the name is empty if there is only one."""
    if run.rows:
        return {"": run.rows}
    found = {case.name: case.record.get("speeds") for case in run.cases}
    return {name: rows for name, rows in found.items() if rows}


def statistics_block(run: Run) -> Block | None:
    """Return effort and accuracy of the run, and the versions it was made with."""
    cases: Sequence[Case] = [case for case in run.cases if case.record.get("statistics")]
    groups = []
    total = run.result.get("statistics")
    if total and not any(case.record is run.result for case in cases):
        groups.append(("run", [[label(key), value(x)] for key, x in fitting(total).items()]))
    if len(cases) <= _WIDEST:
        for case in cases:
            numbers = fitting(case.record["statistics"])
            rows = [[label(key), value(x)] for key, x in numbers.items()]
            groups.append((case.name if len(cases) > 1 else "simulation", rows))
    versions = run.result.get("versions") or {}
    groups.append(("versions", [[key, str(x)] for key, x in versions.items()]))
    return block("Effort, accuracy and versions", ["", "value"], groups)


def status_block(run: Run) -> Block:
    """Return the meaning of every status, those of this run first, with advice for its scene."""
    met = statuses_in(run.result)
    meanings = {status.label: message_of(run.config, status) for status in Status}
    points = {one.label: one.value for one in Standing}
    here = meanings | points
    rows = [[status_cell(word), here[word]] for word in met if word in here]
    others = [[in_words(word), text] for word, text in meanings.items() if word not in met]
    if run.result.get("points"):
        others += [[in_words(word), text] for word, text in points.items() if word not in met]
    groups = [("in this run", rows), ("not in this run", others)]
    return block("What each status means", ["status", "meaning and advice"], groups)


def statuses_in(data: Any) -> list[str]:
    """Return the labels of all statuses in the result file, each once, in order."""
    found: dict[str, None] = {}

    def look(part: Any) -> None:
        if isinstance(part, Mapping):
            for key, inner in part.items():
                if key in ("status", "evaluation_status") and isinstance(inner, str):
                    found.setdefault(inner)
                else:
                    look(inner)
        elif isinstance(part, list | tuple):
            for inner in part:
                look(inner)

    look(data)
    return list(found)
