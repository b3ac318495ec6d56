"""Turns validation errors into one-sentence messages, and lists the config's keys for `--help`."""

import difflib
import re
import types
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from rootsopt.config.section import choices
from rootsopt.config.units import hint, unit_of
from rootsopt.config.words import named, shown

_MOST_NAMES = 12
"""Maximum number of valid keys that a message lists."""


def explain(
    error: ValidationError, model: type[BaseModel], keys: Sequence[Sequence[str]] | None = None
) -> str:
    """Return one sentence on the problem that pydantic's `error` reports in a config.

    `model`: type of the config. If there are several problems, report the first unknown key. If no
    key is unknown, report the first problem. `keys`: keys, each as a list of its parts, inside
    which problems count; the result is "" if there are none. By default, all problems count."""
    problems = error.errors(include_url=False)
    if keys is not None:
        problems = [p for p in problems if _inside(p, keys)]
        if not problems:
            return ""
    first = next((p for p in problems if p["type"] in _UNKNOWN), problems[0])
    place, rest = _split(model, first["loc"])
    if first["type"] in _UNKNOWN and not rest:
        return _unknown(model, place)
    field = field_of(model, place)
    first = _branch(first, problems, place)
    # After a key, pydantic lists positions in lists, keys of dictionaries, and types.
    mapping = field is not None and "dict[" in str(field.annotation)
    within = [part for k, part in enumerate(rest) if isinstance(part, int) or (mapping and k == 0)]
    key = ".".join(map(named, place + within))
    kind, value, context = first["type"], first.get("input"), first.get("ctx", {})
    if kind == "missing" and not rest:
        note = f" ({field.description})" if field is not None and field.description else ""
        return f"`{key}` is missing{note}; add it"
    if kind == "value_error":
        return str(context["error"])
    if kind in ("missing", "too_short", "too_long"):  # Number of entries in a list.
        key = ".".join(map(named, place))
        count, given = _count(field, context), rest and first.get("input")
        return f"`{key}` must be {count}, but is {shown(given or value)}"
    wanted = _allowed(kind, value, context, first["msg"], field)
    return f"`{key}` must be {wanted}, but is {shown(value)}{_advice(place, kind, value, field)}"


_UNKNOWN = ("extra_forbidden", "invalid_key")


def _inside(problem: Any, keys: Sequence[Sequence[str]]) -> bool:
    """Return whether a pydantic `problem` is located at one of the `keys` or inside it.

    An unknown section above a key counts as well."""
    place, unknown = problem["loc"], problem["type"] in _UNKNOWN
    return any(
        (unknown or len(place) >= len(key))
        and all(x == y for x, y in zip(place, key, strict=False))
        for key in keys
    )


def _split(model: type[BaseModel], location: tuple) -> tuple[list[Any], list[Any]]:
    """Split the location of a pydantic error into the config's keys and the remaining parts."""
    place: list[Any] = []
    inner: type[BaseModel] | None = model
    for number, part in enumerate(location):
        if inner is None:
            return place, list(location[number:])
        place.append(part)
        found = inner.model_fields.get(part) if isinstance(part, str) else None
        inner = None if found is None else _model_of(found.annotation)
    return place, []


def _branch(first, problems, place):
    """Return the problem to report for a key that accepts either a word or a number.

    `first`: first of the `problems`; `place`: list of keys that leads to this key. For a number
    that is not allowed, pydantic first reports that it is not one of the words. Return the problem
    with the number instead."""
    if first["type"] != "literal_error" or not _is_number(first.get("input")):
        return first
    size = len(place)
    same = [p for p in problems if list(p["loc"][:size]) == place and len(p["loc"]) > size]
    return next((p for p in same if p["type"] != "literal_error"), first)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_real(field: FieldInfo | None) -> bool:
    """Return whether a key accepts real numbers, not only whole numbers."""
    return field is not None and "float" in str(field.annotation)


def _count(field: FieldInfo | None, context: dict) -> str:
    if "min_length" in context:
        return f"at least {context['min_length']} numbers"
    if field is not None and "..." in str(field.annotation).replace("Ellipsis", "..."):
        return f"at most {context['max_length']} numbers"
    return "two numbers, as in [1, 2]"


