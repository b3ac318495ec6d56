"""Tables for the terminal, and the end of a run: gains, costs, confidence and next commands.

Tables are plain ASCII in 80 columns, the same in a pipe or a log. Terminal and report show the same
sentences and commands, made from the content of the result file."""

import itertools
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import rich.table
from rich import box
from rich.console import Console, Group
from rich.text import Text

from rootsopt.status import Status
from rootsopt.view import facts
from rootsopt.view.comparison import identified
from rootsopt.view.files import design_file
from rootsopt.view.names import Record, Table, brief, in_words, name_and_unit, stated
from rootsopt.view.tables import records_of

# Function that returns the facts of a run, by command.
_FACTS = {
    "optimize": facts.optimised,
    "simulate": facts.simulated,
    "pareto": facts.traced,
    "sweep": facts.swept,
    "attractors": facts.coexisting,
    "identify": identified,
    "profile": facts.drawn,
}

# Statuses of a run that need no explanation.
_SAID = *facts.STEADY, Status.GEOMETRY_ONLY.label, Status.IDENTIFIED.label

# Pattern of blanks between the sentences of a message: the outcome, then advice.
_SENTENCES = re.compile(r"(?<=[.!?]) (?=[A-Z])(?!In conflict)")
_STOPPED = Status.INTERRUPTED.label, Status.NOT_SIMULATED.label
_DRAW, _SIMULATE = ("Draw the rotor", "profile"), ("Simulate this design", "simulate")
_SPEEDS = "Check it at other speeds", "sweep"
_MOTIONS = "Check whether other motions coexist", "attractors"
_OPTIMISE = "Optimise the design", "optimize"

# What to do after a run with a usable result: (purpose, command).
_NEXT = {
    "optimize": (_DRAW, _SPEEDS, _MOTIONS),
    "simulate": (_OPTIMISE, _SPEEDS, _MOTIONS),
    "profile": (_SIMULATE, _OPTIMISE),
    "attractors": (_OPTIMISE,),
    "identify": (("Simulate the scene that was found", "simulate"), _MOTIONS),
    "pareto": (("Simulate one point", "simulate"), ("Draw its rotor", "profile")),
    "sweep": (_SIMULATE, _MOTIONS),
}

# Objective for flanks that stay apart, by whether the leakage is known: they have no force.
_APART = {
    known: f"objective={{mean_weight: 0, peak_weight: 0, terms: {{{term}: 1}}}}"
    for known, term in ((True, "leakage_fraction"), (False, "flow_ripple"))
}


class Ending(NamedTuple):
    """The end of a run in words.

    `facts`: (heading, sentences) on the outcome; `steps`: (purpose, command) of the next steps. The
    command is "" if no single command follows from the purpose."""

    facts: list[tuple[str, str]]
    steps: list[tuple[str, str]]


def ending(
    result: Record,
    place: Path,
    source: str,
    imports: Sequence[str] = (),
    rows: Sequence[Record] = (),
) -> Ending:
    """Return the end of the run with the content `result` of its result file.

    `place`: path of the result folder; `source`: arguments of the command as the user gave them,
    quoted for a shell; `imports`: values of `--import`, which the next commands need, too; `rows`:
    rows of a sweep, if the result does not hold them."""
    command, status = str(result["run"]["command"]), str(result.get("status", ""))
    again = f"rootsopt {command} {source}"
    command = "optimize" if command == "improve" else command  # They end alike.
    told = _FACTS[command](result, rows)
    first, *advice = re.split(_SENTENCES, str(result.get("message") or ""))
    said = f"{in_words(status).capitalize()}: {first}"
    if status in _STOPPED:
        told.insert(0, ("Status", " ".join([said, *advice])))
        resumed = again if "--resume" in source.split() else f"{again} --resume"
        return Ending(told, [("Go on from where it stopped", resumed)])
    if not _usable(command, status, result, rows):
        told.insert(0, ("Status", said))
        if not [*facts.reserves(result)]:  # Flanks that stay apart need no advice.
            changed = ("Then run it again" if advice else "Run it again with another config", again)
            return Ending(told, [*([(" ".join(advice), "")] if advice else []), changed])
    more = "".join(f" --import {shlex.quote(name)}" for name in imports)
    return Ending(told, [
        (why, f"rootsopt {name} {_quoted(place / file)}{options}{more}")
        for why, name, file, options in _steps(command, result, rows)
    ])  # fmt: skip


