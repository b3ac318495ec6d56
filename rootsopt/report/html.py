"""Makes the report of a run: one HTML file that opens without a network.

The page is a Jinja2 template, and plotly's script is part of it. Everything that comes from a
config or a result is escaped."""

import base64
import datetime
import re
from pathlib import Path
from typing import Any

import rootsopt
from rootsopt.output import tables
from rootsopt.output.names import in_words
from rootsopt.output.table import status_cell
from rootsopt.report import charts, wording
from rootsopt.report.gather import Run
from rootsopt.report.meshing import animations

_TEMPLATE = Path(__file__).with_name("template")
_CAPTIONS = {
    "profiles.png": "Rotor profile, and its flank",
    "meshing.png": "The pair at six rotations of one lobe pitch",
    "conjugacy.png": "Gap between the flanks of the outline in perfect rolling",
    "force.png": "Contact force over time",
    "spectrum.png": "Spectrum of the contact force",
    "comparison.png": "Forces together, and departure of the flanks",
    "history.png": "Objective and design over the search",
    "optimum.png": "Certificate: residual, prices of the limits, starts",
    "speeds.png": "Contact force over speed",
    "basins.png": "Initial states and the motion that each leads to",
    "front.png": "Best compromises",
    "tolerances.png": "Forces in fresh scenes that scatter",
}
"""Captions of the figures by file name; other figures are named after their file."""
_CODE = re.compile(r"`([^`]*)`")
_UNIT = re.compile(r"(?<=\d) (?=(?:N·m|N|%|mm|µm|ms|rpm|bar|Pa|kPa|mrad|l/min)(?![\w/]))")
"""Spaces between a number and its unit, where a line must not break."""


def report_text(run: Run) -> str:
    """Return the HTML of the report of a `run`. Characters that UTF-8 lacks become `?`."""
    import jinja2
    import markupsafe
    from plotly import offline

    def coded(text: str) -> markupsafe.Markup:
        """Return a sentence with `commands` set as code, and numbers beside their units."""
        text = _UNIT.sub("\N{NO-BREAK SPACE}", text)
        return markupsafe.Markup(_CODE.sub(_command, str(markupsafe.escape(text))))

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["coded"] = coded
    drawn = _charts(run)
    status = status_cell(str(run.result.get("status", "")))
    animation = animations(run.cases)
    text = environment.get_template("page.html.j2").render(
        title=wording.title(run),
        run=run,
        command_line=f"rootsopt {run.command} {run.source}",
        version=rootsopt.__version__,
        day=datetime.date.today().isoformat(),
        status=status,
        good=run.usable and status.good is not False,
        asked=wording.asked(run),
        came_out=wording.came_out(run),
        what_next=wording.what_next(run),
        conflict=tables.conflict_table(run.result),
        sections=tables.sections(run.result, run.rows),
        charts=drawn,
        animation=animation,
        data={"charts": [one["figure"] for one in drawn], "animation": animation},
        figures=[
            {
                "caption": _CAPTIONS.get(name, in_words(name.removesuffix(".png")).capitalize()),
                "data": base64.b64encode(data).decode(),
            }
            for name, data in run.figures.items()
        ],
        statuses=tables.status_table(run.result, run.config),
        effort=tables.effort_table(run.result),
        style=markupsafe.Markup((_TEMPLATE / "page.css").read_text("utf-8")),
        script=markupsafe.Markup((_TEMPLATE / "page.js").read_text("utf-8")),
        plotly=markupsafe.Markup(offline.get_plotlyjs()) if drawn else "",
    )
    return text.encode("utf-8", "replace").decode("utf-8")


def _command(found: re.Match[str]) -> str:
    """Return the HTML of a command, whose options are not divided at their hyphens."""
    words = found[1].split(" ")
    kept = (f'<span class="word">{x}</span>' if x.startswith("-") else x for x in words)
    return f"<code>{' '.join(kept)}</code>"


def _charts(run: Run) -> list[dict[str, Any]]:
    """Return the interactive charts of a run: title, explanation, and plotly's figure."""
    hover = "Hover over a point to see its design."
    found = [(title, hover, figure) for title, figure in charts.front_charts(run)]
    found += [
        (
            "Contact force over time",
            "Hover for values, drag to zoom, double-click to zoom out. A click moves the rotors "
            "below to that time.",
            charts.force_chart(run.cases),
        ),
        (
            "Spectrum of the contact force",
            "The mean is left out. A click on a name hides or shows its lines.",
            charts.spectrum_chart(run.cases),
        ),
        (
            "Contact force in each scene",
            "A cross: no steady state.",
            charts.scenes_chart(tables.scene_rows(run.result, run.rows)),
        ),
    ]
    keys = "title", "note", "figure"
    return [dict(zip(keys, one, strict=True)) for one in found if one[2] is not None]


__all__ = ["report_text"]
