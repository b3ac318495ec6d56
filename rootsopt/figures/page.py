"""Interactive page of a front: one HTML file that opens without a network.

The figure is made with plotly (the extra `pages`), whose script is part of the page. A click on a
point shows its outline, its terms and its config."""

import html
import importlib.util
import itertools
import json
from typing import Any

from rootsopt.figures.style import BLUE, GREY, ORANGE, VERMILION
from rootsopt.output.files import ResultFolder
from rootsopt.output.fronts import design_file
from rootsopt.scene import outline_mm
from rootsopt.tradeoffs.front import Front, FrontPoint, Standing

PAGE = "front.html"
"""Name of the page in the result folder."""
MISSING = (
    "front.html is not written, because plotly is not installed; install it with "
    "`pip install 'rootsopt[pages]'`"
)
"""Message for the user if the page cannot be made."""

_BUTTONS = {
    "responsive": True,
    "displaylogo": False,
    "modeBarButtons": [["toImage", "zoom2d", "pan2d", "resetScale2d"]],
}
"""Buttons above the figure; all of them work without a network."""


def available() -> bool:
    """Return whether the library that makes the page is installed."""
    return importlib.util.find_spec("plotly") is not None


def write_page(folder: ResultFolder, front: Front) -> str:
    """Write the interactive page of a `front` with at least one point; return its name."""
    from plotly import io, offline

    made = _figure(front)
    picture = io.to_html(
        made, include_plotlyjs=False, full_html=False, div_id="front", config=_BUTTONS
    )
    points = {str(point.number): _entry(front, point) for point in front.points}
    words = [aim.words for aim in front.aims]
    title = f"Trade-off of {', '.join(words[:-1])} against {words[-1]}"
    text = _TEMPLATE
    for mark, part in (
        ("@TITLE@", html.escape(title)),
        ("@MESSAGE@", html.escape(front.message)),
        ("@TABLE@", _table(front)),
        ("@DATA@", json.dumps(points).replace("</", "<\\/")),
        ("@PICTURE@", picture),
        ("@SCRIPT@", offline.get_plotlyjs()),
    ):
        text = text.replace(mark, part)
    folder.write_text(PAGE, text)
    return PAGE


def _entry(front: Front, point: FrontPoint) -> dict[str, Any]:
    """Return the texts and the outline that the page shows after a click on a `point`."""
    config = front.config_of(point)
    outline = outline_mm(config, [*point.design.values()])
    return {
        "file": design_file(point.number).rsplit("/", 1)[-1],
        "yaml": config.to_yaml(),
        # SVG's y axis points down.
        "outline": [[round(float(x), 3), round(-float(y), 3)] for x, y in outline],
        "status": f"{point.standing.label.replace('_', ' ')}: {point.standing.value}",
    }


def _figure(front: Front):
    from plotly import graph_objects, subplots

    names = [aim.name for aim in front.aims]
    pairs = [(y, x) for y, x in itertools.combinations(names, 2)]
    made = subplots.make_subplots(rows=1, cols=len(pairs), horizontal_spacing=0.08)
    for column, (y, x) in enumerate(pairs, start=1):
        aims = {aim.name: aim for aim in front.aims}
        at: dict[str, Any] = {"row": 1, "col": column}
        shown = {"showlegend": column == 1}
        made.add_trace(graph_objects.Scatter(**_lines(front, x, y)), **at)
        for name, style, points in _groups(front):
            made.add_trace(
                graph_objects.Scatter(
                    x=[point.terms[x] for point in points],
                    y=[point.terms[y] for point in points],
                    customdata=[point.number for point in points],
                    text=[_hover(front, point) for point in points],
                    hovertemplate="%{text}<extra></extra>",
                    mode="markers",
                    marker=style,
                    name=name,
                    **shown,
                ),
                **at,
            )
        if front.baseline_terms:
            base = front.baseline_terms
            made.add_trace(
                graph_objects.Scatter(
                    x=[base[x]], y=[base[y]], mode="markers", name="baseline",
                    marker={"symbol": "star", "size": 15, "color": VERMILION},
                    hovertemplate=f"baseline<br>{_terms(front, base)}<extra></extra>", **shown,
                ),
                **at,
            )  # fmt: skip
        made.update_xaxes(title_text=aims[x].label, **at)
        made.update_yaxes(title_text=aims[y].label, **at)
    made.update_layout(
        template="plotly_white",
        height=560,
        margin={"l": 70, "r": 20, "t": 30, "b": 60},
        legend={"orientation": "h", "y": 1.08},
        hoverlabel={"align": "left"},
    )
    return made


def _lines(front: Front, x: str, y: str) -> dict[str, Any]:
    """Return the lines between neighbours as one trace, interrupted between them."""
    across, up = [], []
    for pair in front.edges:
        for k in pair:
            across.append(front.points[k - 1].terms[x])
            up.append(front.points[k - 1].terms[y])
        across.append(None)
        up.append(None)
    line = {"color": GREY, "width": 1.2}
    return {"x": across, "y": up, "mode": "lines", "line": line, "hoverinfo": "skip",
            "showlegend": False}  # fmt: skip


