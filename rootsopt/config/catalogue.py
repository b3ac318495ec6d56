"""Registers the built-in profile families in the same way as any other family."""

import dataclasses
import math
from typing import TYPE_CHECKING

from rootsopt.config.families import Family, Pair, Parameter, register_family
from rootsopt.errors import InputError

if TYPE_CHECKING:
    from rootsopt.config.rotor import ProfileConfig

# Length (mm) in a profile above which a config is rejected, whatever the pitch radius.
_LONGEST = 5e4

# Range (pitch radii) outside which a length in a profile is rejected.
_SHARES = 0.002, 10.0

# Range (pitch radii) that replaces `_SHARES` where the key or the family sets the lower limit.
_NO_FLOOR = 0.0, 10.0


@dataclasses.dataclass(frozen=True)
class _LandAngle(Parameter):
    """Half angle of a tip land, the circular arc about the rotor axis at the tip of a lobe.

    Its bounds must stay below a quarter of the lobe pitch."""

    def usually(self, pitch_radius_mm: float, lobes: int) -> Pair:
        return 0.0, 45.0 / lobes

    def check_bounds(self, bounds: Pair, lobes: int) -> None:
        half = 90.0 / lobes
        if bounds[1] >= half:
            raise InputError(
                f"`optimizer.bounds.{self.key}` must stay below {half:g} (a quarter of the lobe "
                f"pitch), but is {list(bounds)}"
            )


class _Dependent(Parameter):
    """Length without default bounds, because its range depends on the other parameters.

    A search takes the limits from the `ranges` of the family."""

    def bounds(self, profile: "ProfileConfig") -> Pair:
        return 0.0, math.inf


def _length(key: str, meaning: str, usual: Pair | None = None, radii: Pair = _SHARES) -> Parameter:
    least = 0.0 if key == "ellipse_center_mm" else 1e-3
    return Parameter(key, meaning, least, _LONGEST, radii=radii, usual=usual)


# Parameters that several families share.
PRESSURE_ANGLE = Parameter(
    "pressure_angle_deg",
    "pressure angle of the involute",
    *(1, 90),
    below=True,
    usual=(15.0, 60.0),
    default_bounds=(25.0, 45.0),
    bounds_limits=(1.0, 80.0),
)
INVOLUTE_LENGTH = _Dependent(
    "involute_length_mm",
    "involute parameter u",
    *(1e-9, 1e4),
    bounds_note="default: 10 % to 100 % of the longest involute",
    floor=0.1,
)
TIP_ARC_ANGLE = _LandAngle(
    "tip_arc_angle_deg",
    "half angle of the tip land",
    *(0, 45),
    below=True,
    default_bounds=(0.5, 8.0),
    bounds_limits=(0.0, 44.0),
)
ARC_CENTER = _length("arc_center_mm", "distance of the arc's centre from the axis", (0.5, 0.999))
TIP_ARC_RADIUS = _length("tip_arc_radius_mm", "radius of the tip arc", (0.05, 0.8))
TIP_ARC_TURN = Parameter(
    "tip_arc_turn_deg", "normal angle where the tip arc ends", 1, 180, below=True, usual=(1.0, 90.0)
)

