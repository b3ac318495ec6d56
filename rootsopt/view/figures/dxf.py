"""DXF drawing of one rotor (mm): true arcs and splines, dimensions, title block, coordinates."""

import io
import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from rootsopt.view.figures.drawing import Drawing, coordinates, widest
from rootsopt.view.figures.pieces import Arc

OUTLINE, BORE, PITCH, CENTER, TEXT = "OUTLINE", "BORE", "PITCH_CIRCLE", "CENTER_LINES", "TEXT"
"""Names of the DXF layers: outline, bore, pitch circle, centre lines and notes."""
CIRCLES, DIMENSIONS, TITLE, TABLE = "CIRCLES", "DIMENSIONS", "TITLE_BLOCK", "TABLE"
"""Names of the DXF layers: outer and root circle, dimensions, title block, coordinates."""

# Colour index of AutoCAD (7 is black on white), line type, line width (1/100 mm) of each layer.
_STYLES = {
    OUTLINE: (7, "CONTINUOUS", 50),
    BORE: (7, "CONTINUOUS", 50),
    PITCH: (5, "DASHDOT", 18),
    CENTER: (1, "CENTER", 18),
    TEXT: (8, "CONTINUOUS", 18),
    CIRCLES: (8, "PHANTOM", 13),
    DIMENSIONS: (3, "CONTINUOUS", 18),
    TITLE: (7, "CONTINUOUS", 25),
    TABLE: (8, "CONTINUOUS", 13),
}
_MILLIMETRES = 4
STYLE = "ROTOR"
"""Name of the dimension style."""

# Number of points from tip to root in the table of the drawing.
_ROWS = 19

# Width of a letter as a fraction of its height, with room to spare.
_LETTER = 0.9

# Colour index of lines that have the colour of their layer.
_BY_LAYER = 256


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


def dxf_bytes(drawing: Drawing) -> bytes:
    """Return the content of a DXF file (R2010, mm) of a `drawing` of one rotor.

    The outline's entities are in counter-clockwise order, and adjacent entities share their ends.
    """
    # Imported here because it takes a quarter of a second; it also logs its start.
    logging.getLogger("ezdxf").setLevel(logging.WARNING)
    import ezdxf

    document = ezdxf.new("R2010", setup=["linetypes"], units=_MILLIMETRES)  # type: ignore[attr-defined]
    document.header["$LTSCALE"] = drawing.outer_radius / 20
    for name, (color, linetype, width) in _STYLES.items():
        document.layers.add(name, color=color, linetype=linetype, lineweight=width)
    space = document.modelspace()
    for piece in drawing.pieces:
        if isinstance(piece, Arc):
            # In DXF an arc runs counter-clockwise.
            ends = sorted([piece.begin, piece.begin + piece.sweep])
            first, last = np.degrees(ends)
            center = piece.center.real, piece.center.imag
            layer = {"layer": OUTLINE}
            space.add_arc(center, piece.radius, float(first), float(last), dxfattribs=layer)
        else:
            spline = space.add_spline(degree=3, dxfattribs={"layer": OUTLINE})
            spline.control_points = [(z.real, z.imag, 0.0) for z in piece.controls]
            spline.knots = list(map(float, piece.knots))
    if drawing.bore is not None:
        space.add_circle((0, 0), drawing.bore / 2, dxfattribs={"layer": BORE})
    space.add_circle((0, 0), drawing.pitch_radius, dxfattribs={"layer": PITCH})
    reach = drawing.reach
    for end in ((reach, 0), (0, reach)):
        start = -end[0], -end[1]
        space.add_line(start, end, dxfattribs={"layer": CENTER})
    add_style(document, drawing)
    add_dimensions(space, drawing)
    add_title_block(space, drawing)
    add_table(space, drawing)
    _add_notes(space, drawing)
    text = io.StringIO()
    document.write(text)
    return document.encode(text.getvalue())


def _add_notes(space: Any, drawing: Drawing) -> None:
    """Add the lines of text beside the title block."""
    height, left = letter(drawing), edges(drawing)[0]
    for row, note in enumerate(drawing.notes):
        place = left + height, -1.3 * drawing.outer_radius - 1.9 * height * (row + 1)
        text = space.add_text(plain(note), height=height, dxfattribs={"layer": TEXT})
        text.set_placement(place)
