"""The end of a run: what it gained and costs, how sure that is, and what to do next.

Terminal and report show the same sentences and commands, made from the content of the result file.
"""

import itertools
import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rootsopt.status import Status
from rootsopt.view import facts
from rootsopt.view.files import design_file
from rootsopt.view.identified import identified
from rootsopt.view.names import brief, in_words, name_and_unit, stated
from rootsopt.view.tables import Record, records_of

# What came out of a run, by command.
_FACTS = {
    "optimize": facts.optimised,
    "simulate": facts.simulated,
    "pareto": facts.traced,
    "sweep": facts.swept,
    "attractors": facts.coexisting,
    "identify": identified,
    "profile": facts.drawn,
}

# Commands whose runs end like those of another one.
_ALIKE = {"improve": "optimize"}

# Statuses of a run that need no explanation.
_SAID = *facts.STEADY, Status.GEOMETRY_ONLY.label, Status.IDENTIFIED.label

# Blanks between the sentences of a message: what came out, and then advice.
_SENTENCES = re.compile(r"(?<=[.!?]) (?=[A-Z])(?!In conflict)")
_STOPPED = Status.INTERRUPTED.label, Status.NOT_SIMULATED.label
_DRAW, _SIMULATE = ("Draw the rotor", "profile"), ("Simulate this design", "simulate")
_SPEEDS = "Check it at other speeds", "sweep"
_MOTIONS = "Check whether other motions coexist", "attractors"
_OPTIMISE = "Optimise the design", "optimize"

# What to do after a run with a usable result: (purpose, command).
_NEXT = {
    "optimize": (_DRAW, _SPEEDS, _MOTIONS),
    "simulate": (_OPTIMISE, _SPEEDS, _MOTIONS),
    "profile": (_SIMULATE, _OPTIMISE),
    "attractors": (_OPTIMISE,),
    "identify": (("Simulate the scene that was found", "simulate"), _MOTIONS),
    "pareto": (("Simulate one point", "simulate"), ("Draw its rotor", "profile")),
    "sweep": (_SIMULATE, _MOTIONS),
}


# Objective for flanks that stay apart, by whether the leakage is known: they have no force.
_APART = {
    known: f"objective={{mean_weight: 0, peak_weight: 0, terms: {{{term}: 1}}}}"
    for known, term in ((True, "leakage_fraction"), (False, "flow_ripple"))
}


class Ending(NamedTuple):
    """The end of a run in words.

    `facts`: (heading, sentences) of what came out; `steps`: (purpose, command) of what to do next.
    The command is "" if the purpose is advice that no single command follows."""

    facts: list[tuple[str, str]]
    steps: list[tuple[str, str]]


def ending(
    result: Record,
    place: Path,
    source: str,
    imports: Sequence[str] = (),
    rows: Sequence[Record] = (),
) -> Ending:
    """Return the end of the run with the content `result` of its result file.

    `place`: path of the result folder; `source`: arguments of the command as the user gave them,
    quoted for a shell; `imports`: values of `--import`, which the next commands need, too; `rows`:
    rows of a sweep, if the result does not hold them."""
    command, status = str(result["run"]["command"]), str(result.get("status", ""))
    again, command = f"rootsopt {command} {source}", _ALIKE.get(command, command)
    told = _FACTS[command](result, rows)
    first, *advice = re.split(_SENTENCES, str(result.get("message") or ""))
    said = f"{in_words(status).capitalize()}: {first}"
    if status in _STOPPED:
        told.insert(0, ("Status", " ".join([said, *advice])))
        resumed = again if "--resume" in source.split() else f"{again} --resume"
        return Ending(told, [("Go on from where it stopped", resumed)])
    if not _usable(command, status, result, rows):
        told.insert(0, ("Status", said))
        if not [*facts.reserves(result)]:  # Flanks that stay apart need no advice.
            changed = ("Then run it again" if advice else "Run it again with another config", again)
            return Ending(told, [*([(" ".join(advice), "")] if advice else []), changed])
    more = "".join(f" --import {shlex.quote(name)}" for name in imports)
    return Ending(told, [
        (why, f"rootsopt {name} {_quoted(place / file)}{options}{more}")
        for why, name, file, options in _steps(command, result, rows)
    ])  # fmt: skip


def _usable(command: str, status: str, result: Record, rows: Sequence[Record]) -> bool:
    """Return whether a run needs no explanation of its status: its facts say how sure they are."""
    several = {"sweep": rows, "attractors": result.get("attractors")}
    found = [row.get("status") for row in several.get(command) or ()]
    explained = command == "optimize" and result.get("optimized")
    return bool(explained) or not {status, *found}.isdisjoint(_SAID)


def _quoted(path: Path) -> str:
    """Return a path for a shell; one that begins with a hyphen would be taken for an option."""
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def _steps(
    command: str, result: Record, rows: Sequence[Record]
) -> Iterator[tuple[str, str, str, str]]:
    """Yield (purpose, command, file in the result folder, options) of what to do next.

    A config without design parameters cannot be optimised."""
    records = [*records_of(result).values()]
    fixed = not any(one.get("design") for one in records)
    names = {"optimize": "optimized.yaml", "identify": "identified.yaml"}
    file, where, sets = names.get(command, "config.yaml"), "", ""
    if command == "pareto":
        number, count = (len(result["points"]) + 1) // 2, len(result["points"])
        file, where = design_file(number), f" (here {number} of {count})"
    if command == "sweep":
        key, (row, *_) = facts.ranked(rows)
        worst = "lowest" if key.endswith("_um") else "highest"
        where = f" in the scene with the {worst} {name_and_unit(key)[0]}"
        sets = "".join(f" --set {shlex.quote(text)}" for text in _settings(row))
    if command == "attractors" and len(records) > 1:
        where, sets = " over all motions, not only that from rest", " --set objective.motion=worst"
    options = {"profile": " --export dxf"}
    for why, name in _NEXT[command]:
        if (command, name) == ("simulate", "optimize"):
            apart = result.get("status") == Status.IDLE.label
            why += "" if apart else _steepest(result)
            known = "volumetric_efficiency" in (result.get("pump") or {})
            options |= {name: f" --set {shlex.quote(_APART[known])}"} if apart else {}
        if not (name == "optimize" and fixed):
            yield f"{why}{where}", name, file, options.get(name, sets)


def _settings(row: Record) -> Iterator[str]:
    """Yield `key=value` for each key that a sweep sets in a row: those before its forces."""
    for key in itertools.takewhile(lambda one: not one.endswith("_force_N"), row):
        if "." in key:
            x = row[key]
            shown = f"{x:.12g}" if isinstance(x, int | float) and x is not True else str(x)
            yield f"{key}={shown}"


def _steepest(record: Record) -> str:
    """Return which design parameter changes the peak force most, as an addition in brackets."""
    slopes = (record.get("gradient") or {}).get("peak_force_N") or {}
    known = {key: x for key, x in slopes.items() if x}
    if not known or len(known) > facts.FEW:
        return ""
    key = max(known, key=lambda one: abs(known[one]))
    word = "raises" if known[key] > 0 else "lowers"
    much = f"{word} the peak force by {brief(abs(known[key]))} N"
    return f" ({stated(key, 1)} more of {name_and_unit(key)[0]} {much})"