# Margins that are negative with the longest involutes that `limits` tolerates.
_OVERLONG = frozenset({"rolling", "order"})
_OWN = (
    Family(
        name="cic",
        help="tip land, tip arc and involute: the rotor of the source paper",
        maker="rootsopt.profiles.cic:CIC",
        parameters=(PRESSURE_ANGLE, INVOLUTE_LENGTH, TIP_ARC_ANGLE),
        example={"pressure_angle_deg": 36.43, "involute_length_mm": 8.0, "tip_arc_angle_deg": 4.0},
        inherent=_OVERLONG,
        limits="rootsopt.profiles.cic:check",
        by_limits=True,
        ranges="rootsopt.profiles.cic:ranges",
    ),
    Family(
        name="ee",
        help="epicycloid on hypocycloid, without design parameters",
        maker="rootsopt.profiles.epicycloid:EE",
    ),
    Family(
        name="arc",
        help="one circular arc through both pitch crossings",
        maker="rootsopt.profiles.arcs:arc",
        parameters=(ARC_CENTER,),
        example={"arc_center_mm": 29.7},
        remedy="move the centre: it must lie inside the pitch circle, and undercut starts if it "
        "is too far out",
    ),
    Family(
        name="arcs_epicycloid",
        help="a single arc cut off by a tip land, with a rounded edge between them",
        maker="rootsopt.profiles.arcs:arcs_epicycloid",
        parameters=(
            ARC_CENTER,
            TIP_ARC_ANGLE,
            # The family sets its own floor for the edge radius.
            _length(
                "edge_radius_mm", "radius of the edge between tip land and arc", radii=_NO_FLOOR
            ),
        ),
        example={"arc_center_mm": 27.0, "tip_arc_angle_deg": 8.0, "edge_radius_mm": 1.0},
        remedy="widen the land, move the arc's centre inwards, or round the edge more (its radius "
        "must be smaller than the arc's)",
        # An edge outside the pitch circle meshes twice.
        inherent=frozenset({"rolling"}),
        limits="rootsopt.profiles.arcs:check",
    ),
    Family(
        name="arc_involute",
        help="tip arc and involute, without a land",
        maker="rootsopt.profiles.cic:arc_involute",
        parameters=(PRESSURE_ANGLE, INVOLUTE_LENGTH),
        example={"pressure_angle_deg": 36.0, "involute_length_mm": 6.0},
        inherent=_OVERLONG,
        limits="rootsopt.profiles.cic:check",
        by_limits=True,
        ranges="rootsopt.profiles.cic:ranges",
    ),
    Family(
        name="four_arcs",
        help="tip arc and flank arc, tangent to each other",
        maker="rootsopt.profiles.arcs:four_arcs",
        parameters=(ARC_CENTER, TIP_ARC_RADIUS, TIP_ARC_TURN),
        example={"arc_center_mm": 30.0, "tip_arc_radius_mm": 13.0, "tip_arc_turn_deg": 40.0},
        remedy="move the tip arc's centre inwards, or change where it ends or its radius",
    ),
    Family(
        name="five_arcs",
        help="tip land, tip arc and flank arc, tangent to each other",
        maker="rootsopt.profiles.arcs:five_arcs",
        parameters=(
            _length("outer_radius_mm", "radius of the tip land", (1.1, 1.7)),
            TIP_ARC_ANGLE,
            TIP_ARC_RADIUS,
            TIP_ARC_TURN,
        ),
        example={
            "outer_radius_mm": 45.0,
            "tip_arc_angle_deg": 3.0,
            "tip_arc_radius_mm": 13.0,
            "tip_arc_turn_deg": 60.0,
        },
        remedy="lower the outer radius, or change the tip arc's radius or where it ends",
    ),
    Family(
        name="circle_epicycloid",
        help="epicycloid with a circular tip",
        maker="rootsopt.profiles.epicycloid:circle_epicycloid",
        parameters=(
            _length("rolling_radius_mm", "radius of the rolling circle"),
            TIP_ARC_TURN,
        ),
        example={"rolling_radius_mm": 7.0, "tip_arc_turn_deg": 30.0},
        remedy="let the tip arc end further from the tip, or change the rolling radius",
    ),
    Family(
        name="hypo_epicycloid",
        help="complete half arches of hypocycloid and epicycloid, with a land at tip and root",
        maker="rootsopt.profiles.epicycloid:hypo_epicycloid",
        parameters=(TIP_ARC_ANGLE,),
        example={"tip_arc_angle_deg": 4.0},
        remedy="make the tip arc angle less than 90° / lobes",
    ),
    Family(
        name="extended_cycloid",
        help="epicycloid with a trochoid ratio that varies from tip to pitch crossing",
        maker="rootsopt.profiles.curve:extended_cycloid",
        parameters=(
            Parameter(
                "trochoid_ratio",
                "distance of the tracing point from the rolling circle's centre at the tip, in "
                "radii of that circle",
                *(1e-3, 10),
            ),
        ),
        example={"trochoid_ratio": 1.3},
        remedy="bring the trochoid ratio closer to 1",
    ),
    Family(
        name="ellipse",
        help="an arc of an ellipse through both pitch crossings",
        maker="rootsopt.profiles.curve:ellipse",
        parameters=(
            _length(
                "ellipse_center_mm",
                "distance of the ellipse's centre from the axis",
                (0.0, 0.99),
                _NO_FLOOR,
            ),
            _length("ellipse_height_mm", "semi-axis along the lobe", (0.2, 1.5)),
        ),
        example={"ellipse_center_mm": 27.0, "ellipse_height_mm": 18.0},
        remedy="move the centre, or change the height",
    ),
    Family(
        name="free_form",
        help="tip land and a B-spline with any number of coefficients",
        maker="rootsopt.profiles.freeform:FreeForm",
        parameters=(
            TIP_ARC_ANGLE,
            Parameter(
                "coefficients",
                "decrease of the pressure angle per turn of the normal, from tip to pitch circle; "
                "3 to 64 numbers from -1 to 1 (0: involute, 1: arc about a pitch point)",
                *(-1, 1),
                usual=(-1.0, 1.0),
                count=(3, 64),
            ),
        ),
        example={"tip_arc_angle_deg": 4.0, "coefficients": (0.8, 0.7, 0.75)},
        remedy="change the coefficients, or start from `rootsopt profile --project`",
    ),
    Family(name="outline", help="drawn or measured outline, read from a file", maker=None),
)
for _family in _OWN:
    register_family(_family)
