"""Texts and tables of the explorer's page, as HTML. Everything from a config is escaped."""

import html
from collections.abc import Iterable, Mapping

from rootsopt.config import Config
from rootsopt.explore.knobs import Knob
from rootsopt.explore.session import FromRest, NewMotion, Progress, Searched
from rootsopt.optimize.outcome import Optimization
from rootsopt.output.names import brief, in_words, label, percent, value
from rootsopt.response.evaluation import RESPONSES, Evaluation
from rootsopt.status import Status

_STEADY = ("period", "floquet_multiplier", "lyapunov_exponent_per_mesh_period")
_FORCES = {"mean_force_N": "mean", "peak_force_N": "peak", "rms_force_N": "RMS"}


def numbers_table(
    caption: str, now: Mapping[str, object], first: Mapping[str, object], keys: Iterable[str]
) -> str:
    """Return a table of quantities: now, at the start, and the change in % of the start.

    `keys`: keys of the result file in the order of the rows; an unknown number is a dash."""
    rows = []
    for key in keys:
        one, other = now.get(key), first.get(key)
        change = percent(other, one)
        cells = label(key), value(one), value(other), "" if change == "0.00 %" else change
        rows.append("".join(_cell(cell) for cell in cells))
    heads = "".join(f"<th>{head}</th>" for head in ("", "now", "at start", "change"))
    return _table(caption, heads, rows)


def geometry_table(now: Mapping[str, float], first: Mapping[str, float]) -> str:
    """Return the table of the geometry, now and at the start."""
    return numbers_table("Geometry", now, first, first or now)


def force_table(now: Evaluation | None, first: Evaluation | None) -> str:
    """Return the table of forces and kind of motion; dashes where nothing is known."""
    known, start = (_measures(one) for one in (now, first))
    keys = dict.fromkeys([*RESPONSES, *start, *known])
    return numbers_table("Contact force and motion", known, start, keys)


def _measures(evaluation: Evaluation | None) -> dict[str, object]:
    if evaluation is None:
        return {}
    steady = evaluation.steady_state
    return {**evaluation.response, **{key: steady[key] for key in _STEADY if steady.get(key)}}


def gradient_table(config: Config, evaluation: Evaluation | None, knobs: Iterable[Knob]) -> str:
    """Return the table of the derivatives of the forces, per unit of each design parameter."""
    design = {knob.key.removeprefix("profile."): knob for knob in knobs if knob.group == "Design"}
    if not config.design_keys:
        words = f"The family {html.escape(config.profile.family)} has no design parameters."
        return f'<p><b>Gradient</b></p><p class="note">{words}</p>'
    gradient = {} if evaluation is None else evaluation.gradient
    rows = []
    for key in config.design_keys:
        knob = design[key]
        unit = f" (N/{knob.unit})" if knob.unit else " (N)"
        slopes = [gradient.get(name, {}).get(key) for name in _FORCES]
        shown = ("–" if one is None else f"{one:+.4g}".replace("-", "−") for one in slopes)
        rows.append("".join(map(_cell, (knob.name + unit, *shown))))
    heads = "".join(f"<th>{head}</th>" for head in ("force per unit of", *_FORCES.values()))
    return _table("Gradient", heads, rows)


def _table(caption: str, heads: str, rows: Iterable[str]) -> str:
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return (
        f"<table><caption>{caption}</caption><thead><tr>{heads}</tr></thead>"
        f"<tbody>{body}</tbody></table>"
    )


def _cell(text: str) -> str:
    return f"<td>{html.escape(text)}</td>"


def status_line(word: str, kind: str, words: str, note: str = "") -> str:
    """Return the line with a status: its `word`, `kind` (good, bad, wait), advice and a note."""
    text = f'<span class="word {kind}">{html.escape(word)}</span><span>{html.escape(words)}</span>'
    if note:
        text += f'<span class="note">{html.escape(note)}</span>'
    return f'<div class="status">{text}</div>'