def _usable(command: str, status: str, result: Record, rows: Sequence[Record]) -> bool:
    """Return whether a run has a result to report, so that its status needs no explanation.

    A sweep, or a search for coexisting motions, has one if any of its motions has."""
    several = {"sweep": rows, "attractors": result.get("attractors")}
    statuses = [row.get("status") for row in several.get(command) or ()]
    explained = command == "optimize" and result.get("optimized")
    return bool(explained) or not {status, *statuses}.isdisjoint(_SAID)


def _quoted(path: Path) -> str:
    """Return a path for a shell, with `./` if it would look like an option."""
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def _steps(
    command: str, result: Record, rows: Sequence[Record]
) -> Iterator[tuple[str, str, str, str]]:
    """Yield (purpose, command, file in the result folder, options) of what to do next.

    A config without design parameters cannot be optimised."""
    records = [*records_of(result).values()]
    fixed = not any(one.get("design") for one in records)
    names = {"optimize": "optimized.yaml", "identify": "identified.yaml"}
    file, where, sets = names.get(command, "config.yaml"), "", ""
    if command == "pareto":
        number, count = (len(result["points"]) + 1) // 2, len(result["points"])
        file, where = design_file(number), f" (here {number} of {count})"
    if command == "sweep":
        key, (row, *_) = facts.ranked(rows)
        worst = "lowest" if key.endswith("_um") else "highest"
        where = f" in the scene with the {worst} {name_and_unit(key)[0]}"
        sets = "".join(f" --set {shlex.quote(text)}" for text in _settings(row))
    if command == "attractors" and len(records) > 1:
        where, sets = " over all motions, not only that from rest", " --set objective.motion=worst"
    options = {"profile": " --export dxf"}
    for why, name in _NEXT[command]:
        if (command, name) == ("simulate", "optimize"):
            apart = result.get("status") == Status.IDLE.label
            why += "" if apart else _steepest(result)
            known = "volumetric_efficiency" in (result.get("pump") or {})
            options |= {name: f" --set {shlex.quote(_APART[known])}"} if apart else {}
        if not (name == "optimize" and fixed):
            yield f"{why}{where}", name, file, options.get(name, sets)


def _settings(row: Record) -> Iterator[str]:
    """Yield `key=value` for each key that a sweep sets in a row: those before its forces."""
    for key in itertools.takewhile(lambda one: not one.endswith("_force_N"), row):
        if "." in key:
            x = row[key]
            shown = f"{x:.12g}" if isinstance(x, int | float) and x is not True else str(x)
            yield f"{key}={shown}"


def _steepest(record: Record) -> str:
    """Return which design parameter changes the peak force most, as an addition in brackets."""
    slopes = (record.get("gradient") or {}).get("peak_force_N") or {}
    known = {key: x for key, x in slopes.items() if x}
    if not known or len(known) > facts.FEW:
        return ""
    key = max(known, key=lambda one: abs(known[one]))
    word = "raises" if known[key] > 0 else "lowers"
    much = f"{word} the peak force by {brief(abs(known[key]))} N"
    return f" ({stated(key, 1)} more of {name_and_unit(key)[0]} {much})"


# Width (characters) above which a table is split into several tables.
_WIDTH = 80

# Length (characters) above which a text may be folded inside its column.
_LONGEST = 20

# Width (characters) of the frame and the blanks beside a column.
_BETWEEN = 3

