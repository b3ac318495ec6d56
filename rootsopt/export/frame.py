"""Dimensions, title block and table of coordinates of a DXF drawing."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rootsopt.export.coordinates import coordinates, widest
from rootsopt.export.drawing import Drawing

CIRCLES, DIMENSIONS, TITLE, TABLE = "CIRCLES", "DIMENSIONS", "TITLE_BLOCK", "TABLE"
"""Names of the DXF layers: outer and root circle, dimensions, title block, coordinates."""
STYLES = {
    CIRCLES: (8, "PHANTOM", 13),
    DIMENSIONS: (3, "CONTINUOUS", 18),
    TITLE: (7, "CONTINUOUS", 25),
    TABLE: (8, "CONTINUOUS", 13),
}
"""Colour index of AutoCAD, line type, line width (1/100 mm) of each layer."""
STYLE = "ROTOR"
"""Name of the dimension style."""
_ROWS = 19
"""Number of points from tip to root in the table of the drawing."""
_LETTER = 0.9
"""Width of a letter as a fraction of its height, with room to spare."""
_BY_LAYER = 256
"""Colour index of lines that have the colour of their layer."""


def add_style(document: Any, drawing: Drawing) -> None:
    """Add the dimension style to a `document` of ezdxf, with sizes (mm) that suit the rotor.

    Dimensions are rounded to 0.001 mm."""
    height = letter(drawing)
    document.dimstyles.add(
        STYLE,
        dxfattribs={
            "dimtxt": height, "dimasz": 0.9 * height, "dimexo": 0.4 * height,
            "dimexe": 0.6 * height, "dimgap": 0.4 * height, "dimtad": 1, "dimdec": 3,
            "dimzin": 8, "dimdsep": ord("."), "dimlunit": 2, "dimtih": 0, "dimtoh": 0,
            "dimclrt": 7, "dimtxsty": "Standard",
        },
    )  # fmt: skip


def letter(drawing: Drawing) -> float:
    """Return the height (mm) of the drawing's letters, which grow with the rotor."""
    return drawing.outer_radius / 26


def add_dimensions(space: Any, drawing: Drawing) -> None:
    """Add the dimensions of the rotor: diameters of bore and circles, and the width of a lobe.

    The circles are outer, pitch and root circle. `space`: modelspace of ezdxf."""
    outer = drawing.outer_radius
    for radius in (outer, drawing.root_radius):
        space.add_circle((0, 0), radius, dxfattribs={"layer": CIRCLES})
    radii = {"outer": outer, "pitch": drawing.pitch_radius, "root": drawing.root_radius}
    if drawing.bore is not None:
        radii["bore"] = drawing.bore / 2
    for row, (name, radius) in enumerate(reversed(radii.items())):
        # One below the other on the left, the smallest nearest to the rotor.
        left = -1.3 * outer - 4.2 * letter(drawing) * row
        space.add_linear_dim(
            base=(left, 0), p1=(0, -radius), p2=(0, radius), angle=90, text=f"%%c<> {name}",
            dimstyle=STYLE, dxfattribs={"layer": DIMENSIONS},
        ).render()  # fmt: skip
    point = widest(drawing.pieces, drawing.lobes)
    space.add_linear_dim(
        base=(1.25 * outer, 0), p1=(point.real, -point.imag), p2=(point.real, point.imag),
        angle=90, text="<> lobe", dimstyle=STYLE, dxfattribs={"layer": DIMENSIONS},
    ).render()  # fmt: skip


def add_title_block(space: Any, drawing: Drawing) -> None:
    """Add the title block below the rotor, and the border of the sheet.

    `space`: modelspace of ezdxf."""
    height = letter(drawing)
    left, right, top = edges(drawing)
    row, upper = 1.9 * height, -1.3 * drawing.outer_radius
    bottom = upper - row * max(len(drawing.block), len(drawing.notes) + 1)
    frame = {"layer": TITLE}
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    space.add_lwpolyline(corners, close=True, dxfattribs=frame)
    space.add_line((left, upper), (right, upper), dxfattribs=frame)
    names = max(len(name) for name, _ in drawing.block) * _LETTER * height + height
    split = right - (_wide(drawing) + 1) * height
    widths = names, right - split - names
    _add_texts(space, TITLE, drawing.block, (split, upper), widths, height)


def add_table(space: Any, drawing: Drawing) -> None:
    """Add a table of points from the tip to the root, at the right of the rotor.

    The other flank is the mirror image. `space`: modelspace of ezdxf."""
    found = coordinates(drawing.pieces, drawing.lobes, 2 * _ROWS - 1)
    half = np.linspace(0.0, found.along[-1], _ROWS)
    kept = [int(np.argmin(np.abs(found.along - place))) for place in half]
    columns = [found.columns()[name][kept] for name in ("x_mm", "y_mm", "radius_mm", "normal_deg")]
    rows = [["no.", "x", "y", "radius", "normal, deg"]]
    for k, numbers in enumerate(zip(*columns, strict=True)):
        rows.append([str(k), *(f"{round(x, 4) + 0.0:.4f}" for x in numbers)])
    height = 0.8 * letter(drawing)
    wide = 11 * _LETTER * height
    right, top = edges(drawing)[1:]
    place = right - 4.6 * wide, top - 2.4 * height
    title = "Half a lobe, tip to root (all points: rotor_points.csv)"
    text = space.add_text(title, height=height, dxfattribs={"layer": TABLE})
    text.set_placement((place[0], top - 1.6 * height))
    _add_texts(space, TABLE, rows, place, [0.6 * wide, *4 * [wide]], height)


def _add_texts(space: Any, layer: str, rows: Sequence[Sequence[str]], place: tuple[float, float],
               widths: Sequence[float], height: float) -> None:  # fmt: skip
    """Add a table of texts with its grid.

    `place`: upper left corner (mm); `widths` of the columns (mm); `height` of the letters (mm)."""
    from ezdxf.addons.tablepainter import TablePainter
    from ezdxf.enums import MTextEntityAlignment

    made = TablePainter(place, len(rows), len(widths), cell_height=1.9 * height)
    made.fg_layer_name = made.grid_layer_name = layer
    look = {"char_height": height, "margin_x": 0.5 * height}
    style = made.new_cell_style("text", align=MTextEntityAlignment.MIDDLE_LEFT, **look)
    style.set_border_style(made.new_border_style(color=_BY_LAYER))
    for column, width in enumerate(widths):
        made.set_col_width(column, width)
        for row, texts in enumerate(rows):
            made.text_cell(row, column, plain(texts[column]), style="text")
    made.render(space)


def edges(drawing: Drawing) -> tuple[float, float, float]:
    """Return the left, right and top edge of the sheet (mm)."""
    outer, height = drawing.outer_radius, letter(drawing)
    left = -1.3 * outer - 4.2 * height * 4
    right = 1.5 * outer + 4.7 * 11 * _LETTER * 0.8 * height
    notes = max(map(len, drawing.notes)) * _LETTER * height
    return left, max(right, left + notes + (_wide(drawing) + 2) * height), 1.3 * outer


def _wide(drawing: Drawing) -> float:
    """Return the width of the title block, in heights of its letters."""
    return _LETTER * sum(max(len(row[k]) for row in drawing.block) for k in (0, 1)) + 2


def plain(text: str) -> str:
    """Return a text without the codes that CAD programs replace (`%%c`, `^J`)."""
    return text.replace("%%", "% %").replace("^", "^ ")


__all__ = [
    "STYLES",
    "add_dimensions",
    "add_style",
    "add_table",
    "add_title_block",
    "edges",
    "letter",
    "plain",
]
