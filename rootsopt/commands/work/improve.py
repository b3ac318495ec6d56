"""`rootsopt improve`: from the file of a rotor to a better one."""

import argparse
import sys
from typing import Any

import numpy as np

from rootsopt.commands import cli
from rootsopt.commands.work import optimize
from rootsopt.config.document import read_document
from rootsopt.config.families import FREE_FORM
from rootsopt.config.reading import Config, load
from rootsopt.errors import InputError
from rootsopt.measured.source import MeasuredRotor, read_rotor
from rootsopt.optimize.verification import survives, surviving
from rootsopt.pump.sheet import record_of
from rootsopt.runtime.environment import say
from rootsopt.scene.check import shape_of
from rootsopt.scene.families import classical
from rootsopt.scene.resemblance import Likeness, free_likeness, likeness
from rootsopt.scene.space import widened
from rootsopt.status import Status
from rootsopt.view import pages
from rootsopt.view.comparison import NOTHING_BETTER, WORTH, better_tables
from rootsopt.view.files import plain
from rootsopt.view.names import stated
from rootsopt.view.runs import RunFolder

# Terms of the objective by aim; `quieter` has the mean and the peak force instead.
_TERMS = {"tighter": "leakage_fraction", "smoother": "flow_ripple"}

# Values of `configs/cic_drawn.yaml` that follow the pitch radius, each with its power: the same
# tip speed and gas pressure.
_SCALED = {
    "rotor.length_mm": 1, "contact.stiffness_N_per_mm_e": 1, "contact.max_damping_N_s_per_mm": 1,
    "scene.speed_rpm": -1, "scene.load.torque_N_m": 3, "scene.timing_gear.stiffness_N_m_per_rad": 3,
    "scene.timing_gear.backlash_mm": 1,
}  # fmt: skip

# The assumed section `pump`, without its clearances.
_AIR = {"viscosity_mPa_s": 0.018, "pressure_difference_Pa": 2e4, "gas": {"inlet_pressure_Pa": 1e5}}

# Families that are compared first, because they are common or fitted quickly.
_COMMON = "ee", "arc", "cic"

# Distance (m) of a family's member at which no further families are compared, and above which the
# free form is compared, too. Three times the scatter of the points is added to both.
_EXACT, _FAR = 1e-6, 20e-6

# Number of parameters that the limits take from a family. Distance (pitch radii) from the outline
# above which a fitted profile is rejected. Clearance (pitch radii) that is assumed if none is
# given. Room (mm, cm³) that limits leave for rounding.
_HELD, _LOOSE, _GAP, _ROOM = 2, 0.01, 3e-3, 1e-6


def config_of(options: argparse.Namespace) -> Config:
    """Return the config of a search for a rotor better than that in the file `options.config`.

    Set `options.known` to what else is known of the rotor, as in the result file. Raises
    `InputError` if the file does not hold a rotor, or if an option does not suit it."""
    path, scene = options.config, options.scene
    given, rest = _given(options)
    base = load(scene or "cic_drawn", rest)
    if base.profile.from_file:
        given = base.profile.model_dump(exclude_none=True) | given
    rotor = read_rotor(path, given, _asked)
    one, radius = _fitted(rotor, path.name), rotor.radius
    size = {"lobes": rotor.lobes, "pitch_radius_mm": radius}
    profile = one.config(base.profile.model_copy(update=size))
    own = {text.partition("=")[0] for text in rest}
    assumed = {} if scene else _typical(base, radius, own)
    inset = round(one.inset * 1e3, 4)
    gap = round(max(0.0, base.contact.clearance_mm + 2 * inset), 6)
    values = {"profile": profile.model_dump(mode="json", exclude_none=True)} | assumed
    if len(one.design) <= _HELD and "optimizer.family" not in own:
        values["optimizer.family"] = FREE_FORM
    values |= {"contact.clearance_mm": gap, "drawing.inset_mm": max(0.0, inset)}
    aims = _aims(options, base.replaced(values))
    if base.pump is None and ("tighter" in aims or gap > 0):
        around = gap or float(f"{_GAP * radius:.2g}")
        air = {**_AIR, "tip_clearance_mm": around, "end_clearance_mm": around}
        assumed |= {f"pump.{key}": value for key, value in air.items()}
    config = base.replaced(values | assumed | {"objective": _objective(aims)})
    shape, sheet = shape_of(config), record_of(config, [*config.design])
    land, least = float(shape.seal_width) * 1e3, sheet["displaced_volume_cm3"] - _ROOM
    limits = {
        "constraints.area_efficiency_min": 0.0,
        "constraints.outer_radius_max_mm": round(float(shape.outer_radius) * 1e3 + _ROOM, 6),
        "constraints.seal_width_min_mm": round(max(0.0, land - _ROOM), 6),
        "constraints.terms.displaced_volume_cm3": {"min": round(least, 6)},
    }
    config = config.replaced({key: value for key, value in limits.items() if key not in own})
    if options.report and (lacking := pages.missing()):
        say(f"no report is written: it needs {lacking}")
        options.report = False
    design = ", ".join(stated(key, x, named=True) for key, x in one.design.items())
    member = f"{one.family} ({design})" if design else one.family
    lines = [
        f"{path.name}: {'; '.join(rotor.facts)}",
        f"nearest profile: {member}, at most {one.departure * 1e6:.2g} um from it",
        *([f"inset {inset:.4g} mm along the normal, kept"] if inset else []),
        "assumed (change with --set): " + ", ".join(f"{key}={x}" for key, x in assumed.items()),
    ]
    options.known = {"found": lines[: None if assumed else -1], "aims": aims, "assumed": assumed}
    options.known |= {"inset_mm": max(0.0, inset), "fit": one.record()}
    return widened(config)[0]


