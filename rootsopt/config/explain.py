"""Turns validation errors into one-sentence messages, and lists the config's keys for `--help`."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from rootsopt.config.section import UNMET, Section, bare, choices, is_number, number, require
from rootsopt.config.units import RPM, hint, named, near, readings, shown, unit_of, without_unit

# Maximum number of valid keys that a message lists.
_MOST_NAMES = 12

# What a value must be, by the type of pydantic's error.
_WANTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "finite_number": "a finite number",
    "model_type": "a section with keys of its own",
    "string_type": "a word",
    "dict_type": "keys with values, as in {a: 1, b: 2}",
    "tuple_type": "a list of numbers, as in [1, 2]",
}

# Type and last part of the location of an unknown key of a dictionary with a choice of keys.
_UNKNOWN_WORD = "literal_error", ("[key]",)
_TORQUE, _OUTER = "scene.load.torque_N_m", "profile.outer_radius_mm"

# Names in catalogues, without units: (key that the user means, factor to its value).
_SYNONYMS = {
    "center_distance": ("profile.pitch_radius_mm", 0.5),
    "centre_distance": ("profile.pitch_radius_mm", 0.5),
    "pitch_diameter": ("profile.pitch_radius_mm", 0.5),
    "outer_diameter": (_OUTER, 0.5),
    "tip_diameter": (_OUTER, 0.5),
    "diameter": (_OUTER, 0.5),
    "bore_diameter": ("rotor.bore_mm", 1.0),
    "rpm": ("scene.speed_rpm", 1.0),
    "pressure": ("scene.load.pressure_difference_Pa", 1.0),
    "torque": (_TORQUE, 1.0),
    "power": (_TORQUE, 1.0),
}
_SEARCHED = "contact is always found by the search, the most accurate of the former models"
_IN_BLOCK = "write it as {heading: text} under `drawing.title_block`"
_ONE_SEED = "set `optimizer.seed`, that of all samples"
_BY_ACCURACY = "set `solver.accuracy` to trade accuracy for time"

# Keys of former versions, each with (values that are still accepted, what to do instead). The
# accepted values include the old default, because a resolved config states it.
_REMOVED: dict[str, tuple[tuple[Any, ...], str]] = {
    "solver.fidelity": (("search",), f"{_SEARCHED}; {_BY_ACCURACY}"),
    "solver.nodes": ((400,), f"{_SEARCHED}; {_BY_ACCURACY}"),
    "solver.map_error": ((1e-4,), f"{_SEARCHED}; {_BY_ACCURACY}"),
    "solver.map_rolls": ((), f"{_SEARCHED}; {_BY_ACCURACY}"),
    "solver.map_relatives": ((), f"{_SEARCHED}; {_BY_ACCURACY}"),
    "solver.gradient": (("forward",), "both modes of differentiation gave the same gradient"),
    "solver.orbit": (
        ("auto", "collocation"),
        f"collocation closes orbits, and an integration confirms them; {_BY_ACCURACY}",
    ),
    "solver.precision": (
        ("float64",),
        f"motions are integrated in double precision; {_BY_ACCURACY}",
    ),
    "solver.transient_rtol": ((), "it is `solver.accuracy` / 100; set that"),
    "solver.slice_error": ((1e-2,), "set `solver.slices`"),
    "attractors.relative_range_mrad": ((), "the grid follows from backlash and contact"),
    "attractors.rate_range_rad_s": ((), "the grid follows from the speed of impacts"),
    "sweep.speed_rpm": (
        (),
        "give `rootsopt sweep` the option `--over scene.speed_rpm=300:6000:39`",
    ),
    "optimizer.method": (("auto", "slsqp"), "it follows from `objective.motion`"),
    "optimizer.learning_rate": ((0.05,), "set `optimizer.iterations`"),
    "tolerances.seed": ((0,), _ONE_SEED),
    "assumptions.seed": ((0,), _ONE_SEED),
    "tolerances.normal_limit": ((4.0,), "normal distributions are cut off at 4 deviations"),
    "drawing.title": (("Roots rotor",), _IN_BLOCK),
    "drawing.material": ((), _IN_BLOCK),
    "drawing.number": ((), _IN_BLOCK),
    "drawing.revision": ((), _IN_BLOCK),
    "drawing.drawn_by": ((), _IN_BLOCK),
    "drawing.date": ((), _IN_BLOCK),
    "drawing.general_tolerance": ((), _IN_BLOCK),
    "drawing.points": ((361,), "rotor_points.csv has 361 points, and all ends of pieces"),
}
_SIGNS = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
_COUNTS = {"min_length": "at least", "max_length": "at most"}


def explain(
    error: ValidationError,
    model: type[Section],
    keys: Sequence[Sequence[str]] | None = None,
    speed_rpm: Any = None,
) -> str:
    """Return one sentence on the problem that pydantic's `error` reports in a config.

    `model`: type of the config. If there are several problems, report the first unknown key. If no
    key is unknown, report the first problem. `keys`: keys, each as a list of its parts, inside
    which problems count; the result is "" if there are none. By default, all problems count.
    `speed_rpm`: what the config states, if anything, to convert a power to a torque."""
    problems = error.errors(include_url=False)
    if keys is not None:
        problems = [p for p in problems if _inside(p, keys)]
        if not problems:
            return ""
    known = tree(model)
    first = next((p for p in problems if _is_unknown(p)), problems[0])
    if _is_unknown(first):
        words = re.findall("'(.+?)'", first.get("ctx", {}).get("expected", ""))
        place = [part for part in first["loc"] if part != "[key]"]
        value = None if words else first.get("input")
        return _unknown(known, place, words, value, speed_rpm)
    place, rest = _split(known, first["loc"])
    field, key = known.get(place), ".".join(map(named, place.split(".")))
    first = _branch(first, problems, len(first["loc"]) - len(rest))
    kind, value, context = first["type"], first.get("input"), first.get("ctx", {})
    if kind == "missing":
        note = f" ({field.description})" if field is not None and field.description else ""
        return f"`{key}` is missing{note}; add it"
    if kind == "value_error":
        return str(context["error"])
    # After a key, pydantic lists positions in lists, keys of dictionaries, and types.
    mapping = field is not None and "dict[" in str(field.annotation)
    within = [part for k, part in enumerate(rest) if isinstance(part, int) or (mapping and k == 0)]
    key = ".".join((key, *map(named, within)))
    wanted = _wanted(kind, value, context, first["msg"], field)
    return f"`{key}` must be {wanted}, but is {shown(value)}{_advice(place, kind, value, field)}"


def without_removed(data: Any) -> Any:
    """Return a config's plain values without keys of former versions.

    Raises `ValueError` if one of them has a value that would now have no effect."""
    if not isinstance(data, dict):
        return data
    for key, (accepted, instead) in _REMOVED.items():
        section, _, name = key.partition(".")
        inner = data.get(section)
        if not isinstance(inner, dict) or name not in inner:
            continue
        value = inner[name]
        require(
            value is None or value in accepted or bare(str(value)) in accepted,
            f"`{key}` must be left out, but is {shown(value)}: {instead}",
        )
        data = data | {section: {one: x for one, x in inner.items() if one != name}}
    return {key: value for key, value in data.items() if (key, value) != ("sweep", {})}


def _is_unknown(problem: Any) -> bool:
    """Return whether a pydantic `problem` is an unknown key, of a section or a dictionary."""
    kind, last = problem["type"], problem["loc"][-1:]
    return kind in ("extra_forbidden", "invalid_key") or (kind, last) == _UNKNOWN_WORD


def _inside(problem: Any, keys: Sequence[Sequence[str]]) -> bool:
    """Return whether a pydantic `problem` is located at one of the `keys` or inside it.

    An unknown section above a key counts as well."""
    place, unknown = problem["loc"], _is_unknown(problem)
    return any(
        (unknown or len(place) >= len(key))
        and all(x == y for x, y in zip(place, key, strict=False))
        for key in keys
    )


def _split(known: Mapping[str, FieldInfo], location: tuple) -> tuple[str, list[Any]]:
    """Split the location of a pydantic error into the longest known key and the remaining parts."""
    parts = [str(part) for part in location]
    sizes = range(len(parts), 0, -1)
    size = next((size for size in sizes if ".".join(parts[:size]) in known), len(parts))
    return ".".join(parts[:size]), list(location[size:])


def _branch(first: Any, problems: Sequence[Any], size: int) -> Any:
    """Return the problem to report for a key that accepts either a word or a number.

    `first`: first of the `problems`; `size`: length of the key in its location. For a number
    that is not allowed, pydantic first reports that it is not one of the words. Return the problem
    with the number instead."""
    if first["type"] != "literal_error" or not is_number(first.get("input")):
        return first
    same = [p for p in problems if p["loc"][:size] == first["loc"][:size] and len(p["loc"]) > size]
    return next((p for p in same if p["type"] != "literal_error"), first)


def _wanted(kind: str, value: Any, context: dict, message: str, field: FieldInfo | None) -> str:
    """Return a description of the values that a key accepts."""
    if kind in ("float_type", "int_type") and is_number(value) and abs(value) > 2**53:
        return "a number of ordinary size"
    if kind in _WANTED or kind == UNMET:
        return _WANTED.get(kind) or context["wanted"]
    for name, word in _COUNTS.items():
        if name in context:
            return f"{word} {context[name]} numbers"
    real = field is not None and "float" in str(field.annotation)
    if kind == "greater_than_equal" and value <= 0 < context["ge"] and real:
        return f"greater than 0 (at least {context['ge']:g})"
    for name, word in _SIGNS.items():
        if name in context:
            return f"{word} {context[name]:g}"
    if kind == "literal_error":
        mapping = field is None or "dict[" in str(field.annotation)
        ranges = "" if mapping else limits_of(field).words
        return f"one of {context['expected']}{f' or a number ({ranges})' if ranges else ''}"
    return f"valid ({message[0].lower() + message[1:]})"


def _advice(place: str, kind: str, value: Any, field: FieldInfo | None) -> str:
    """Return a guess at the intended key, as the end of a message, or "" without a guess."""
    if field is None:
        return ""
    if kind in ("greater_than_equal", "less_than_equal", "less_than") and is_number(value):
        return hint(place, value, *limits_of(field).ends)
    if kind == "literal_error" and isinstance(value, str):
        meant = near(value.casefold(), choices(field))
        if not meant and place == "profile.family":
            return "; if that is a family of your own, give its file with `--import`"
        return f"; did you mean {meant}?" if meant else ""
    if kind == "float_type" and re.fullmatch(r"[-+]?\d+,\d+", str(value)[:20]):
        return f"; write {float(value.replace(',', '.')):g}"
    return ""


def _unknown(
    known: Mapping[str, FieldInfo], place: list, words: list[str], value: Any, speed_rpm: Any
) -> str:
    """Return the message on an unknown key, `place`, that has a `value`.

    `words`: keys that a dictionary may have, empty for a section; `speed_rpm`: as in `explain`."""
    prefix, last = "".join(f"{part}." for part in place[:-1]), str(place[-1])[:80]
    text = f"`{'.'.join(map(named, place))}` is not a known key"
    same = next((key for key in known if key.rpartition(".")[2] == last), "")
    told = "" if same or words else _translated(known, prefix, last, value, speed_rpm)
    if told:
        return f"{text}; did you mean {told}"
    names = [key.removeprefix(prefix) for key in known if key.startswith(prefix)]
    names = words or [name for name in names if "." not in name]
    close = near(last, names, cutoff=0.5)
    if meant := same or (close and prefix + close):
        return f"{text}; did you mean `{meant}`?"
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"{text}; valid here: {', '.join(names[:_MOST_NAMES])}{more}"


def _translated(
    known: Mapping[str, FieldInfo], prefix: str, name: str, value: Any, speed_rpm: Any
) -> str:
    """Return the key, with the converted value, for which a `name` from a catalogue stands.

    Return "" if there is no such key. `prefix`: section of the unknown key."""
    value, speed = number(value), number(speed_rpm)
    for stem, end, factor in readings(name):
        exact = [key for key in known if unit_of(key) and without_unit(key).endswith(f".{stem}")]
        exact.sort(key=lambda key: not key.startswith(prefix))
        key, share = _SYNONYMS.get(stem) or (exact[0] if exact else "", 1.0)
        if not key or not (key.endswith(end) or (stem, end) == ("power", "_kW")):
            continue
        if stem == "power":
            if not (end and is_number(value) and is_number(speed) and speed > 0):
                return f"`{key}`? it is half of the power over the speed (rad/s)"
            torque = value * factor * 1e3 / (2 * speed * RPM)
            return f"`{key}: {torque:.4g}`? it is half of that power at {speed:g} rpm"
        shown_value = share * factor != 1.0 and is_number(value) and end
        entry = f"`{key}: {value * factor * share:.6g}`" if shown_value else f"`{key}`"
        other = "; in other families it follows from their keys, which `rootsopt new` finds"
        return f"{entry}?" + (f" it belongs to family five_arcs{other}" if key == _OUTER else "")
    return ""


def tree(model: type[Section], prefix: str = "") -> dict[str, FieldInfo]:
    """Return the fields of all sections and keys of a `model`, by dotted name.

    `prefix`: beginning of all names."""
    fields: dict[str, FieldInfo] = {}
    for name, field in model.fields().items():
        fields[f"{prefix}{name}"] = field
        if inner := _section(field):
            fields |= tree(inner, f"{prefix}{name}.")
    return fields


def _section(field: FieldInfo) -> type[Section] | None:
    """Return the type of the section that a `field` holds, `None` if it is a key."""
    kinds = (field.annotation, *get_args(field.annotation))
    return next((k for k in kinds if isinstance(k, type) and issubclass(k, Section)), None)


class Limits(NamedTuple):
    """Limits of a number x: `ge` ≤ x, `gt` < x, x ≤ `le`, x < `lt`. `None`: no such limit."""

    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None

    @property
    def ends(self) -> tuple[float, float]:
        """Ends (low, high) of the range, infinite if there is no limit.

        An end is also returned if the range excludes it."""
        low = self.ge if self.ge is not None else self.gt
        high = self.le if self.le is not None else self.lt
        return (float("-inf") if low is None else low, float("inf") if high is None else high)

    @property
    def words(self) -> str:
        """The range in words, or "" without limits."""
        ends = zip(("from", "above", "to", "below"), self, strict=True)
        return " ".join(f"{word} {end:g}" for word, end in ends if end is not None)


def limits_of(field: FieldInfo | None) -> Limits:
    """Return the limits that a `field` sets for its numbers.

    For a list, these are the limits of each number; for a dictionary, those of each value."""
    marks = {type(mark).__name__.lower(): mark for mark in reversed([*_marks(field)])}
    return Limits(**{name: getattr(mark, name) for name, mark in marks.items()})


def _marks(kind: Any) -> Iterator[Ge | Gt | Le | Lt]:
    """Yield the limits that a field or type contains."""
    parts = get_args(kind)[get_origin(kind) is dict :]
    if isinstance(kind, FieldInfo):
        parts = *kind.metadata, kind.annotation
    for part in parts:
        if isinstance(part, Ge | Gt | Le | Lt):
            yield part
        else:
            yield from _marks(part)


def is_whole(field: FieldInfo | None) -> bool:
    """Return whether a key accepts whole numbers only."""
    kind = "" if field is None else str(field.annotation)
    return "int" in kind and "float" not in kind


class Key(NamedTuple):
    """A config key as `--help` and the site describe it.

    `name`: dotted name; `meaning`: its description; `unit`, `choices` (the words it accepts),
    `range` (of its numbers), `default`: texts, "" where there is none; `required`: whether a config
    must have it, if it has the section."""

    name: str
    meaning: str
    unit: str
    choices: str
    range: str
    default: str
    required: bool


def keys_of(model: type[Section]) -> list[Key]:
    """Return all keys of a `model`, without its sections, in their order."""
    return [_key(*one) for one in tree(model).items() if _section(one[1]) is None]


def _key(name: str, field: FieldInfo) -> Key:
    value = list(field.default) if isinstance(field.default, tuple) else field.default
    default = "" if field.default_factory or field.is_required() or value in (None, []) else value
    words, meaning = " | ".join(choices(field)), field.description or ""
    limits, required = limits_of(field).words, field.is_required()
    return Key(name, meaning, unit_of(name), words, limits, str(default), required)


GROUPS = {
    "design": ("profile", "rotor", "optimizer.bounds", "drawing"),
    "scene": ("scene", "contact"),
    "pump": ("pump",),
    "search": (
        "objective", "constraints", "optimizer", "attractors", "pareto", "tolerances",
        "assumptions", "response", "ensemble",
    ),
    "expert": ("solver",),
}  # fmt: skip
"""Sections in each group of keys in `--help`; of several that hold a key, the longest applies."""

# Keys that a short help lists; the choices of `profile.family` stand above them.
_USED_MOST = {
    "profile.lobes", "profile.pitch_radius_mm",
    "scene.speed_rpm", "scene.drive", "scene.load.torque_N_m",
    "scene.load.pressure_difference_Pa", "scene.timing_gear.stiffness_N_m_per_rad",
    "scene.timing_gear.backlash_mm", "contact.clearance_mm", "contact.stiffness_N_per_mm_e",
    "pump.viscosity_mPa_s", "objective.mean_weight", "objective.peak_weight",
    "constraints.area_efficiency_min", "optimizer.starts", "solver.accuracy",
}  # fmt: skip


def describe(model: type[Section], group: str = "") -> str:
    """Return one line per key of a `group` of keys: meaning, unit, choices or range, and default.

    Without a group, return the lines of all keys, in their order."""
    lines = []
    for key in keys_of(model):
        if group in ("", _group_of(key.name)):
            last = "required" if key.required else f"default {key.default}" if key.default else ""
            note = ", ".join(filter(None, (key.unit, key.choices, key.range, last)))
            lines.append(f"  {key.name:<42} {key.meaning}{f' [{note}]' if note else ''}".rstrip())
    return "\n".join(lines)


def outline(model: type[Section]) -> str:
    """Return one short line for each frequently used key, by group."""
    lines = []
    for group in GROUPS:
        lines.append(f" {group}")
        for key in keys_of(model):
            if key.name in _USED_MOST and _group_of(key.name) == group:
                meaning = re.split("[;:,(]", key.meaning)[0].strip()
                unit = f" [{key.unit}]" if key.unit else ""
                lines.append(f"  {key.name:<39} {meaning}{unit}")
    return "\n".join(lines)


def _group_of(key: str) -> str:
    """Return the group of a `key`."""
    groups = {start: group for group, starts in GROUPS.items() for start in starts}
    return groups[max((start for start in groups if f"{key}.".startswith(f"{start}.")), key=len)]
