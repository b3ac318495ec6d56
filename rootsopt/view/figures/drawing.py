"""Content of the drawing of one rotor (mm), coordinates of a lobe, and the drawing as SVG."""

import dataclasses
import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root_scalar

import rootsopt
from rootsopt.config.reading import Config
from rootsopt.config.rotor import DrawingConfig
from rootsopt.errors import InputError
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.runtime.environment import say
from rootsopt.runtime.programs import CachedFunction
from rootsopt.view.figures.pieces import Arc, DrawnPiece, outline_pieces

# Distance along the outline (fraction of the outline's length) below which two points count as
# one.
_SAME = 1e-9

# Number of points of a piece between which crossings are sought.
_SAMPLES = 65


class Coordinates(NamedTuple):
    """Points on one lobe, from the root before it to the root behind it, counter-clockwise.

    `point` (n,): x + iy (mm), with the lobe's tip on +x; `normal` (n,): outward unit normals, at a
    corner that of the following piece; `along` (n,): distance along the outline from the tip (mm).
    """

    point: NDArray[np.complex128]
    normal: NDArray[np.complex128]
    along: NDArray[np.float64]

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Return the columns of `rotor_points.csv`, each (n,)."""
        return {
            "x_mm": self.point.real,
            "y_mm": self.point.imag,
            "radius_mm": np.abs(self.point),
            "angle_deg": np.degrees(np.angle(self.point)),
            "normal_deg": np.degrees(np.angle(self.normal)),
            "along_mm": self.along,
        }


def coordinates(pieces: Sequence[DrawnPiece], lobes: int, count: int) -> Coordinates:
    """Return points on the lobe on +x: `count` of them, evenly spaced, and all ends of pieces.

    `pieces`: closed outline, as from `outline_pieces`; `lobes`: number of lobes."""
    ends = np.concatenate([[0.0], np.cumsum([piece.length for piece in pieces])])
    number, share = _at_angle(pieces, 0.0)
    total, tip = ends[-1], ends[number] + share * pieces[number].length
    half = total / (2 * lobes)
    along = np.linspace(-half, half, count)
    corners = (ends[:-1] - tip + total / 2) % total - total / 2
    corners = corners[np.abs(corners) < half * (1 - _SAME)]
    along = np.sort(np.concatenate([along, corners]))
    along = along[np.concatenate([[True], np.diff(along) > _SAME * total])]
    place = (along + tip) % total
    # A point at the end of a piece belongs to the piece behind it.
    number = np.searchsorted(ends[1:] - _SAME * total, place, side="right") % len(pieces)
    place = np.where(place >= total * (1 - _SAME), 0.0, place)
    point, normal = np.empty(len(along), complex), np.empty(len(along), complex)
    for k, piece in enumerate(pieces):
        mine = number == k
        share = np.clip((place[mine] - ends[k]) / piece.length, 0.0, 1.0)
        point[mine], normal[mine] = piece.at(share), -1j * piece.heading(share)
    return Coordinates(point, normal, along)


def widest(pieces: Sequence[DrawnPiece], lobes: int) -> complex:
    """Return the point (mm) on the upper flank of the lobe on +x at which the lobe is widest.

    Its width is twice the point's y coordinate. If the lobe widens all the way down to the root,
    return the point on the pitch circle, at the angle π / (2 `lobes`)."""
    maxima = [
        complex(piece.at(share))
        for piece in pieces
        for share in _falls(lambda x, piece=piece: np.imag(piece.heading(x)))
    ]
    inside = [point for point in maxima if 0 < np.angle(point) < np.pi / lobes - _SAME]
    if inside:
        return max(inside, key=lambda point: point.real)
    number, share = _at_angle(pieces, np.pi / (2 * lobes))
    return complex(pieces[number].at(share))


def _at_angle(pieces: Sequence[DrawnPiece], angle: float) -> tuple[int, float]:
    """Return number and share of the piece at which the outline crosses a polar angle (rad).

    The outline is closed around the origin, so that there is such a piece."""
    turn = np.exp(-1j * angle)
    return next(
        (number, share)
        for number, piece in enumerate(pieces)
        for share in _falls(lambda x, piece=piece: -np.imag(piece.at(x) * turn))
        if np.real(piece.at(share) * turn) > 0
    )


def _falls(function: Callable[[Any], Any]) -> Iterator[float]:
    """Yield the shares (0 to 1) at which a `function` of them falls below 0."""
    share = np.linspace(0.0, 1.0, _SAMPLES)
    value = function(share)
    for k in np.flatnonzero((value[:-1] >= 0) & (value[1:] < 0)):
        bracket = share[k], share[k + 1]
        yield root_scalar(lambda x: float(function(x)), bracket=bracket, xtol=1e-15).root


_MM = 1e3

# Length (characters) above which a line of design parameters is broken.
_LINE = 72
_shape = CachedFunction(geometry)


@dataclasses.dataclass(frozen=True)
class Drawing:
    """Everything that a drawing shows of one rotor.

    `pieces`: closed outline (mm); `pitch_radius`, `outer_radius`: radii (mm); `lobes`: number of
    lobes; `length`: axial length (mm); `helix_deg`: twist over the length (°); `bore`: bore
    diameter (mm), `None` for a rotor without a bore; `notes`: lines of text with the dimensions.
    `root_radius`: radius (mm); `block`: (heading, text) of each field of the title block.
    """

    pieces: list[DrawnPiece]
    pitch_radius: float
    outer_radius: float
    lobes: int
    length: float
    helix_deg: float
    bore: float | None
    notes: tuple[str, ...]
    root_radius: float
    block: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, config: Config, profile: Profile, design: dict[str, float]) -> "Drawing":
        """Return the drawing of a rotor with this `profile` and the dimensions in `config`.

        `design`: values of the design parameters (config units), keyed by config key, for the
        notes."""
        shape: Geometry = _shape(profile)
        inset = (config.drawing or DrawingConfig.model_validate({})).inset_mm
        rotor, radius = config.rotor, config.profile.pitch_radius_mm
        try:
            pieces = outline_pieces(profile, inset)
        except InputError as error:
            if not inset:
                raise
            say(f"the rotor is drawn without its inset of {inset:g} mm: {error}")
            pieces, inset = outline_pieces(profile), 0.0
        outer, root = (float(x) * _MM - inset for x in (shape.outer_radius, shape.root_radius))
        # Steiner's formula for parallel curves.
        lost = inset * sum(piece.length for piece in pieces) + math.pi * inset**2
        body = f"length {rotor.length_mm:g} mm"
        if rotor.bore_mm is not None:
            body += f", bore {rotor.bore_mm:g} mm"
        if rotor.helix_deg != 0:
            body += f", twist {rotor.helix_deg:g} deg over the length (rotor 2: the other way)"
        notes = [
            f"Roots rotor, family {config.profile.family}, {config.profile.lobes} lobes",
            *_wrapped([f"{key} = {value:.8g}" for key, value in design.items()]),
            f"centre distance {2 * radius:g} mm, pitch radius {radius:g} mm",
            f"outer radius {outer:.6f} mm, root radius {root:.6f} mm, "
            f"area {float(shape.area) * _MM**2 - lost:.6f} mm2",
            body,
            f"dimensions in mm, flank clearance {config.contact.clearance_mm:g} mm "
            + (f"cut off by an inset of {inset:g} mm" if inset else "not subtracted"),
        ]
        return cls(
            pieces=pieces,
            pitch_radius=radius,
            outer_radius=outer,
            lobes=config.profile.lobes,
            length=rotor.length_mm,
            helix_deg=rotor.helix_deg,
            bore=rotor.bore_mm,
            notes=tuple(notes),
            root_radius=root,
            block=_block(config),
        )

    @property
    def reach(self) -> float:
        """Distance (mm) from the rotor's axis to the ends of the centre lines, beyond the outer
        circle."""
        return 1.08 * self.outer_radius


def _wrapped(words: list[str]) -> list[str]:
    """Return lines with all `words`, separated by commas, of at most `_LINE` characters."""
    text = ", ".join(word.replace(" ", "\N{NO-BREAK SPACE}") for word in words)
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in textwrap.wrap(text, _LINE)]


def _block(config: Config) -> tuple[tuple[str, str], ...]:
    """Return (heading, text) of each field of the title block; a dash where nothing is stated."""
    stated, profile = config.drawing or DrawingConfig.model_validate({}), config.profile
    tolerance = stated.tolerance_mm
    texts = {
        "Title": "Roots rotor",
        "Drawing number": None,
        "Revision": None,
        "Material": f"density {config.rotor.density_kg_m3:g} kg/m3",
        "Flank, profile of a line": None if tolerance is None else f"{tolerance:g} mm (ISO 1101)",
        "General tolerances": None,
        "Rotor": f"{profile.family}, {profile.lobes} lobes, length {config.rotor.length_mm:g} mm",
        "Centre distance": f"{2 * profile.pitch_radius_mm:g} mm",
        "Designed for": _scene(config),
        "Drawn by": None,
        "Date": None,
        "Scale, unit": "1:1, mm",
        "Program": f"rootsopt {rootsopt.__version__}",
    } | stated.title_block
    return tuple((name, text or "-") for name, text in texts.items())


def _scene(config: Config) -> str:
    """Return a few words on the scene for which the rotor was designed."""
    scene, torque = config.scene, config.scene.load.torque_N_m
    load = f"{scene.load.pressure_difference_Pa:g} Pa" if torque is None else f"{torque:g} N m"
    words = [f"{scene.speed_rpm:g} rpm", load]
    if scene.timing_gear is not None:
        words.append(f"backlash {scene.timing_gear.backlash_mm:g} mm")
    words.append(f"clearance {config.contact.clearance_mm:g} mm")
    return ", ".join(words)


# Style sheet of the drawing. Line widths and dash lengths are in mm.
_STYLE = (
    ".outline{fill:#dbe9f4;fill-rule:evenodd;stroke:#000;stroke-width:.5}"
    ".pitch{fill:none;stroke:#0072b2;stroke-width:.25;stroke-dasharray:6 1.5 .5 1.5}"
    ".center{fill:none;stroke:#808080;stroke-width:.25;stroke-dasharray:9 1.5 2 1.5}"
)


def svg_text(drawing: Drawing) -> str:
    """Return the content of an SVG file of a `drawing` of one rotor.

    One user unit is 1 mm. The rotor's y axis points up on the page."""
    reach = drawing.reach + 1
    size, corner, end = map(_number, (2 * reach, -reach, drawing.reach))
    path = f"M{_point(drawing.pieces[0].start)}{''.join(map(_command, drawing.pieces))}Z"
    if drawing.bore is not None:
        r = _number(drawing.bore / 2)
        path += f"M{r} 0A{r} {r} 0 1 0 -{r} 0A{r} {r} 0 1 0 {r} 0Z"
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


def _command(piece: DrawnPiece) -> str:
    """Return the SVG path data from the start of a piece to its end; splines are Bézier curves."""
    if not isinstance(piece, Arc):
        return "".join("C" + " ".join(map(_point, curve[1:])) for curve in piece.beziers())
    radius, large = _number(piece.radius), int(abs(piece.sweep) > math.pi)
    # In SVG y points down, so a sweep flag of 1 looks clockwise.
    return f"A{radius} {radius} 0 {large} {int(piece.sweep < 0)} {_point(piece.stop)}"


def _point(z: complex) -> str:
    return f"{_number(z.real)} {_number(-z.imag)}"


def _number(value: float) -> str:
    """Format a number with at most ten decimal places, without trailing zeros."""
    return f"{value + 0.0:.10f}".rstrip("0").rstrip(".")
