"""Content of the drawing of one rotor, shared by all formats (mm)."""

import dataclasses
import math
import textwrap

import rootsopt
from rootsopt.config import Config
from rootsopt.config.rotor import DrawingConfig
from rootsopt.errors import InputError
from rootsopt.export.pieces import DrawnPiece, outline_pieces
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.runtime.environment import say
from rootsopt.runtime.programs import CachedFunction

_MM = 1e3
_LINE = 72
"""Length (characters) above which a line of design parameters is broken."""
_shape = CachedFunction(geometry)


@dataclasses.dataclass(frozen=True)
class Drawing:
    """Everything that a drawing shows of one rotor.

    `pieces`: closed outline (mm); `pitch_radius`, `outer_radius`: radii (mm); `lobes`: number of
    lobes; `length`: axial length (mm); `helix_deg`: twist over the length (°); `bore`: bore
    diameter (mm), `None` for a rotor without a bore; `notes`: lines of text with the dimensions.
    `root_radius`: radius (mm); `block`: (heading, text) of each field of the title block; `points`:
    number of points over a lobe in the table of coordinates.
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
    points: int

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
            notes=tuple(note for note in notes if note),
            root_radius=root,
            block=_block(config),
            points=(config.drawing or DrawingConfig.model_validate({})).points,
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
        "Title": stated.title,
        "Drawing number": stated.number,
        "Revision": stated.revision,
        "Material": stated.material or f"density {config.rotor.density_kg_m3:g} kg/m3",
        "Flank, profile of a line": None if tolerance is None else f"{tolerance:g} mm (ISO 1101)",
        "General tolerances": stated.general_tolerance,
        "Rotor": f"{profile.family}, {profile.lobes} lobes, length {config.rotor.length_mm:g} mm",
        "Centre distance": f"{2 * profile.pitch_radius_mm:g} mm",
        "Designed for": _scene(config),
        "Drawn by": stated.drawn_by,
        "Date": stated.date,
        "Scale, unit": "1:1, mm",
        "Program": f"rootsopt {rootsopt.__version__}",
    }
    return tuple((name, text or "-") for name, text in texts.items())


def _scene(config: Config) -> str:
    """Return a few words on the scene for which the rotor was designed."""
    scene, load = config.scene, config.scene.load
    words = [f"{scene.speed_rpm:g} rpm"]
    if load.torque_N_m is not None:
        words.append(f"{load.torque_N_m:g} N m")
    else:
        words.append(f"{load.pressure_difference_Pa:g} Pa")
    if scene.timing_gear is not None:
        words.append(f"backlash {scene.timing_gear.backlash_mm:g} mm")
    words.append(f"clearance {config.contact.clearance_mm:g} mm")
    return ", ".join(words)
