"""What an imported outline departs from: symmetry, axis, conjugacy."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Checks:
    """How an outline was found (lengths in µm unless said otherwise).

    `points` in the file; `turned_deg`: turn that put a lobe on +x; `reversed`: whether it ran
    clockwise; `axis_offset_um`: distance of its centroid from the origin; `lobe_deviation_um`:
    greatest normal distance of a flank from the same flank of the mean lobe; `flank_deviation_um`:
    of the mean trailing flank from the leading one, mirrored; `fit_deviation_um`: RMS distance of
    the leading flank's points from the curve through them (0: it goes through them);
    `star_margin_mm`: least distance of a tangent from the axis; `convexity_margin_mm`: least radius
    of curvature of the addendum.
    """

    points: int
    turned_deg: float
    reversed: bool
    axis_offset_um: float
    lobe_deviation_um: float
    flank_deviation_um: float
    fit_deviation_um: float
    star_margin_mm: float
    convexity_margin_mm: float

    def record(self) -> dict[str, float | int | bool]:
        """For the result file."""
        return dataclasses.asdict(self)
