"""Texts and tables of the explorer's page, as HTML. Everything from a config is escaped."""

import dataclasses
import html
from collections.abc import Iterable, Mapping
from typing import Any

from rootsopt.config import Config
from rootsopt.explore.knobs import Knob
from rootsopt.explore.session import FromRest, NewMotion, Progress, Searched
from rootsopt.optimize.outcome import Optimization
from rootsopt.output import tables
from rootsopt.output.names import brief, in_words, name_and_unit, percent
from rootsopt.report.html import table_html
from rootsopt.response.evaluation import RESPONSES, Evaluation
from rootsopt.status import Status

_STEADY = "period", "floquet_multiplier", "lyapunov_exponent_per_mesh_period"
"""Numbers of the kind of motion that the page has room for."""


def numbers_table(now: Mapping[str, Any], first: Mapping[str, Any]) -> str:
    """Return the table of forces, geometry and kind of motion, at the start and now.

    `now`, `first`: records as in the result file, perhaps without some entries: their numbers are
    dashes."""
    found = tables.numbers_table({"baseline": _shown(first), "optimized": _shown(now)})
    heads = "", "at start", "now", "change"
    return table_html(found and dataclasses.replace(found, title="Numbers", heads=heads))


def _shown(record: Mapping[str, Any]) -> dict[str, Any]:
    steady = {key: record.get("steady_state", {}).get(key) for key in _STEADY}
    shown = {key: record[key] for key in ("geometry", "response", "status") if key in record}
    return {"design": {}, "steady_state": {key: x for key, x in steady.items() if x}} | shown


def gradient_table(config: Config, evaluation: Evaluation | None) -> str:
    """Return the table of the derivatives of the forces, per unit of each design parameter."""
    if not config.design_keys:
        words = f"The family {html.escape(config.profile.family)} has no design parameters."
        return f'<p><b>Gradient</b></p><p class="note">{words}</p>'
    unknown = dict.fromkeys(config.design_keys)
    gradient = {name: unknown for name in RESPONSES}
    if evaluation is not None and evaluation.gradient:
        gradient = evaluation.gradient
    return table_html(next(tables.gradient_tables({"design": unknown, "gradient": gradient})))


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
    gains = found.improvement.items()
    changes = (f"{name_and_unit(key)[0]} {percent(1, 1 - gain)}" for key, gain in gains)
    return f"Against the start of the search: {', '.join(changes)}."


def _certified(found: Optimization) -> str:
    """Return the certificate of an optimum: first-order conditions, and the limits that hold it."""
    if found.optimality is None:
        return "Without a certificate."
    held = [in_words(row["name"]) for row in found.constraints if row.get("active")]
    limits = f" Limits that hold it: {', '.join(held)}." if held else ""
    return found.optimality.record()["message"] + limits


def knob_label(knob: Knob) -> str:
    """Return the label of a knob: name and unit, with its meaning as a tooltip."""
    tip = f"{knob.key}: {knob.help}" if knob.help else knob.key
    unit = f' <span class="unit">({html.escape(knob.unit)})</span>' if knob.unit else ""
    return f'<div class="label" title="{html.escape(tip)}">{html.escape(knob.name)}{unit}</div>'


__all__ = [
    "gradient_table",
    "knob_label",
    "motion_line",
    "notes_lines",
    "numbers_table",
    "progress_line",
    "searched_line",
    "status_line",
]
