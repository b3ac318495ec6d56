"""DXF drawing of one rotor in millimetres: true arcs and splines on layers."""

import io
import logging
from typing import Any

import numpy as np

from rootsopt.export import frame
from rootsopt.export.drawing import Drawing
from rootsopt.export.pieces import Arc

OUTLINE, BORE, PITCH, CENTER, TEXT = "OUTLINE", "BORE", "PITCH_CIRCLE", "CENTER_LINES", "TEXT"
"""Names of the DXF layers: outline, bore, pitch circle, centre lines and notes."""
_MILLIMETRES = 4
# Layer: colour index of AutoCAD (7 is black on white), line type, line width in 1/100 mm.
_STYLES = {
    OUTLINE: (7, "CONTINUOUS", 50),
    BORE: (7, "CONTINUOUS", 50),
    PITCH: (5, "DASHDOT", 18),
    CENTER: (1, "CENTER", 18),
    TEXT: (8, "CONTINUOUS", 18),
} | frame.STYLES


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
    frame.add_style(document, drawing)
    frame.add_dimensions(space, drawing)
    frame.add_title_block(space, drawing)
    frame.add_table(space, drawing)
    _add_notes(space, drawing)
    text = io.StringIO()
    document.write(text)
    return document.encode(text.getvalue())


def _add_notes(space: Any, drawing: Drawing) -> None:
    """Add the lines of text beside the title block."""
    height, left = frame.letter(drawing), frame.edges(drawing)[0]
    for row, note in enumerate(drawing.notes):
        place = left + height, -1.3 * drawing.outer_radius - 1.9 * height * (row + 1)
        text = space.add_text(frame.plain(note), height=height, dxfattribs={"layer": TEXT})
        text.set_placement(place)
