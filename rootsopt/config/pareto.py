"""Config section of `rootsopt pareto`: terms of a trade-off, and effort spent on its front."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from rootsopt.config.section import Listed, Section, require, such
from rootsopt.config.units import shown


class ParetoConfig(Section):
    """The terms that `rootsopt pareto` trades against each other, and the number of points."""

    terms: Annotated[
        tuple[str, ...],
        Listed,
        such(
            "two or three different terms, as [peak_force_N, area_efficiency]",
            lambda terms: len(set(terms)) == len(terms) in (2, 3),
        ),
    ] = Field(
        ("peak_force_N", "area_efficiency"),
        description="two or three quantities: forces and lines as in `response`, geometry as in "
        "`geometry`, displaced_volume_cm3, theoretical_flow_l_min, flow_ripple, "
        "gear_backlash_max_mm, angular_play_min_mrad, leakage_fraction, delivered_flow_l_min, "
        "flank_gap_min_um, flank_gap_mean_um, bearing_load_equivalent_N, bearing_load_max_N, "
        "axial_force_max_N, tilting_moment_max_N_m, static_bearing_load_equivalent_N, "
        "static_bearing_load_max_N, or registered terms",
    )
    senses: dict[str, Literal["min", "max"]] = Field(
        default_factory=dict,
        description="sense of a term, as {seal_width_mm: min}, where it should differ from the "
        "term's own: max for area_efficiency, displaced_volume_cm3, theoretical_flow_l_min, "
        "delivered_flow_l_min, gear_backlash_max_mm, flank_gap_min_um, flank_gap_mean_um, "
        "seal_width_mm, root_radius_mm and undercut_margin_mm, min for all others",
    )
    points: Annotated[int, Field(ge=3, le=101)] = Field(
        11, description="points along the front of two terms, its ends included"
    )
    divisions: Annotated[int, Field(ge=2, le=20)] = Field(
        5,
        description="steps between two ends of three terms: n steps give (n + 1) (n + 2) / 2 "
        "points",
    )
    refinements: Annotated[int, Field(ge=0, le=100)] = Field(
        12, description="greatest number of further points where neighbours lie far apart"
    )

    @model_validator(mode="after")
    def _own(self):
        for name in self.senses:
            require(
                name in self.terms,
                f"`pareto.senses` must name terms of `pareto.terms` ({', '.join(self.terms)}), "
                f"but names {shown(name)}; add the term, or remove its sense",
            )
        return self