def notes_lines(notes: Iterable[str]) -> str:
    """Return the `notes` on values that are not usual, one to a line."""
    return "".join(f'<div class="note">{html.escape(note)}</div>' for note in notes)


def motion_line(motion: NewMotion, rest: FromRest | None) -> str:
    """Return the status of a motion, with whether it is the one that starts at rest.

    `rest`: what is known of the motion from rest; `None`: nothing yet."""
    found = motion.evaluation
    if not motion.final:
        words = "Near the motion of the last values, no steady motion was found."
        return status_line("searching", "wait", words, "Simulating from rest …")
    if not motion.near:
        note = "Reached from rest."
    elif rest is None:
        note = "Reached from the motion of the last values; from rest: being computed."
    elif rest.same:
        note = "Reached from the motion of the last values; from rest, the motion is the same."
    else:
        note = f"From rest, another motion is reached: {_summary(rest.evaluation)}."
    kind = "good" if found.usable else "bad"
    words = found.message
    if not found.usable and found.response and found.status is not Status.IDLE:
        words += " The numbers below are those of this motion, without a gradient."
    return status_line(in_words(found.status.label), kind, words, note)


def _summary(evaluation: Evaluation) -> str:
    mean, peak = (evaluation.response.get(key) for key in ("mean_force_N", "peak_force_N"))
    word = in_words(evaluation.status.label)
    if mean is None or peak is None:
        return word
    return f"{word}, mean {brief(mean, 4)} N, peak {brief(peak, 4)} N"


def progress_line(progress: Progress | None, cancelled: bool) -> str:
    """Return the state of a search that is running."""
    if cancelled:
        return status_line("stopping", "wait", "Checking the best design found so far …")
    if progress is None:
        return status_line("optimising", "wait", "Simulating the baseline …")
    best = f"; best objective {progress.best:.4f}" if progress.best == progress.best else ""
    words = f"{progress.done} of at most {progress.expected} designs simulated{best}."
    return status_line("optimising", "wait", words)


def searched_line(ended: Searched) -> str:
    """Return the outcome of a search: improvement and certificate."""
    found = ended.found
    if found is None:
        return status_line("not optimised", "bad", ended.words)
    word = in_words(found.status.label)
    if found.optimized is None:
        reason = found.status.value if found.infeasible is None else found.infeasible.message
        return status_line(word, "bad", reason)
    if found.status is Status.PERIODIC:
        word = "optimum"
    return status_line(word, "good", _improved(found), _certified(found))


def _improved(found: Optimization) -> str:
    """Return how much the optimum is below the design at which the search began."""
    names = {"objective": "objective", "mean_force_N": "mean", "peak_force_N": "peak"}
    gains = found.improvement
    changes = (
        f"{word} {-100 * gains[key]:+.1f} %".replace("-", "−")
        for key, word in names.items()
        if key in gains
    )
    return f"Against the start of the search: {', '.join(changes)}."


def _certified(found: Optimization) -> str:
    """Return the certificate of an optimum: first-order conditions, and the limits that hold it."""
    if found.optimality is None:
        return "Without a certificate."
    record = found.optimality.record()
    state = "hold" if record["converged"] else "do not hold"
    held = [row["name"] for row in found.constraints if row.get("active")]
    limits = f" Limits that hold it: {', '.join(held)}." if held else ""
    return (
        f"First-order conditions {state}: residual {brief(record['residual'], 2)}, at most "
        f"{brief(record['required_residual'], 2)} required.{limits}"
    )


def knob_label(knob: Knob) -> str:
    """Return the label of a knob: name and unit, with its meaning as a tooltip."""
    tip = f"{knob.key}: {knob.help}" if knob.help else knob.key
    unit = f' <span class="unit">({html.escape(knob.unit)})</span>' if knob.unit else ""
    return f'<div class="label" title="{html.escape(tip)}">{html.escape(knob.name)}{unit}</div>'


__all__ = [
    "force_table",
    "geometry_table",
    "gradient_table",
    "knob_label",
    "motion_line",
    "notes_lines",
    "progress_line",
    "searched_line",
    "status_line",
]