def _groups(front: Front):
    """Return (name, marker, points) of each kind of point that the front has."""
    sure = [point for point in front.points if point.standing is Standing.CERTIFIED]
    unsure = [point for point in front.points if point.standing is not Standing.CERTIFIED]
    sides = {k for gap in front.gaps for k in (gap.first, gap.second)}
    beside = [point for point in front.points if point.number in sides]
    ring = {"symbol": "circle-open", "size": 19, "color": ORANGE, "line": {"width": 2}}
    hollow = {"symbol": "circle-open", "size": 11, "color": BLUE}
    groups = [
        ("side of a gap", ring, beside),
        ("certified", {"size": 11, "color": BLUE}, sure),
        ("not certified", hollow, unsure),
    ]
    return [group for group in groups if group[2]]


def _hover(front: Front, point: FrontPoint) -> str:
    lines = [f"<b>point {point.number}</b>, {point.standing.label.replace('_', ' ')}"]
    lines.append(_terms(front, point.terms))
    lines += [f"{html.escape(key)}: {value:.5g}" for key, value in point.design.items()]
    return "<br>".join(lines)


def _terms(front: Front, terms: dict[str, float]) -> str:
    rows = (f"{html.escape(aim.words)}: {terms[aim.name]:.5g} {aim.unit}" for aim in front.aims)
    return "<br>".join(row.strip() for row in rows)


def _table(front: Front) -> str:
    """Return the points as the rows of an HTML table."""
    first = front.aims[0].words
    heads = ["point", *(aim.label for aim in front.aims)]
    heads += [f"{first} per {aim.words}" for aim in front.aims[1:]]
    heads += [*front.points[0].design, "status"]
    rows = ["<tr>" + "".join(f"<th>{html.escape(head)}</th>" for head in heads) + "</tr>"]
    for point in front.points:
        numbers = [*point.terms.values(), *point.rates.values(), *point.design.values()]
        cells = [str(point.number)]
        cells += ["–" if value != value else f"{value:.5g}" for value in numbers]
        cells.append(point.standing.label.replace("_", " "))
        row = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        rows.append(f'<tr data-point="{point.number}" tabindex="0">{row}</tr>')
    return "".join(rows)


_TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>@TITLE@</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.2em auto; max-width: 1250px; color: #222; }
h1 { font-size: 1.3em; margin-bottom: .2em; }
#chosen { display: grid; grid-template-columns: minmax(260px, 380px) 1fr; gap: 1.5em; }
#outline { width: 100%; aspect-ratio: 1; background: #f7f7f7; }
#outline path { fill: #cfe3f2; stroke: #0072B2; stroke-width: .4; }
#outline path.other { fill: none; stroke: #808080; stroke-dasharray: 1.2 .8; }
pre { max-height: 26em; overflow: auto; background: #f7f7f7; padding: .8em; margin: .4em 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9em; }
td, th { padding: .25em .6em; text-align: right; border-bottom: 1px solid #ddd; }
tr[data-point] { cursor: pointer; }
tr[data-point]:hover, tr[data-point]:focus { background: #eef5fa; }
tr.chosen { background: #d8eaf6; }
</style>
<script>@SCRIPT@</script>
</head>
<body>
<h1>@TITLE@</h1>
<p>@MESSAGE@ Hover over a point to see its design; click on it, or on its row, for its rotor and
config.</p>
@PICTURE@
<h2 id="name">Click on a point</h2>
<p id="status"></p>
<div id="chosen">
<svg id="outline" role="img" aria-label="outline of the rotor"></svg>
<div><button id="save" disabled>Save its config</button><pre id="yaml"></pre></div>
</div>
<div class="wide"><table>@TABLE@</table></div>
<script>
const points = @DATA@;
let chosen = null;
function path(outline) {
  return "M" + outline.map(p => p.join(" ")).join("L") + "Z";
}
function choose(number) {
  const point = points[number], before = chosen && points[chosen];
  if (!point) return;
  document.getElementById("name").textContent =
    "Point " + number + (chosen && chosen !== number ? " (dashed: point " + chosen + ")" : "");
  document.getElementById("status").textContent = point.status;
  document.getElementById("yaml").textContent = point.yaml;
  const size = 1.05 * Math.max(...Object.values(points).flatMap(one =>
    one.outline.map(p => Math.hypot(p[0], p[1]))));
  const svg = document.getElementById("outline");
  svg.setAttribute("viewBox", [-size, -size, 2 * size, 2 * size].join(" "));
  svg.innerHTML = '<path d="' + path(point.outline) + '"/>' +
    (before && before !== point ? '<path class="other" d="' + path(before.outline) + '"/>' : "");
  for (const row of document.querySelectorAll("tr[data-point]"))
    row.classList.toggle("chosen", row.dataset.point === number);
  const save = document.getElementById("save");
  save.disabled = false;
  save.onclick = () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([point.yaml], {type: "application/yaml"}));
    link.download = point.file;
    link.click();
    URL.revokeObjectURL(link.href);
  };
  chosen = number;
}
document.getElementById("front").on("plotly_click", event => {
  const hit = event.points.find(one => one.customdata !== undefined);
  if (hit) choose(String(hit.customdata));
});
for (const row of document.querySelectorAll("tr[data-point]")) {
  row.onclick = () => choose(row.dataset.point);
  row.onkeydown = event => { if (event.key === "Enter") choose(row.dataset.point); };
}
</script>
</body>
</html>
"""

__all__ = ["MISSING", "PAGE", "available", "write_page"]
