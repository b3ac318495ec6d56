"""Lays out pages: the report of a run, and the page of a front. Both open without a network.

The pages are Jinja2 templates, and Bokeh's script is part of them. Everything that comes from a
config or a result is escaped."""

# pyright: reportArgumentType=false
# (Bokeh takes any text for the identifier of an element.)

import base64
import datetime
import functools
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jinja2
from bokeh.embed import json_item
from bokeh.resources import Resources
from markupsafe import Markup, escape

import rootsopt
from rootsopt.view import tables
from rootsopt.view.names import Table, in_words
from rootsopt.view.pages import charts, words
from rootsopt.view.pages.charts import animations
from rootsopt.view.pages.gather import Run
from rootsopt.view.pages.words import anchor, glossary, linked

TEMPLATE = Path(__file__).with_name("report")
"""Folder of the templates, styles and scripts."""

# Captions of the figures by file name; other figures are named after their file.
_CAPTIONS = {
    "profiles.png": "Rotor profile, and its flank",
    "meshing.png": "The pair at six rotations of one lobe pitch",
    "conjugacy.png": "Gap between the flanks of the outline in perfect rolling",
    "force.png": "Contact force over time",
    "spectrum.png": "Spectrum of the contact force",
    "gap.png": "Gap of the flanks over time",
    "comparison.png": "Forces together, and departure of the flanks",
    "history.png": "Objective and design over the search",
    "speeds.png": "Contact force over speed",
    "basins.png": "Initial states and the motion that each leads to",
    "front.png": "Best compromises",
    "identified.png": "Record and fit, orders, and regions of the quantities",
    "tolerances.png": "Forces in fresh scenes that scatter",
    "feasible.png": "Designs that satisfy all limits",
    "assumptions.png": "Objective over what is assumed about the scene",
}
_CODE = re.compile(r"`([^`]*)`")

# Spaces between a number and its unit, where a line must not break.
_UNIT = re.compile(r"(?<=\d) (?=(?:N·m|N|%|mm|µm|ms|rpm|bar|Pa|kPa|mrad|l/min)(?![\w/]))")


@functools.cache
def _environment() -> jinja2.Environment:
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"anchor": anchor, "coded": _coded, "command": _command, "linked": linked}
    made.policies["json.dumps_kwargs"] = {}  # Bokeh reads its models in the order of writing.
    return made


def _coded(text: str) -> Markup:
    """Return a sentence with `commands` set as code, and numbers beside their units."""
    text = _UNIT.sub("\N{NO-BREAK SPACE}", text)
    return Markup(_CODE.sub(lambda found: _command(Markup(found[1])), str(escape(text))))


def _command(text: str) -> Markup:
    """Return the HTML of a command, whose options are not divided at their hyphens."""
    parts = str(escape(text)).split(" ")
    kept = (f'<span class="word">{x}</span>' if x.startswith("-") else x for x in parts)
    return Markup(f"<code>{' '.join(kept)}</code>")


def table_html(table: Table | None) -> str:
    """Return a table as HTML; "" for None."""
    made: Any = _environment().get_template("table.html.j2").module
    return "" if table is None else str(made.table(table))


def _part(*names: str) -> Markup:
    """Return files of the template folder, one after the other, as they are."""
    return Markup("\n".join((TEMPLATE / name).read_text("utf-8") for name in names))


def _page(template: str, drawn: Iterable[Any], data: Mapping[str, Any], **facts: Any) -> str:
    """Return a page with charts. Characters that UTF-8 lacks become `?`.

    `drawn`: the charts; `data`: what the scripts of the page read; `facts`: what its template
    reads."""
    items = [json_item(one, f"chart-{k}", charts.THEME) for k, one in enumerate(drawn)]
    name = template.partition(".")[0]
    text = (
        _environment()
        .get_template(template)
        .render(
            data={"charts": items, **data},
            style=_part("page.css", "pair.css"),
            script=_part("charts.js", "pair.js", f"{name}.js"),
            bokeh=Markup(Resources("inline", components=["bokeh"]).js_raw[0]) if items else "",
            **facts,
        )
    )
    return text.encode("utf-8", "replace").decode("utf-8")


def report_text(run: Run) -> str:
    """Return the HTML of the report of a `run`."""
    drawn = _charts(run)
    status = tables.status_cell(str(run.result.get("status", "")))
    animation = animations(run.cases)
    return _page(
        "page.html.j2",
        [chart for *_, chart in drawn],
        {"animation": animation},
        title=words.title(run),
        run=run,
        command_line=f"rootsopt {run.command} {run.source}",
        version=rootsopt.__version__,
        day=datetime.date.today().isoformat(),
        status=status,
        good=run.usable and status.good is not False,
        asked=words.asked(run),
        end=run.end,
        conflict=tables.conflict_table(run.result),
        sections=tables.sections(run.result, run.rows),
        charts=[(title, note) for title, note, _ in drawn],
        animation=animation,
        pair=_part("pair.html"),
        figures=[
            {
                "caption": _CAPTIONS.get(name, in_words(name.removesuffix(".png")).capitalize()),
                "data": base64.b64encode(data).decode(),
            }
            for name, data in run.figures.items()
        ],
        statuses=tables.status_table(run.result, run.config),
        effort=tables.effort_table(run.result),
        glossary=glossary(),
    )


def _charts(run: Run) -> list[tuple[str, str, Any]]:
    """Return (title, explanation, chart) of each interactive chart of a run."""
    hover = "Hover over a point to see its design."
    found = [(title, hover, made) for title, made in charts.front_charts(run.result).items()]
    force = (
        "Contact force over time",
        "Hover for values, drag to zoom; a button at the right zooms out. A click moves the rotors "
        "below to that time.",
        charts.force_chart(run.cases),
    )
    found.append(force)
    return [one for one in found if one[2] is not None]
