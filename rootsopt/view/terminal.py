"""Tables for the terminal: plain ASCII in 80 columns, the same in a pipe or a log."""

import re
from collections.abc import Iterable, Iterator, Mapping

import rich.table
from rich import box
from rich.console import Console, Group
from rich.text import Text

from rootsopt.view.ending import Ending
from rootsopt.view.names import Table

WIDTH = 80
"""Width (characters) above which the columns of a table go to several tables."""

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
    text = _POWER.sub(lambda found: f"e{int(found[1].translate(_PLAIN)):+03d}", text)
    text = re.sub(r"(?<=\d)°", " deg", text).replace("°", "deg").translate(_ASCII)
    return text.encode("ascii", "replace").decode()


def shown(tables: Iterable[Table | None]) -> Group:
    """Return tables and their notes for a rich console; None stands for a table without rows."""
    return Group(*(part for one in tables if one is not None for part in _parts(one)))


def show_ending(out: Console, end: Ending) -> None:
    """Print the end of a run. Commands stand in lines of their own, as they are to be pasted."""
    for heading, sentences in end.facts:
        out.print(Text.assemble((f"{heading}: ", "bold"), ascii_text(sentences)), width=WIDTH)
    for purpose, command in end.steps:
        mark = ":" if command else ""
        out.print(Text.assemble(("Next: ", "bold"), ascii_text(purpose), mark), width=WIDTH)
        if command:
            out.print(f"  {command}", soft_wrap=True, markup=False, highlight=False)


def _parts(table: Table) -> Iterator[rich.table.Table | Text]:
    for widths in _split(table):
        yield _drawn(table, widths)
    if table.note:
        yield Text(ascii_text(table.note))


def _split(table: Table) -> Iterator[dict[int, int]]:
    """Yield {index: width} of the columns that fit side by side, the first column each time."""
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
        if _total(widths) + width + _BETWEEN > WIDTH and len(widths) > 1:
            yield _widened(widths, wanted)
            widths = {0: first}
        widths[column] = width
    yield _widened(widths, wanted)


def _total(widths: Mapping[int, int]) -> int:
    return sum(widths.values()) + _BETWEEN * len(widths) + 1


def _widened(widths: dict[int, int], wanted: list[int]) -> dict[int, int]:
    """Return `widths` with the remaining space given to the columns that lack most."""
    spare = min(WIDTH - _total(widths), sum(wanted[k] - width for k, width in widths.items()))
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
