"""Deviations of an imported outline from symmetry, from its axis and from its fitted curve."""

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Checks:
    """Deviations and margins of an imported outline.

    `points`: number of points of the outline as read, without repeated points.
    `turned_deg`: angle (°) by which the outline was turned to put a lobe's axis on +x.
    `reversed`: whether the points ran clockwise as read.
    `axis_offset_um`: distance (µm) of the outline's centroid from the rotor's axis.
    `scatter_um`: estimated standard deviation (µm) of the points across the outline,
    NaN if it cannot be told from shape.
    `interpolation_um`: error (µm) of a polynomial between the points; if the scatter is unknown,
    both together.
    `center_x_mm`, `center_y_mm`: estimated centre (mm) of the lobes' rotational symmetry, in the
    coordinates of the file. `center_error_um`: standard error (µm) of each coordinate.
    `lobe_deviation_um`: greatest normal distance between a flank and the mean of the same flank of
    all lobes (µm).
    `flank_deviation_um`: greatest normal distance between the mean leading flank and the mirrored
    mean trailing flank (µm).
    `fit_deviation_um`: RMS distance of the leading flank's points from the fitted curve (µm); 0 if
    the curve passes through them.
    `star_margin_mm`: least distance (mm) between a tangent of the flank and the rotor's axis,
    negative if a tangent passes the axis on the wrong side.
    `convexity_margin_mm`: least radius of curvature of the addendum (mm).
    `notes`: what the reader converted, chose or changed.
    """

    points: int
    turned_deg: float
    reversed: bool
    axis_offset_um: float
    scatter_um: float
    interpolation_um: float
    center_x_mm: float
    center_y_mm: float
    center_error_um: float
    lobe_deviation_um: float
    flank_deviation_um: float
    fit_deviation_um: float
    star_margin_mm: float
    convexity_margin_mm: float
    notes: tuple[str, ...] = ()

    def record(self) -> dict[str, Any]:
        """Return the fields as a dictionary, keyed by field name, for the result file."""
        return dataclasses.asdict(self)
