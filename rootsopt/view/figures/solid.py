"""Solids of one rotor and of the pair, as STEP (true arcs and B-splines) and STL (for printing).

This is the only module that uses the CAD kernel (build123d on Open CASCADE), an optional
dependency. Lengths are in millimetres, angles in radians.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# (The kernel is optional, and its bindings come without types.)

import dataclasses
import importlib.util
import io
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import make_interp_spline

from rootsopt.errors import InputError
from rootsopt.view.figures.pieces import Arc, DrawnPiece

if TYPE_CHECKING:
    from build123d import Compound, Edge, Face, Solid
    from build123d.topology import Shape

CHORD = 0.005
"""Maximum distance (mm) between a facet of an STL file and the solid."""
TURN = 0.05
"""Maximum angle (rad) between neighbouring facets of a curved face of an STL file."""

# Maximum twist (rad) between adjacent knots of a helical face. With this step, a cubic spline
# deviates from the rotation by 5e-8 of the radius.
_STEP = np.pi / 48

# Minimum number of knot spans of a face along the rotor's axis. A straight rotor would need only
# one span. However, most programs compute the volume by the kernel's Gauss quadrature, which uses
# more points with more spans. With one span, the computed volume has a relative error of 2e-4
# next to a cusp, although the solid itself is exact to 1e-8.
_SPANS = 8


def require_kernel() -> None:
    """Raise `InputError` if the CAD kernel is not installed."""
    if importlib.util.find_spec("build123d") is None:
        raise InputError(
            "`--export` step and stl need the CAD kernel build123d, which is not installed; "
            "run: pip install 'rootsopt[cad]'"
        )


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
    """Return the content of a binary STL file (mm) within `CHORD` and `TURN` of the shape.

    The kernel writes a temporary file in the folder `place`. `None`: the system's folder for
    temporary files. Raises `InputError` if the kernel fails to make triangles.
    """
    from build123d import export_stl

    with tempfile.TemporaryDirectory(dir=place) as folder:
        file = Path(folder) / "shape.stl"
        if not export_stl(shape, file, tolerance=CHORD, angular_tolerance=TURN):
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
    heights = np.array([rising.t[i + 1 : i + 4].mean() for i in range(len(rising.c))])
    return _surface(
        (degree, 3),
        (knots, rising.t),
        controls[:, None] * rising.c,
        np.broadcast_to(heights * length, (len(controls), len(heights))),
        np.broadcast_to(weights[:, None], (len(controls), len(heights))),
    )


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
    begins = (piece.begin + k * sweep for k in range(count))
    return [dataclasses.replace(piece, begin=begin, sweep=sweep) for begin in begins]


def _surface(degrees, knots, points, heights, weights) -> "Face":
    """Return a face on a rational B-spline surface (mm).

    `points`, `heights`, `weights` (n, m): x + iy, z and weight of each control point. `degrees`,
    `knots`: pairs of values, the first along the outline and the second along the axis."""
    from build123d import Face
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.collections import Array1_double, Array1_int, Array2_double, Array2_gp_Pnt
    from OCP.Geom import Geom_BSplineSurface
    from OCP.gp import gp_Pnt

    rows, columns = points.shape
    poles = Array2_gp_Pnt(1, rows, 1, columns)
    shares = Array2_double(1, rows, 1, columns)
    for i in range(rows):
        for j in range(columns):
            x, y, _ = _point(points[i, j])
            poles.SetValue(i + 1, j + 1, gp_Pnt(x, y, float(heights[i, j])))
            shares.SetValue(i + 1, j + 1, float(weights[i, j]))
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