def _allowed(kind: str, value: Any, context: dict, message: str, field: FieldInfo | None) -> str:
    if kind in ("float_type", "int_type") and _is_number(value) and abs(value) > 2**53:
        return "a number of ordinary size"
    words = {
        "float_type": "a number",
        "float_parsing": "a number",
        "int_type": "a whole number",
        "int_from_float": "a whole number",
        "finite_number": "a finite number",
        "model_type": "a section with keys of its own",
        "string_type": "a word",
        "dict_type": "keys with values, as in {a: 1, b: 2}",
        "tuple_type": "a list of numbers, as in [1, 2]",
    }
    if kind in words:
        return words[kind]
    if kind == "greater_than_equal" and value <= 0 < context["ge"] and _is_real(field):
        return f"greater than 0 (at least {context['ge']:g})"
    signs = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    for name, word in signs.items():
        if name in context:
            return f"{word} {context[name]:g}"
    if kind == "literal_error":
        mapping = field is not None and "dict[" in str(field.annotation)
        ranges = _range(field) if field is not None and not mapping else ""
        other = f" or a number ({ranges})" if ranges else ""
        return f"one of {context['expected']}{other}"
    return f"valid ({message[0].lower() + message[1:]})"


def _advice(place: list, kind: str, value: Any, field: FieldInfo | None) -> str:
    """Return a guess at what the user meant, as the end of a message, or "" without a guess."""
    if field is None:
        return ""
    if kind in ("greater_than_equal", "less_than_equal", "less_than") and _is_number(value):
        low, high = limits_of(field.annotation, field.metadata).ends
        return hint(place[-1], value, low, high)
    if kind == "literal_error" and isinstance(value, str):
        near = difflib.get_close_matches(value[:80].casefold(), choices(field.annotation), n=1)
        if not near and place == ["profile", "family"]:
            return "; if that is a family of your own, give its file with `--import`"
        return f"; did you mean {near[0]}?" if near else ""
    if kind == "float_type" and isinstance(value, str) and len(value) < 20:
        try:
            return f"; write {float(value.replace(',', '.')):g}" if "," in value else ""
        except ValueError:
            return ""
    return ""


def _section(model: type[BaseModel], place: list) -> type[BaseModel] | None:
    inner: type[BaseModel] | None = model
    for part in place:
        field = inner.model_fields.get(part) if inner is not None else None
        if field is None:
            return None
        inner = _model_of(field.annotation)
    return inner


def _model_of(annotation: Any) -> type[BaseModel] | None:
    candidates = [annotation, *getattr(annotation, "__args__", ())]
    for candidate in candidates:
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def field_of(model: type[BaseModel], place: list) -> FieldInfo | None:
    """Return the field of `model` at `place`, a list of keys; `None` if no such key exists."""
    section = _section(model, place[:-1])
    return section.model_fields.get(place[-1]) if section is not None and place else None


def _unknown(model: type[BaseModel], place: list) -> str:
    key = ".".join(map(named, place))
    section = _section(model, place[:-1])
    names = list(section.model_fields) if section is not None else []
    last = str(place[-1])[:80]
    near = difflib.get_close_matches(last, names, n=1, cutoff=0.5)
    elsewhere = [k for k in all_keys(model) if k.split(".")[-1] == last]
    if elsewhere:
        return f"`{key}` is not a known key; did you mean `{elsewhere[0]}`?"
    if near:
        right = ".".join([*place[:-1], near[0]])
        return f"`{key}` is not a known key; did you mean `{right}`?"
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"`{key}` is not a known key; valid here: {', '.join(names[:_MOST_NAMES])}{more}"


def all_keys(model: type[BaseModel], prefix: str = ""):
    """Yield the dotted names of all sections and keys of a `model`, each preceded by `prefix`."""
    for name, field in model.model_fields.items():
        inner = _model_of(field.annotation)
        yield f"{prefix}{name}"
        if inner is not None:
            yield from all_keys(inner, f"{prefix}{name}.")


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


