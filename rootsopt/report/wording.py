"""The summary of a report in sentences: what was asked, what came out, what to do next."""

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rootsopt.config import Config
from rootsopt.config.families import family_of
from rootsopt.output.names import brief, in_words, name_and_unit, quantity, stated
from rootsopt.output.table import status_cell
from rootsopt.output.tables import varied
from rootsopt.status import Status

if TYPE_CHECKING:
    from rootsopt.report.gather import Case, Run

_ASKED = {
    "optimize": "Find the design with the lowest objective, and compare it with the baseline.",
    "simulate": "Simulate one design in one scene: steady state, contact force, gradient.",
    "pareto": "Trace the best compromises between two or three quantities.",
    "sweep": "Simulate one design in many scenes.",
    "attractors": "Find the coexisting motions of a scene.",
    "profile": "Compute the geometry of one design.",
}
_TITLES = {
    "optimize": "Optimisation of {pair}",
    "simulate": "Simulation of {pair}",
    "pareto": "Best compromises for {pair}",
    "sweep": "Sweep of {pair}",
    "attractors": "Coexisting motions of {pair}",
    "profile": "Geometry of {pair}",
}
_FEW = 6
"""Number of design parameters above which sentences do not list them."""
_SMALL = 0.05
"""Absolute change (%) below which a quantity counts as unchanged."""


def title(run: "Run") -> str:
    """Return the title of the report."""
    pattern = _TITLES.get(run.command, "{pair}")
    return pattern.format(pair=_pair(run.config)).strip()


def asked(run: "Run") -> list[str]:
    """Return sentences on the task of the run."""
    sentences = [_ASKED.get(run.command, f"Run the command {run.command}."), scene(run.config)]
    if run.command == "optimize":
        sentences.append(_objective(run.config))
        keys = [one.key for one in run.config.scatters]
        if keys:
            shown = _joined(keys) if len(keys) <= _FEW else f"{len(keys)} numbers"
            sentences.append(f"The design should be best while these scatter: {shown}.")
    sentences += [f"{note}." for note in run.result.get("notes", ())]
    if run.rows:
        sentences.append(_over(run.rows))
    aims = run.result.get("terms")
    if run.command == "pareto" and aims:
        words = [f"{name_and_unit(aim['name'])[0]} ({_sense(aim['sense'])})" for aim in aims]
        sentences.append(f"The quantities are {_joined(words)}.")
    return sentences


