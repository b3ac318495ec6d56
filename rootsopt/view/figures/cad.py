"""CAD files (mm): DXF drawing of a rotor with true arcs and splines, solids as STEP and STL.

This is the only module that uses the CAD kernel (build123d on Open CASCADE), an optional
dependency. Lengths are in millimetres, angles in radians.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# (The kernel is optional, and its bindings come without types.)

import dataclasses
import io
import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import make_interp_spline

from rootsopt.errors import InputError
from rootsopt.view.figures.drawing import Drawing, coordinates, widest
from rootsopt.view.figures.pieces import Arc, DrawnPiece

if TYPE_CHECKING:
    from build123d import Compound, Edge, Face, Solid
    from build123d.topology import Shape


# Layers of the DXF file: colour index of AutoCAD (7 is black on white), line type, line width
# (1/100 mm).
_LAYERS = {
    "OUTLINE": (7, "CONTINUOUS", 50),
    "BORE": (7, "CONTINUOUS", 50),
    "PITCH_CIRCLE": (5, "DASHDOT", 18),
    "CENTER_LINES": (1, "CENTER", 18),
    "TEXT": (8, "CONTINUOUS", 18),  # notes
    "CIRCLES": (8, "PHANTOM", 13),  # outer and root circle
    "DIMENSIONS": (3, "CONTINUOUS", 18),
    "TITLE_BLOCK": (7, "CONTINUOUS", 25),
    "TABLE": (8, "CONTINUOUS", 13),  # coordinates
}

# Name of the dimension style.
_STYLE = "ROTOR"

# Number of points from tip to root in the table of the drawing.
_ROWS = 19

# Width of a letter as a fraction of its height, with room to spare.
_LETTER = 0.9


def add_style(document: Any, drawing: Drawing) -> None:
    """Add the dimension style to a `document` of ezdxf, with sizes (mm) that suit the rotor.

    Dimensions are rounded to 0.001 mm."""
    height = letter(drawing)
    document.dimstyles.add(
        _STYLE,
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
        space.add_circle((0, 0), radius, dxfattribs={"layer": "CIRCLES"})
    radii = {"outer": outer, "pitch": drawing.pitch_radius, "root": drawing.root_radius}
    if drawing.bore is not None:
        radii["bore"] = drawing.bore / 2
    for row, (name, radius) in enumerate(reversed(radii.items())):
        # The dimensions are stacked on the left, the smallest nearest to the rotor.
        left = -1.3 * outer - 4.2 * letter(drawing) * row
        space.add_linear_dim(
            base=(left, 0), p1=(0, -radius), p2=(0, radius), angle=90, text=f"%%c<> {name}",
            dimstyle=_STYLE, dxfattribs={"layer": "DIMENSIONS"},
        ).render()  # fmt: skip
    point = widest(drawing.pieces, drawing.lobes)
    space.add_linear_dim(
        base=(1.25 * outer, 0), p1=(point.real, -point.imag), p2=(point.real, point.imag),
        angle=90, text="<> lobe", dimstyle=_STYLE, dxfattribs={"layer": "DIMENSIONS"},
    ).render()  # fmt: skip


def add_title_block(space: Any, drawing: Drawing) -> None:
    """Add the title block below the rotor, and the border of the sheet.

    `space`: modelspace of ezdxf."""
    height = letter(drawing)
    left, right, top = edges(drawing)
    row, upper = 1.9 * height, -1.3 * drawing.outer_radius
    bottom = upper - row * max(len(drawing.block), len(drawing.notes) + 1)
    frame = {"layer": "TITLE_BLOCK"}
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    space.add_lwpolyline(corners, close=True, dxfattribs=frame)
    space.add_line((left, upper), (right, upper), dxfattribs=frame)
    names = max(len(name) for name, _ in drawing.block) * _LETTER * height + height
    split = right - (_wide(drawing) + 1) * height
    widths = names, right - split - names
    _add_texts(space, "TITLE_BLOCK", drawing.block, (split, upper), widths, height)


def add_table(space: Any, drawing: Drawing) -> None:
    """Add a table of points from the tip to the root, at the right of the rotor.

    The other flank is the mirror image. `space`: modelspace of ezdxf."""
    points = coordinates(drawing.pieces, drawing.lobes, 2 * _ROWS - 1)
    half = np.linspace(0.0, points.along[-1], _ROWS)
    kept = [int(np.argmin(np.abs(points.along - place))) for place in half]
    columns = [points.columns()[name][kept] for name in ("x_mm", "y_mm", "radius_mm", "normal_deg")]
    heads = ["no.", "x", "y", "radius", "normal, deg"]
    rows = [
        [str(k), *(f"{round(x, 4) + 0.0:.4f}" for x in numbers)]
        for k, numbers in enumerate(zip(*columns, strict=True))
    ]
    height = 0.8 * letter(drawing)
    wide = 11 * _LETTER * height
    right, top = edges(drawing)[1:]
    place = right - 4.6 * wide, top - 2.4 * height
    title = "Half a lobe, tip to root (all points: rotor_points.csv)"
    text = space.add_text(title, height=height, dxfattribs={"layer": "TABLE"})
    text.set_placement((place[0], top - 1.6 * height))
    _add_texts(space, "TABLE", [heads, *rows], place, [0.6 * wide, *4 * [wide]], height)


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
    style.set_border_style(made.new_border_style())  # Its lines have the colour of the layer.
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

    document = ezdxf.new("R2010", setup=["linetypes"], units=ezdxf.units.MM)  # type: ignore[attr-defined]
    document.header["$LTSCALE"] = drawing.outer_radius / 20
    for name, (color, linetype, width) in _LAYERS.items():
        document.layers.add(name, color=color, linetype=linetype, lineweight=width)
    space = document.modelspace()
    layer = {"layer": "OUTLINE"}
    for piece in drawing.pieces:
        if isinstance(piece, Arc):
            first, last = np.degrees([piece.begin, piece.begin + piece.sweep])
            space.add_arc(_point(piece.center), piece.radius, first, last,
                          is_counter_clockwise=piece.sweep > 0, dxfattribs=layer)  # fmt: skip
        else:
            points, knots = map(_point, piece.controls), piece.knots.tolist()
            space.add_open_spline(points, 3, knots, dxfattribs=layer)
    if drawing.bore is not None:
        space.add_circle((0, 0), drawing.bore / 2, dxfattribs={"layer": "BORE"})
    space.add_circle((0, 0), drawing.pitch_radius, dxfattribs={"layer": "PITCH_CIRCLE"})
    for x, y in ((drawing.reach, 0), (0, drawing.reach)):
        space.add_line((-x, -y), (x, y), dxfattribs={"layer": "CENTER_LINES"})
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
        text = space.add_text(plain(note), height=height, dxfattribs={"layer": "TEXT"})
        text.set_placement(place)


# Maximum distance (mm) between a facet of an STL file and the solid, and maximum angle (rad)
# between neighbouring facets of a curved face.
_CHORD, _TURN = 0.005, 0.05

# Maximum twist (rad) between adjacent knots of a helical face. With this step, a cubic spline
# deviates from the rotation by 5e-8 of the radius.
_STEP = np.pi / 48

# Minimum number of knot spans of a face along the rotor's axis. A straight rotor would need only
# one span. However, most programs compute the volume by the kernel's Gauss quadrature, which uses
# more points with more spans. With one span, the computed volume has a relative error of 2e-4
# next to a cusp, although the solid itself is exact to 1e-8.
_SPANS = 8


def rotor(pieces: list[DrawnPiece], length: float, bore: float | None, helix: float) -> "Solid":
    """Return the solid of one rotor between z = 0 and z = `length` (mm).

    `pieces`: closed outline (mm) at z = 0; `bore`: bore diameter (mm), `None` for no bore;
    `helix`: angle (rad) by which the outline at z = `length` is turned from that at z = 0.
    """
    from build123d import Axis, Edge, Face, Shell, Solid, Vector, Wire

    if helix != 0:
        pieces = [part for piece in pieces for part in _quarters(piece)]
    up = Vector(0, 0, length)
    hole = [] if bore is None else [Edge.make_circle(bore / 2)]
    bottom = Face(Wire([_edge(piece) for piece in pieces]), [Wire([edge]) for edge in hole])
    top = bottom.rotate(Axis.Z, np.degrees(helix)).translate(up)
    sides = [_side(piece, length, helix) for piece in pieces]
    sides += [Face.extrude(edge, up) for edge in hole]
    solid = Solid(Shell([bottom, top, *sides]))
    solid.label = "rotor"
    return solid


def pair(
    pieces: list[DrawnPiece],
    lobes: int,
    center_distance: float,
    length: float,
    bore: float | None,
    helix: float,
) -> "Compound":
    """Return both rotors as one assembly, at rotation φ = 0.

    Rotor 1 is at the origin with a lobe on +x. Rotor 2 is at x = `center_distance` (mm), has a
    valley opposite this lobe, and is twisted the other way. `lobes`: number of lobes of a rotor;
    `pieces`, `length`, `bore`, `helix`: as in `rotor`.
    """
    from build123d import Axis, Compound, Vector

    first, second = (rotor(pieces, length, bore, turn) for turn in (helix, -helix))
    # Rotor 2 is the mirror image of a symmetric rotor, turned by π/N.
    second = second.rotate(Axis.Z, 180 - 180 / lobes).translate(Vector(center_distance, 0, 0))
    first.label, second.label = "rotor_1", "rotor_2"
    return Compound(label="rotor_pair", children=[first, second])


def step_bytes(shape: "Shape") -> bytes:
    """Return the content of a STEP file (mm) of `shape`, a solid or an assembly."""
    from build123d import export_step

    file = io.BytesIO()
    export_step(shape, file)
    return file.getvalue()


def stl_bytes(shape: "Shape", place: Path | None = None) -> bytes:
    """Return the content of a binary STL file (mm) within 0.005 mm and 0.05 rad of the shape.

    The kernel writes a temporary file in the folder `place`. `None`: the system's folder for
    temporary files. Raises `InputError` if the kernel fails to make triangles.
    """
    from build123d import export_stl

    with tempfile.TemporaryDirectory(dir=place) as folder:
        file = Path(folder) / "shape.stl"
        if not export_stl(shape, file, tolerance=_CHORD, angular_tolerance=_TURN):
            raise InputError("the solid cannot be split into triangles; export step instead")
        return file.read_bytes()


def _point(z: complex) -> tuple[float, float, float]:
    return float(z.real), float(z.imag), 0.0


def _edge(piece: DrawnPiece) -> "Edge":
    from build123d import AngularDirection, Edge, Plane

    if not isinstance(piece, Arc):
        return Edge.make_bspline([_point(z) for z in piece.controls], piece.knots, 3)
    ways = AngularDirection.COUNTER_CLOCKWISE, AngularDirection.CLOCKWISE
    first, last = np.degrees([piece.begin, piece.begin + piece.sweep])
    plane = Plane(_point(piece.center))
    return Edge.make_circle(piece.radius, plane, first, last, ways[piece.sweep < 0])


def _side(piece: DrawnPiece, length: float, helix: float) -> "Face":
    """Return the side face of the rotor over one piece of the outline.

    `length`, `helix`: as in `rotor`. The face is a cylinder over an arc of a straight rotor,
    otherwise a B-spline surface. The kernel's own twisted sweeps are not used: they have a relative
    error of 1e-4 near a cusp.
    """
    from build123d import Face, Vector

    if isinstance(piece, Arc) and helix == 0:
        return Face.extrude(_edge(piece), Vector(0, 0, length))
    degree, knots, controls, weights = _rational(piece)
    # Along z the points turn as exp(iθ). With the control points ρ of a cubic spline of exp(iθ) and
    # c of the piece, the control points of the surface are c ρ.
    turns = max(_SPANS, int(np.ceil(abs(helix) / _STEP)))
    share = np.linspace(0, 1, turns + 1)
    rate = 1j * helix
    ends = ([(1, rate)], [(1, rate * np.exp(rate))])
    rising = make_interp_spline(share, np.exp(rate * share), k=3, bc_type=ends)
    heights = length * np.array([rising.t[i + 1 : i + 4].mean() for i in range(len(rising.c))])
    points = controls[:, None] * rising.c
    return _surface((degree, 3), (knots, rising.t), points, heights, weights)


def _rational(piece: DrawnPiece):
    """Return (degree, knots, control points, weights) of a piece as a rational B-spline.

    An arc must be shorter than half a circle.
    """
    if not isinstance(piece, Arc):
        return 3, piece.knots, piece.controls, np.ones(len(piece.controls))
    half = piece.sweep / 2
    weights = np.array([1, np.cos(half), 1])
    circle = piece.radius / weights * np.exp(1j * (piece.begin + half * np.arange(3)))
    return 2, np.repeat([0, piece.length], 3), piece.center + circle, weights


def _quarters(piece: DrawnPiece) -> list[DrawnPiece]:
    """Split an arc into parts of at most a quarter of a circle; return a spline unchanged."""
    if not isinstance(piece, Arc):
        return [piece]
    count = int(np.ceil(abs(piece.sweep) / (np.pi / 2) - 1e-9))
    sweep = piece.sweep / count
    return [
        dataclasses.replace(piece, begin=piece.begin + k * sweep, sweep=sweep) for k in range(count)
    ]


def _surface(degrees, knots, points, heights, weights) -> "Face":
    """Return a face on a rational B-spline surface (mm).

    `points` (n, m): x + iy of the control points; `heights` (m,): their z; `weights` (n,): their
    weights. `degrees`, `knots`: pairs of values, the first along the outline and the second along
    the axis."""
    from build123d import Face
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.collections import Array1_double, Array1_int, Array2_double, Array2_gp_Pnt
    from OCP.Geom import Geom_BSplineSurface
    from OCP.gp import gp_Pnt

    rows, columns = points.shape
    poles = Array2_gp_Pnt(1, rows, 1, columns)
    shares = Array2_double(1, rows, 1, columns)
    for (i, j), z in np.ndenumerate(points):
        poles.SetValue(i + 1, j + 1, gp_Pnt(z.real, z.imag, heights[j]))
        shares.SetValue(i + 1, j + 1, weights[i])
    vectors = []
    for values, counts in (np.unique(k, return_counts=True) for k in knots):
        places, multiplicities = Array1_double(1, len(values)), Array1_int(1, len(values))
        for i, (value, count) in enumerate(zip(values, counts, strict=True), start=1):
            places.SetValue(i, float(value))
            multiplicities.SetValue(i, int(count))
        vectors.append((places, multiplicities))
    (u, u_counts), (v, v_counts) = vectors
    surface = Geom_BSplineSurface(poles, shares, u, v, u_counts, v_counts, *degrees)
    return Face(BRepBuilderAPI_MakeFace(surface, 1e-7).Face())