def limits_of(annotation: Any, metadata: Any = ()) -> Limits:
    """Return the limits that a field's `annotation` and `metadata` set for its numbers.

    For a list, these are the limits of each number; for a dictionary, those of each value."""
    found: dict[str, Any] = {}
    for mark in metadata:
        for inner in mark.metadata if isinstance(mark, FieldInfo) else (mark,):
            for kind, name in ((Ge, "ge"), (Gt, "gt"), (Le, "le"), (Lt, "lt")):
                if isinstance(inner, kind):
                    found[name] = getattr(inner, name)
    if found:
        return Limits(**found)
    if get_origin(annotation) is Annotated:
        inner, *marks = get_args(annotation)
        return limits_of(inner, marks)
    parts = get_args(annotation)
    if get_origin(annotation) is dict:
        parts = parts[1:]
    elif get_origin(annotation) not in (Union, types.UnionType, tuple):
        return Limits()
    return next((limits for part in parts if (limits := limits_of(part)) != Limits()), Limits())


def _range(field: FieldInfo) -> str:
    """Return the range of a key's numbers in words, or "" for a key without limits."""
    limits = limits_of(field.annotation, field.metadata)
    words = []
    if limits.ge is not None or limits.gt is not None:
        words.append(f"from {limits.ge:g}" if limits.ge is not None else f"above {limits.gt:g}")
    if limits.le is not None or limits.lt is not None:
        words.append(f"to {limits.le:g}" if limits.le is not None else f"below {limits.lt:g}")
    return " ".join(words)


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


def keys_of(model: type[BaseModel]) -> list[Key]:
    """Return all keys of a `model`, without its sections, in their order."""
    found = []
    for name in all_keys(model):
        field = field_of(model, name.split("."))
        if field is None or _model_of(field.annotation) is not None:
            continue
        default = ""
        if field.default_factory is None and not field.is_required():
            value = list(field.default) if isinstance(field.default, tuple) else field.default
            default = "" if value in (None, []) else str(value)
        found.append(
            Key(
                name,
                field.description or "",
                unit_of(name.split(".")[-1]),
                " | ".join(choices(field.annotation)),
                _range(field),
                default,
                field.is_required(),
            )
        )
    return found


GROUPS = {
    "design": ("profile", "rotor", "optimizer.bounds", "drawing"),
    "scene": ("scene", "contact"),
    "pump": ("pump",),
    "search": (
        "objective", "constraints", "optimizer", "sweep", "attractors", "pareto", "tolerances",
        "response", "ensemble",
    ),
    "expert": ("solver",),
}  # fmt: skip
"""Sections of the config in each group of keys in `--help`. The longest name counts."""
_USED_MOST = {
    "profile.family", "profile.lobes", "profile.pitch_radius_mm",
    "scene.speed_rpm", "scene.drive", "scene.load.torque_N_m",
    "scene.load.pressure_difference_Pa", "scene.timing_gear.stiffness_N_m_per_rad",
    "scene.timing_gear.backlash_mm", "contact.clearance_mm", "contact.stiffness_N_per_mm_e",
    "pump.viscosity_mPa_s", "objective.mean_weight", "objective.peak_weight",
    "constraints.area_efficiency_min", "optimizer.starts", "solver.accuracy",
}  # fmt: skip
"""Keys that a short help lists."""


def describe(model: type[BaseModel], group: str = "") -> str:
    """Return one line per key of a `group` of keys: meaning, unit, choices or range, and default.

    Without a group, return the lines of all keys, in their order."""
    lines = []
    for key in keys_of(model):
        if group and _group_of(key.name) != group:
            continue
        last = "required" if key.required else f"default {key.default}" if key.default else ""
        note = ", ".join(note for note in (key.unit, key.choices, key.range, last) if note)
        lines.append(f"  {key.name:<42} {key.meaning}{f' [{note}]' if note else ''}".rstrip())
    return "\n".join(lines)


def outline(model: type[BaseModel]) -> str:
    """Return one short line per key that is used most, by group."""
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
    found = {start: group for group, starts in GROUPS.items() for start in starts}
    return found[max((start for start in found if key.startswith(f"{start}.")), key=len)]
