"""SVG drawing of one rotor for documents, in true size."""

from xml.sax.saxutils import escape

from rootsopt.export.drawing import Drawing
from rootsopt.export.pieces import Arc, DrawnPiece

_STYLE = (
    ".outline{fill:#dbe9f4;fill-rule:evenodd;stroke:#000;stroke-width:.5}"
    ".pitch{fill:none;stroke:#0072b2;stroke-width:.25;stroke-dasharray:6 1.5 .5 1.5}"
    ".center{fill:none;stroke:#808080;stroke-width:.25;stroke-dasharray:9 1.5 2 1.5}"
)
"""Style sheet of the drawing. Line widths and dash lengths are in mm."""


def svg_text(drawing: Drawing) -> str:
    """Return the content of an SVG file of a `drawing` of one rotor.

    One user unit is 1 mm. The rotor's y axis points up on the page."""
    reach = drawing.reach + 1
    size = _number(2 * reach)
    corner = _number(-reach)
    end = _number(drawing.reach)
    path = outline_path(drawing.pieces)
    if drawing.bore is not None:
        path += _circle_path(drawing.bore / 2)
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{size}mm" height="{size}mm" '
            f'viewBox="{corner} {corner} {size} {size}">',
            f"<title>{escape(drawing.notes[0])}</title>",
            f"<desc>{escape('; '.join(drawing.notes[1:]))}</desc>",
            f"<style>{_STYLE}</style>",
            f'<path class="outline" d="{path}"/>',
            f'<circle class="pitch" r="{_number(drawing.pitch_radius)}"/>',
            f'<path class="center" d="M-{end} 0H{end}M0 -{end}V{end}"/>',
            "</svg>",
            "",
        ]
    )


def outline_path(pieces: list[DrawnPiece]) -> str:
    """Return the closed outline `pieces` as SVG path data, with splines as Bézier curves."""
    return f"M{_point(pieces[0].start)}" + "".join(map(_command, pieces)) + "Z"


def _command(piece: DrawnPiece) -> str:
    if not isinstance(piece, Arc):
        rows = (" ".join(_point(z) for z in curve[1:]) for curve in piece.beziers())
        return "".join(f"C{row}" for row in rows)
    radius = _number(piece.radius)
    large = int(abs(piece.sweep) > 3.141592653589793)
    # In SVG y points down, so a sweep flag of 1 looks clockwise.
    return f"A{radius} {radius} 0 {large} {int(piece.sweep < 0)} {_point(piece.stop)}"


def _circle_path(radius: float) -> str:
    r = _number(radius)
    return f"M{r} 0A{r} {r} 0 1 0 -{r} 0A{r} {r} 0 1 0 {r} 0Z"


def _point(z: complex) -> str:
    return f"{_number(z.real)} {_number(-z.imag)}"


def _number(value: float) -> str:
    """Format a number with at most ten decimal places, without trailing zeros."""
    return f"{value + 0.0:.10f}".rstrip("0").rstrip(".")