def _over(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on the values that differ between the scenes of a sweep."""
    parts = []
    for key in varied(rows):
        name = name_and_unit(key)[0]
        found: list[Any] = [*dict.fromkeys(row.get(key) for row in rows)]
        shown = f"{len(found)} values"
        if len(found) <= _FEW:
            shown = _joined([stated(key, x) for x in found])
        elif all(isinstance(x, int | float) for x in found):
            shown += f" from {brief(min(found))} to {stated(key, max(found))}"
        parts.append(f"{name}: {shown}")
    return f"Between the scenes, these differ: {'; '.join(parts)}."


def scene(config: Config) -> str:
    """Return one sentence that describes the scene of a config."""
    data = config.scene
    speed = f"at {brief(data.speed_rpm)} rpm"
    load = data.load
    if load.torque_N_m is not None:
        under = f"under a load of {brief(load.torque_N_m)} N·m on rotor 2"
    else:
        under = f"under a pressure difference of {quantity(load.pressure_difference_Pa, 'Pa')}"
    gear, away = data.timing_gear, data.center_distance_error_mm
    parts = (
        gear and f"a timing gear with {brief(gear.backlash_mm)} mm backlash",
        data.motor and "a motor whose speed falls under load",
        config.rotor.helix_deg and f"rotors twisted by {quantity(config.rotor.helix_deg, '°')}",
        config.contact.friction and "friction between the flanks",
        data.supports and "elastic bearings",
        config.contact.clearance_mm and f"{brief(config.contact.clearance_mm)} mm clearance",
        away and f"a centre distance error of {brief(away)} mm",
        data.phase_error_mrad and f"a phase error of {brief(data.phase_error_mrad)} mrad",
    )
    present = [str(part) for part in parts if part]
    tail = f", with {_joined(present)}" if present else ""
    tail += "" if gear is not None else ", without a timing gear"
    return f"The scene is {_pair(config)}, {speed} {under}{tail}."


def came_out(run: "Run") -> list[str]:
    """Return sentences on the result of the run."""
    makers = {"optimize": _optimised, "pareto": _traced, "attractors": _coexisting}
    status = in_words(str(run.result.get("status", ""))).capitalize()
    first, rest = _message(run)
    words = " ".join([first, *rest]) if run.usable or _stopped(run) else first
    sentences = [f"{status}: {words}" if words else f"{status}."] if status else []
    if run.command in makers:
        return sentences + makers[run.command](run)
    return sentences + (_swept(run.rows) if run.rows else _single(run.cases[0]))


def _message(run: "Run") -> tuple[str, list[str]]:
    """Return the first sentence of the run's message, and the others."""
    first, *rest = re.split(r"(?<=[.!?]) (?=[A-Z])", str(run.result.get("message") or ""))
    return first, rest


def what_next(run: "Run") -> list[str]:
    """Return sentences on what to do next."""
    command = shlex.quote(str(run.path / "config.yaml"))
    if _stopped(run):
        return _after_stop(run)
    if not run.usable:
        advice = _message(run)[1]
        baseline = run.result.get("baseline") or {}
        if status_cell(str(baseline.get("status"))).good is False and baseline.get("message"):
            advice.append(f"Baseline: {baseline['message']}")
        return advice or ["See the meaning of each status at the end of this report."]
    if run.command == "optimize":
        return _after_optimum(run)
    if run.command == "simulate":
        return [
            f"Optimise this design: `rootsopt optimize {command}`.",
            f"Check other speeds: `rootsopt sweep {command}`.",
            f"Check whether other motions coexist with this one: `rootsopt attractors {command}`.",
        ]
    if run.command == "pareto":
        return [
            "Choose a point. Its config is in the folder designs; use it like any other: "
            f"`rootsopt simulate {shlex.quote(str(run.path / 'designs' / 'point_01.yaml'))}`.",
            "Where the curve is steep, little of one quantity buys much of the other.",
        ]
    if run.command == "profile":
        return [
            f"Simulate this design: `rootsopt simulate {command}`.",
            f"Draw it for a CAD program: `rootsopt profile {command} --export dxf,step`.",
        ]
    if run.command == "attractors" and len(run.cases) > 1:
        return [
            "Optimise over all motions, not only over the one reached from rest: "
            f"`rootsopt optimize {command} --set objective.motion=worst`."
        ]
    return [f"Optimise the design: `rootsopt optimize {command}`."]


def _stopped(run: "Run") -> bool:
    """Return whether the user has stopped the run."""
    return run.result.get("status") in (Status.INTERRUPTED.label, Status.NOT_SIMULATED.label)


def _after_stop(run: "Run") -> list[str]:
    """Return a sentence on how to go on with a run that was stopped."""
    again = f"rootsopt {run.command} {run.source}"
    if run.command not in ("optimize", "sweep"):
        return [f"Run it again, from its beginning: `{again}`."]
    resume = "" if "--resume" in run.source else " --resume"
    return [f"Go on from where it stopped: `{again}{resume}`."]


def _after_optimum(run: "Run") -> list[str]:
    command = shlex.quote(str(run.path / "optimized.yaml"))
    found = run.result.get("optimality") or {}
    unproven = bool(found) and not found.get("converged")
    dear = _dearest(run.result.get("constraints") or ())
    return [
        *filter(None, [str(found.get("message", "")) if unproven else dear]),
        f"Draw the rotor: `rootsopt profile {command} --export dxf,step`.",
        f"Check it at other speeds: `rootsopt sweep {command}`.",
        f"Check whether other motions coexist: `rootsopt attractors {command}`.",
    ]


def _dearest(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on the limit whose relaxation lowers the objective most."""
    prices = [row for row in rows if (row.get("relaxed_objective_percent") or 0.0) < 0]
    if not prices:
        return ""
    row = min(prices, key=lambda one: one["relaxed_objective_percent"])
    step = quantity(abs(row["relaxed_by"]), row.get("unit", ""))
    percent = abs(row["relaxed_objective_percent"])
    return (
        f"The limit with the highest price is {in_words(row['name'])}: relaxed by {step}, it "
        f"lowers the objective by {percent:.3g} %."
    )


def _optimised(run: "Run") -> list[str]:
    """Return sentences on an optimum, or on the baseline if there is none."""
    cases = {case.name: case for case in run.cases}
    if "optimised" not in cases:
        return _single(run.cases[0])
    sentences = []
    before, after = cases["baseline"].record, cases["optimised"].record
    member = "that of the nominal member of the family, fitted to the measured baseline"
    for entry, subject, whose in (
        ("improvement", "The objective", "the baseline's"),
        ("improvement_over_nominal", "It", member),
    ):
        gain = (run.result.get(entry) or {}).get("objective")
        if gain is not None and math.isfinite(gain):
            sentences.append(f"{subject} is {_percent(100 * -gain)} {whose}.")
    for key in ("mean_force_N", "peak_force_N"):
        a, b = (one.get("response", {}).get(key) for one in (before, after))
        if a and b is not None:
            name, percent = name_and_unit(key)[0], 100 * (b - a) / a
            change = f"{abs(percent):.3g} % {'less' if percent < 0 else 'more'}"
            change = "unchanged" if abs(percent) < _SMALL else change
            sentences.append(f"The {name} goes from {brief(a)} N to {brief(b)} N: {change}.")
    old, new = (cases[name].design for name in ("baseline", "optimised"))
    moved = [
        f"{name_and_unit(key)[0]} {brief(old[key])} → {stated(key, x)}"
        for key, x in new.items()
        if key in old
    ]
    if moved and len(new) <= _FEW:
        sentences.append(f"Design: {', '.join(moved)}.")
    found = run.result.get("optimality")
    if found:
        state = "hold" if found["converged"] else "do not hold"
        sentences.append(
            f"The first-order conditions of an optimum {state}: residual "
            f"{brief(found['residual'], 2)}, at most {brief(found['required_residual'])} required."
        )
    return sentences + _robust(run)


def _robust(run: "Run") -> list[str]:
    """Return a sentence on the designs in fresh scenes, or none if nothing scatters."""
    fresh = (run.result.get("robustness") or {}).get("fresh") or {}
    if not fresh:
        return []
    count = next(iter(fresh.values()))["scenes"]
    means = (f"{name} {quantity(one['objective'].get('mean'), '')}" for name, one in fresh.items())
    return [f"Mean objective in {count} fresh scenes that scatter: {', '.join(means)}."]


def _percent(change: float) -> str:
    """Return a change (%) as the beginning of a comparison, as in "20 % below"."""
    if abs(change) < _SMALL:
        return "the same as"
    return f"{abs(change):.3g} % {'below' if change < 0 else 'above'}"


def _traced(run: "Run") -> list[str]:
    points = run.result.get("points") or []
    if not points:
        return []
    sure = sum(point["status"] == "certified" for point in points)
    sentences = [f"The curve has {len(points)} points, {sure} of them certified."]
    for aim in run.result.get("terms") or ():
        numbers = [point["terms"][aim["name"]] for point in points]
        ends = f"{brief(min(numbers))} to {stated(aim['name'], max(numbers))}"
        sentences.append(f"Along it, the {name_and_unit(aim['name'])[0]} ranges from {ends}.")
    gaps = run.result.get("gaps") or []
    if gaps:
        where = [f"{gap['first']} and {gap['second']}" for gap in gaps]
        sentences.append(f"The curve or its designs jump between the points {_joined(where)}.")
    return sentences


def _coexisting(run: "Run") -> list[str]:
    rows = run.result.get("attractors") or []
    if not rows:
        return ["No motion could be told apart."]
    if len(rows) == 1:
        sentences = ["All initial states that settle lead to one motion."]
    else:
        sentences = [f"{len(rows)} motions coexist."]
    for number, row in enumerate(rows, start=1):
        peak = row.get("response", {}).get("peak_force_N")
        force = f"peak force {brief(peak)} N" if peak is not None else "no force known"
        rest = ", reached from rest" if row.get("reached") else ""
        share = f"{100 * row['share']:.3g} % of the initial states"
        state = in_words(str(row.get("status", "")))
        sentences.append(f"Motion {number} ({state}): {force}, {share}{rest}.")
    return sentences


def _swept(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return sentences on a sweep: how many scenes are steady, where the force is least."""
    known = [row for row in rows if row.get("peak_force_N") is not None]
    steady = sum(row.get("status") in ("periodic", "averaged") for row in rows)
    sentences = [f"{steady} of {len(rows)} scenes have a steady state."]
    axes = varied(rows)
    for word, pick in (("lowest", min), ("highest", max)) if known and axes else ():
        row = pick(known, key=lambda one: one["peak_force_N"])
        where = [stated(key, row.get(key), named=True) for key in axes]
        sentences.append(f"The peak force is {word}, {brief(row['peak_force_N'])} N, at "
                         f"{_joined(where)}.")  # fmt: skip
    return sentences


def _single(case: "Case") -> list[str]:
    """Return sentences on one simulated design."""
    record = case.record
    whose = "The baseline's contact force" if case.name == "baseline" else "The contact force"
    sentences = []
    response = record.get("response") or {}
    mean, peak = response.get("mean_force_N"), response.get("peak_force_N")
    if mean is not None and peak is not None:
        times = f", {peak / mean:.3g} times the mean" if mean > 0 else ""
        sentences.append(
            f"{whose} has a mean of {brief(mean)} N and a peak of {brief(peak)} N{times}."
        )
    steady = record.get("steady_state") or {}
    if steady.get("kind") == "periodic" and steady.get("period"):
        count = steady["period"]
        words = "every mesh period" if count == 1 else f"every {count} mesh periods"
        sentences.append(f"The motion repeats {words}.")
    best = _steepest((record.get("gradient") or {}).get("peak_force_N") or {})
    if best:
        sentences.append(best)
    geometry = record.get("geometry") or {}
    if not response and geometry.get("area_efficiency") is not None:
        sentences.append(
            f"The rotor has an outer radius of {brief(geometry['outer_radius_mm'])} mm and leaves "
            f"{100 * geometry['area_efficiency']:.4g} % of its outer circle free for the flow."
        )
    return sentences


def _steepest(gradient: Mapping[str, Any]) -> str:
    """Return a sentence on the design parameter with the steepest effect on the peak force."""
    known = {key: x for key, x in gradient.items() if x}
    if not known or len(known) > _FEW:
        return ""
    key = max(known, key=lambda one: abs(known[one]))
    word = "raises" if known[key] > 0 else "lowers"
    return (
        f"Raising the {name_and_unit(key)[0]} by {stated(key, 1)} {word} the peak force by "
        f"{brief(abs(known[key]))} N."
    )


def _objective(config: Config) -> str:
    weights = config.objective
    shares = {
        "mean force": weights.mean_weight,
        "peak force": weights.peak_weight,
        "RMS force": weights.rms_weight,
    }
    shares |= {f"line {order:g}": x for order, x in weights.line_weights.items()}
    shares |= {name_and_unit(name)[0]: x for name, x in weights.terms.items()}
    total = sum(shares.values()) or 1.0
    words = [f"{100 * x / total:.3g} % {name}" for name, x in shares.items() if x]
    speeds = weights.speeds_rpm
    over = ""
    if speeds:
        over = f", over the speeds {_joined([*map(brief, speeds)])} rpm"
    return f"The objective is {_joined(words)}, each relative to the baseline{over}."


def _pair(config: Config) -> str:
    profile = config.profile
    name = "measured" if profile.from_file else in_words(profile.family)
    if family_of(profile.family).maker is not None and len(name) <= 3:
        name = name.upper()
    radius = brief(profile.pitch_radius_mm)
    article = "an" if name[0] in "aeioAEIO" else "a"
    return f"{article} {name} rotor pair with {profile.lobes} lobes, pitch radius {radius} mm"


def _sense(word: str) -> str:
    return {"min": "as low as possible", "max": "as high as possible"}.get(word, word)


def _joined(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


__all__ = ["asked", "came_out", "scene", "title", "what_next"]
