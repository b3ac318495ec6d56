"""The pump sheet: one table of a design's flow, play, leakage and bearing loads."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.config.reading import Config
from rootsopt.config.units import DEG, MM, UM
from rootsopt.errors import InputError
from rootsopt.profiles import Profile, geometry
from rootsopt.pump import flow
from rootsopt.pump.flow import CM3, L_MIN, MRAD, ripple_of
from rootsopt.pump.gap import play
from rootsopt.pump.loads import static_loads
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene
from rootsopt.scene.check import profile_of
from rootsopt.scene.reading import Medium, design_vector

# Overlap (m) of the flanks below which it counts as rounding of an outline.
_ROUNDING = 1e-8
# Number of lines of the flow in the sheet.
_LINES = 4
# Knudsen number above which gas slips at the walls, so that it leaks more than the laminar formula
# states.
_CONTINUUM = 0.01
# Knudsen number above which molecules meet the walls more often than each other. The formulas of
# the leakage do not hold there.
_MOLECULAR = 1.0
NOTE = (
    "The flow ripple is (r_a - r_p)^2 / (eta r_a^2): with the outer radius r_a and the area "
    "efficiency eta given, no other shape of the flank changes it; a twist lowers it."
)
"""Sentence for the user: what determines the ripple."""


def sheet(scene: Scene, design: Float[Array, " d"]) -> dict[str, Any]:
    """Return the pump sheet of a `design` (d,) in config units, as in the result file.

    Every key ends with its unit; quantities without a unit are fractions. `flow_lines`: amplitudes
    of the flow's lines as fractions of the mean flow; the k-th has 2Nk periods per revolution.
    `tip_height_of_limit`: tip height over the pitch circle as a fraction of its limit.

    With a clearance, a centre distance error or a measured outline, there is also the play.
    `angular_play_…_mrad`: least and greatest play of rotor 2 over the rotation.
    `gear_backlash_max_mm`: greatest backlash of a timing gear that keeps the flanks apart, negative
    where they overlap. `flank_interference_…`: greatest overlap in perfect rolling (µm), and angle
    of rotor 1 there, from a tip on the line of centres (°); absent without overlap.

    With a section `scene.bearings`, there are the greatest load of a bearing and the greatest
    equivalent load. For both, the timing gear carries the load instead of the flanks, and nothing
    oscillates.

    With a section `pump`, the leakage follows: least and mean gap of the flanks over the mesh (µm),
    leakage through mesh, tips and end faces, and volumetric efficiency. For a gas, there is also
    the Knudsen number. Raises `InputError` if the rotors overlap somewhere."""
    rows = {key: value.tolist() for key, value in _flow(scene, design).items()}
    if scene.bearings is not None:
        equivalent, greatest = static_loads(scene, design)
        rows["static_bearing_load_max_N"] = float(jnp.max(greatest))
        rows["static_bearing_load_equivalent_N"] = float(jnp.max(equivalent))
    if _has_play(scene):
        # The program takes no scene, so that scenes with other parts share it.
        free = _play(profile_of(scene, design), flow.clearances_of(scene))
        rows |= {key: value.tolist() for key, value in free.items()}
        if rows["flank_interference_um"] * UM <= _ROUNDING:
            del rows["flank_interference_um"], rows["flank_interference_at_deg"]
    if scene.medium is not None:
        rows |= _leaking(scene, scene.medium, design)
    return {key: rows[key] for key in KEYS if key in rows}


def warnings(rows: Mapping[str, Any]) -> list[str]:
    """Return caveats on the values of a sheet, as sentences.

    `rows`: the sheet."""
    caveats = []
    if "flank_interference_um" in rows:
        overlap = rows["flank_interference_um"]
        caveats.append(
            f"The flanks overlap by {overlap:.3g} um in perfect rolling, most with rotor 1 at "
            f"{rows['flank_interference_at_deg']:.3g} deg: raise `contact.clearance_mm` by "
            f"{overlap / 1e3:.2g} to separate them, unless this is the scatter of measured points."
        )
    if rows.get("volumetric_efficiency", 1.0) <= 0:
        caveats.append(
            "More fluid leaks back than the rotors displace: the pump delivers nothing. Reduce the "
            "clearances or `pump.pressure_difference_Pa`, or raise `scene.speed_rpm`."
        )
    knudsen = rows.get("knudsen_number", 0.0)
    if knudsen > _MOLECULAR:
        caveats.append(
            f"The flow through the gaps is molecular (Knudsen number {knudsen:.2g} > 1): the "
            "leakage and the volumetric efficiency above do not hold."
        )
    elif knudsen > _CONTINUUM:
        caveats.append(
            f"Gas slips at the walls of the gaps (Knudsen number {knudsen:.2g} > 0.01): more leaks "
            "than reported."
        )
    return caveats


def missing(rows: Mapping[str, Any]) -> str:
    """Return a sentence on which keys add further rows to a sheet, "" if it is complete.

    `rows`: the sheet."""
    absent = []
    if "gear_backlash_max_mm" not in rows:
        absent.append("play (`contact.clearance_mm`)")
    if "volumetric_efficiency" not in rows:
        absent.append("leakage (section `pump`)")
    else:
        absent += [
            f"{place} leakage (`pump.{place}_clearance_mm`)"
            for place in ("tip", "end")
            if f"{place}_leakage_l_min" not in rows
        ]
    if "static_bearing_load_max_N" not in rows:
        absent.append("bearing loads (section `scene.bearings`)")
    return f"Not in this sheet, for lack of input: {', '.join(absent)}." if absent else ""


def check_clearances(config: Config) -> None:
    """Raise `InputError` if a config has a section `pump` and its flanks overlap."""
    scene = Scene.from_config(config)
    if scene.medium is not None:
        _leaking(scene, scene.medium, design_vector(config))


def record_of(config: Config, design: Sequence[float]) -> dict[str, Any]:
    """Return the pump sheet of a `design` in config units, without leakage if the flanks overlap.

    Use it at the end of a search: it raises no error, so the results are still written."""
    scene, values = Scene.from_config(config), jnp.asarray(design, float)
    try:
        return sheet(scene, values)
    except InputError:
        return sheet(dataclasses.replace(scene, medium=None), values)


KEYS = (
    "displaced_volume_cm3",
    "theoretical_flow_l_min",
    "flow_ripple",
    "flow_lines",
    "tip_height_of_limit",
    "angular_play_min_mrad",
    "angular_play_max_mrad",
    "gear_backlash_max_mm",
    "flank_interference_um",
    "flank_interference_at_deg",
    "static_bearing_load_max_N",
    "static_bearing_load_equivalent_N",
    "flank_gap_min_um",
    "flank_gap_mean_um",
    "mesh_leakage_l_min",
    "tip_leakage_l_min",
    "end_leakage_l_min",
    "volumetric_efficiency",
    "knudsen_number",
)
"""Keys of the sheet, in the order of its rows."""


@CachedFunction
def _flow(scene: Scene, design: Float[Array, " d"]) -> dict[str, Array]:
    scene, profile = scene.at(design), scene.profile(design)
    shape = geometry(profile)
    lines = flow.flow_lines(profile, shape, _LINES)
    if scene.helix is not None:
        lines = flow.twisted_lines(lines, scene.lobes, scene.helix)
    return {
        "displaced_volume_cm3": flow.displaced_volume(shape, scene.length) / CM3,
        "theoretical_flow_l_min": flow.theoretical_flow(shape, scene.length, scene.speed) / L_MIN,
        "flow_ripple": ripple_of(scene, profile, shape),
        "flow_lines": jnp.abs(lines),
        "tip_height_of_limit": flow.tip_height_share(profile, shape),
    }


def _has_play(scene: Scene) -> bool:
    """Return whether rotor 2 has play between its flanks, or the rotors may overlap."""
    odd = scene.outline is not None or scene.center_distance_error is not None
    shrunk = scene.medium is not None and float(scene.medium.radial_allowance) != 0
    return odd or shrunk or float(scene.clearance) > 0


@CachedFunction
def _play(profile: Profile, clearances: dict[str, Array]) -> dict[str, Array]:
    free = play(profile, **clearances)
    return {
        "angular_play_min_mrad": jnp.min(free.total) / MRAD,
        "angular_play_max_mrad": jnp.max(free.total) / MRAD,
        "gear_backlash_max_mm": free.gear_backlash / MM,
        "flank_interference_um": free.overlap / UM,
        "flank_interference_at_deg": free.overlap_at / DEG,
    }


def _leaking(scene: Scene, medium: Medium, design: Float[Array, " d"]) -> dict[str, Any]:
    """Return the rows of leakage. Raises `InputError` as `sheet` does."""
    rows = _leaks(scene, medium, design)
    least = float(rows["flank_gap_min_um"]) * UM
    if least < -_ROUNDING:
        raise InputError(
            f"the flanks must not overlap in perfect rolling, but overlap by {-least / UM:.3g} um; "
            "raise `contact.clearance_mm`, `scene.center_distance_error_mm` or "
            "`pump.radial_allowance_mm` by more than that"
            + ("" if medium.strain is None else ", or warm the rotors less (`scene.heat`)")
        )
    absent = {
        "tip_leakage_l_min": medium.tip_clearance is None,
        "end_leakage_l_min": medium.end_clearance is None,
        "knudsen_number": not float(rows["knudsen_number"]) > 0,
    }
    return {key: value.tolist() for key, value in rows.items() if not absent.get(key)}


@CachedFunction
def _leaks(scene: Scene, medium: Medium, design: Float[Array, " d"]) -> dict[str, Array]:
    """Return the rows of leakage, also of rotors that overlap."""
    profile = scene.profile(design)
    leakage = flow.leakage(scene, medium, profile, geometry(profile))
    return {
        "flank_gap_min_um": jnp.min(leakage.gap.least) / UM,
        "flank_gap_mean_um": jnp.mean(leakage.gap.least) / UM,
        "mesh_leakage_l_min": leakage.mesh / L_MIN,
        "tip_leakage_l_min": leakage.tips / L_MIN,
        "end_leakage_l_min": leakage.ends / L_MIN,
        "volumetric_efficiency": leakage.efficiency,
        "knudsen_number": leakage.knudsen,
    }