def _given(options: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    """Return (known values of the file's rotor, by key of the section `profile`; other overrides).

    Raises `InputError` for a value that its key cannot have, or for a key that the file decides."""
    distance = options.centre_distance_mm
    words = {
        "profile.lobes": options.lobes,
        "profile.outline_unit": options.unit,
        "profile.pitch_radius_mm": None if distance is None else distance / 2,
        "rotor.length_mm": options.length_mm,
        "scene.speed_rpm": options.speed_rpm,
        "scene.load.torque_N_m": options.torque_N_m,
    }
    texts = [f"{key}={x}" for key, x in words.items() if x is not None] + options.overrides
    ours = [text.partition("=") for text in texts if text.startswith("profile.")]
    given = {key: read_document(value, f"--set {key}") for key, _, value in ours}
    load("cic").check_values(given)
    for key in given:
        if key not in words and not key.startswith("profile.outline_"):
            raise InputError(f"`{key}` must be left out, because it follows from the file")
    known = {key.removeprefix("profile."): x for key, x in given.items() if x is not None}
    return known, [text for text in texts if not text.startswith("profile.")]


def _asked(what: str, default: Any) -> Any:
    """Return the user's answer on a terminal, and elsewhere the `default`."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return default
    print(f"{what} [{default}]: ", end="", file=sys.stderr, flush=True)
    answer = read_document(sys.stdin.readline(), what)
    return default if answer is None else answer


def _fitted(rotor: MeasuredRotor, name: str) -> Likeness:
    """Return the member of a family that is nearest to a rotor from the file `name`.

    Raises `InputError` if no member is near."""
    blur = float(np.nan_to_num(3e-3 * rotor.checks.seen.scatter))
    near: list[Likeness] = []
    for family in dict.fromkeys((*_COMMON, *classical())):
        one = likeness(rotor.outline, family)
        near += [] if one is None else [one]
        if near and near[-1].departure <= _EXACT + blur:
            break
    else:
        if all(one.departure > _FAR + blur for one in near):
            free = free_likeness(rotor.outline, *near)
            near += [] if free is None else [free]
    best = min(near, key=lambda one: one.departure, default=None)
    if best is None or best.departure > _LOOSE * rotor.radius * 1e-3:
        raise InputError(
            f"{name}: must hold a rotor near a conjugate profile, but no profile family comes near "
            "it; check the outline and the centre distance"
        )
    return best


def _typical(base: Config, radius: float, own: set[str]) -> dict[str, Any]:
    """Return the assumed values of a scene for a rotor with this pitch `radius` (mm), by key.

    `base`: the config that is scaled; `own`: keys whose values the user gives. On a terminal, the
    user is asked for them."""
    size = radius / base.profile.pitch_radius_mm
    values = {key: (base.value(key), power) for key, power in _SCALED.items() if key not in own}
    return {
        key: _asked(key, float(f"{value * size**power:.3g}"))
        for key, (value, power) in values.items()
        if value is not None
    }


def _aims(options: argparse.Namespace, config: Config) -> list[str]:
    """Return the aims of the search; the default depends on whether the flanks touch.

    Raises `InputError` if forces are to be lowered but the flanks never touch."""
    aims, gap = [*dict.fromkeys(options.aims)], config.contact.clearance_mm
    gear = config.scene.timing_gear if gap > 0 else None
    apart = record_of(config, [*config.design])["gear_backlash_max_mm"] if gear else 0.0
    if gear is None or gear.backlash_mm > apart:
        return aims or ["quieter"]
    if "quieter" in aims:
        raise InputError(
            f"`--quieter` needs flanks that touch, but with a flank gap of {gap:g} mm the timing "
            f"gear keeps them apart up to a backlash of {apart:.3g} mm, and it has "
            f"{gear.backlash_mm:g} mm; leave the option out, or set the gear's backlash with "
            "`--set scene.timing_gear.backlash_mm`"
        )
    return aims or ["tighter"]


def _objective(aims: list[str]) -> dict[str, Any]:
    """Return the section `objective`, in which all `aims` have the same weight."""
    share = 1 / len(aims)
    force = share / 2 if "quieter" in aims else 0.0
    terms = {_TERMS[aim]: share for aim in aims if aim in _TERMS}
    return {"mean_weight": force, "peak_weight": force, "terms": terms}


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt improve`: search for a better rotor, and write files into `folder`.

    Return the `Outcome`, which shows the comparison. Raises `InputError` if the config or an option
    is invalid."""

    def further(result) -> dict[str, Any]:
        worth = abs(result.improvement.get("objective", 0.0)) >= WORTH
        cases = surviving(result, config) if worth else []
        lost = {"status": Status.NOT_IMPROVED.label, "message": NOTHING_BETTER}
        told = {} if worth or result.interrupted or result.optimized is None else lost
        return told | {"improve": options.known | {"cases": cases, "message": survives(cases)}}

    outcome = optimize.body(config, options, folder, further)
    gain = (outcome.result.get("improvement") or {}).get("objective", 0.0)
    tables, head = [*better_tables(plain(outcome.result))], options.known["found"]
    usable = outcome.usable and abs(gain) >= WORTH
    return cli.Outcome(usable, outcome.result, tables=tables, head=head)