# Blanks before the rows of a group with a heading.
_INDENT = 2
_ASCII = str.maketrans(
    {"µ": "u", "×": "x", "−": "-", "–": "-", "≥": ">=", "≤": "<=", "±": "+-", "→": "->", "·": " ",
     "²": "^2", "³": "^3", "Δ": "d", "…": "...", "’": "'"}
)  # fmt: skip
_PLAIN = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_POWER = re.compile(r" × 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)")
_STYLES = {True: "green", False: "bold red", None: ""}


def ascii_text(text: str) -> str:
    """Return a text with the signs of print replaced: 5 µm becomes 5 um, and 4° becomes 4 deg."""
    text = _POWER.sub(lambda match: f"e{int(match[1].translate(_PLAIN)):+03d}", text)
    text = re.sub(r"(?<=\d)°", " deg", text).replace("°", "deg").translate(_ASCII)
    return text.encode("ascii", "replace").decode()


def shown(tables: Iterable[Table | None]) -> Group:
    """Return tables and their notes for a rich console; None stands for a table without rows."""
    return Group(*(part for one in tables if one is not None for part in _parts(one)))


def show_ending(out: Console, end: Ending) -> None:
    """Print the end of a run. Commands stand in lines of their own, as they are to be pasted."""
    for heading, sentences in end.facts:
        out.print(Text.assemble((f"{heading}: ", "bold"), ascii_text(sentences)), width=_WIDTH)
    for purpose, command in end.steps:
        mark = ":" if command else ""
        out.print(Text.assemble(("Next: ", "bold"), ascii_text(purpose), mark), width=_WIDTH)
        if command:
            out.print(f"  {command}", soft_wrap=True, markup=False, highlight=False)


def _parts(table: Table) -> Iterator[rich.table.Table | Text]:
    for widths in _split(table):
        yield _drawn(table, widths)
    if table.note:
        yield Text(ascii_text(table.note))


def _split(table: Table) -> Iterator[dict[int, int]]:
    """Yield {index: width} of the columns of each part, which repeats the first column."""
    wanted = [*map(len, map(ascii_text, table.heads))]
    least = [max(map(len, ascii_text(head).split()), default=0) for head in table.heads]
    body = (row for _, rows in table.groups for row in rows)
    for column, cells in enumerate(zip(*body, strict=True)):
        longest = max(len(ascii_text(cell.text)) for cell in cells)
        longest += _INDENT * (column == 0 and bool(table.groups[0][0]))
        wanted[column] = max(wanted[column], longest)
        least[column] = max(least[column], min(longest, _LONGEST))
    first, *others = least
    widths = {0: first}
    for column, width in enumerate(others, start=1):
        if _total(widths) + width + _BETWEEN > _WIDTH and len(widths) > 1:
            yield _widened(widths, wanted)
            widths = {0: first}
        widths[column] = width
    yield _widened(widths, wanted)


def _total(widths: Mapping[int, int]) -> int:
    return sum(widths.values()) + _BETWEEN * len(widths) + 1


def _widened(widths: dict[int, int], wanted: list[int]) -> dict[int, int]:
    """Return `widths` with the remaining space given to the columns that need most."""
    spare = min(_WIDTH - _total(widths), sum(wanted[k] - width for k, width in widths.items()))
    for _ in range(spare):
        widths[max(widths, key=lambda k: wanted[k] - widths[k])] += 1
    return widths


def _drawn(table: Table, widths: Mapping[int, int]) -> rich.table.Table:
    """Return the columns in `widths` of a table, drawn by rich."""
    title = Text(ascii_text(table.title), style="bold")
    made = rich.table.Table(title=title, box=box.ASCII, title_justify="left")
    for column, width in widths.items():
        head, side = Text(ascii_text(table.heads[column])), "right" if column else "left"
        made.add_column(head, justify=side, overflow="fold", width=width)
    for heading, rows in table.groups:
        made.add_section()
        if heading:
            made.add_row(Text(ascii_text(heading), style="bold"))
        for row in rows:
            chosen = (row[column] for column in widths)
            label, *cells = (Text(ascii_text(x.text), _STYLES[x.good]) for x in chosen)
            made.add_row(Text(" " * _INDENT if heading else "") + label, *cells)
    return made
