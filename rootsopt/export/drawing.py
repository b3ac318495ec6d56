"""Content of the drawing of one rotor, shared by all formats (mm)."""

import dataclasses

from rootsopt.config import Config
from rootsopt.export.pieces import DrawnPiece, outline_pieces
from rootsopt.profiles import Geometry, Profile, geometry
from rootsopt.runtime.programs import Program

_MM = 1e3
_shape = Program(geometry)


@dataclasses.dataclass(frozen=True)
class Drawing:
    """Everything that a drawing shows of one rotor.

    `pieces`: closed outline (mm); `pitch_radius`, `outer_radius`: radii (mm); `lobes`: number of
    lobes; `length`: axial length (mm); `helix_deg`: twist over the length (°); `bore`: bore
    diameter (mm), `None` for a rotor without a bore; `notes`: lines of text with the dimensions.
    """

    pieces: list[DrawnPiece]
    pitch_radius: float
    outer_radius: float
    lobes: int
    length: float
    helix_deg: float
    bore: float | None
    notes: tuple[str, ...]

    @classmethod
    def of(cls, config: Config, profile: Profile, design: dict[str, float]) -> "Drawing":
        """Return the drawing of a rotor with this `profile` and the dimensions in `config`.

        `design`: values of the design parameters (config units), keyed by config key, for the
        notes."""
        shape: Geometry = _shape(profile)
        outer, root = float(shape.outer_radius) * _MM, float(shape.root_radius) * _MM
        rotor, radius = config.rotor, config.profile.pitch_radius_mm
        body = f"length {rotor.length_mm:g} mm"
        if rotor.bore_mm is not None:
            body += f", bore {rotor.bore_mm:g} mm"
        if rotor.helix_deg != 0:
            body += f", twist {rotor.helix_deg:g} deg over the length (rotor 2: the other way)"
        notes = [
            f"Roots rotor, family {config.profile.family}, {config.profile.lobes} lobes",
            ", ".join(f"{key} = {value:.8g}" for key, value in design.items()),
            f"centre distance {2 * radius:g} mm, pitch radius {radius:g} mm",
            f"outer radius {outer:.6f} mm, root radius {root:.6f} mm, "
            f"area {float(shape.area) * _MM**2:.6f} mm2",
            body,
            f"dimensions in mm, flank clearance {config.contact.clearance_mm:g} mm not subtracted",
        ]
        return cls(
            pieces=outline_pieces(profile),
            pitch_radius=radius,
            outer_radius=outer,
            lobes=config.profile.lobes,
            length=rotor.length_mm,
            helix_deg=rotor.helix_deg,
            bore=rotor.bore_mm,
            notes=tuple(note for note in notes if note),
        )

    @property
    def reach(self) -> float:
        """Distance (mm) from the rotor's axis to the ends of the centre lines."""
        return 1.08 * self.outer_radius
