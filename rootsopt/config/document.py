"""Reads one YAML document as plain data, within size limits, and sets values in it.

The language is YAML 1.1 as PyYAML reads it, with some exceptions that suit a config. `1e5` is a
number; `1:30`, `2020-01-01`, `yes` and `off` are words; `010` is ten. A key may appear only once in
a section. Tags yield plain data only. Anchors, aliases and merge keys are allowed, but the document
must stay within the limits after their expansion."""

import re
from collections.abc import Callable
from typing import Any

import yaml
from yaml.constructor import ConstructorError
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from rootsopt.config.section import is_number, put
from rootsopt.config.units import clipped, named, sentence, shown
from rootsopt.errors import InputError

MOST_BYTES = 128 * 1024
"""Text size (bytes) above which a document is rejected. A typical config has about 2000 bytes."""

# Number of keys, values, lists and sections above which a document is rejected.
#
# Each use of an alias counts as a copy.
_MOST_NODES = 5000

# Number of nested levels (sections and lists) above which a document is rejected.
_DEEPEST = 32

_TOO_DEEP = f"there are more than {_DEEPEST} nested levels"

# Length of a scalar (characters) above which a document is rejected.
_LONGEST_VALUE = 4096

# Length of a number (characters) above which a document is rejected. A double has at most 309
# digits before its decimal point.
_MOST_DIGITS = 400

_TAG = "tag:yaml.org,2002:"
_MERGE = _TAG + "merge"

# Number of dotted parts in a key above which an override is rejected. Config keys have at most
# three parts.
_MOST_PARTS = 8


def read_document(text: str, source: str) -> Any:
    """Return a YAML text as dictionaries, lists and plain values.

    `source`: name of the text in messages. Aliases become separate copies. Raises `InputError` if
    the text is too large or not valid."""
    if len(text.encode("utf-8", "surrogatepass")) > MOST_BYTES:
        raise InputError(
            f"{source}: must have at most {MOST_BYTES} bytes, but has more; is that a config?"
        )
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _extent(node, 1, {})
        return _unshared(loader.construct_document(node))
    except RecursionError:
        raise InputError(f"{source}: is not valid YAML: {_TOO_DEEP}") from None
    # Only the reader runs here, so the text causes any exception.
    except Exception as error:
        raise InputError(sentence(f"{source}: is not valid YAML{_told(error)}")) from None


def _extent(node: Node, level: int, known: dict[int, Any]) -> tuple[int, int]:
    """Return (number of values, number of levels) in a `node`, with aliases expanded.

    `level`: that of the node, from 1; `known`: extents by the node's `id`, `None` inside a node.
    Raises an error if a limit is exceeded."""
    if id(node) not in known:
        known[id(node)] = None
        parts = [] if isinstance(node, ScalarNode) else node.value
        pairs = (part if isinstance(node, MappingNode) else (part,) for part in parts)
        inner = [_extent(one, level + 1, known) for pair in pairs for one in pair]
        known[id(node)] = 1 + sum(n for n, _ in inner), 1 + max((n for _, n in inner), default=0)
    if known[id(node)] is None:
        raise _wrong("an alias is inside the node that it names", node.start_mark)
    count, levels = known[id(node)]
    if level + levels - 1 > _DEEPEST:
        raise _wrong(_TOO_DEEP, node.start_mark)
    if count > _MOST_NODES:
        words = f"there are more than {_MOST_NODES} values once aliases are expanded"
        raise _wrong(words, node.start_mark)
    return count, levels


def _told(error: Exception) -> str:
    """Return the line number and the problem of a YAML error, in words for a message."""
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    place = f" (line {mark.line + 1})" if mark is not None else ""
    problem = getattr(error, "problem", None)
    if problem is None:
        lines = str(error).splitlines()
        problem = lines[0] if isinstance(error, yaml.YAMLError) and lines else "cannot be read"
    context = getattr(error, "context", None)
    if context is not None and problem.startswith("but "):
        problem = f"{context}, {problem}"
    if "'\\t'" in problem:
        problem += "; indent by spaces"
    return f"{place}: {clipped(problem, 300)}"


def _unshared(data: Any) -> Any:
    """Return a copy in which aliases are separate objects, so that an override changes one key."""
    if isinstance(data, dict):
        return {key: _unshared(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_unshared(value) for value in data]
    return data


def _unknown(_, node):
    tag = named(str(node.tag).replace(_TAG, "!!"))
    raise _wrong(f"the tag {tag} is not known; write the value without it", node.start_mark)


class _Loader(yaml.SafeLoader):
    """PyYAML's SafeLoader with messages for users of a config."""

    yaml_implicit_resolvers = {}  # noqa: RUF012
    yaml_constructors = {  # noqa: RUF012
        _TAG + "str": yaml.SafeLoader.construct_yaml_str,
        _TAG + "seq": yaml.SafeLoader.construct_yaml_seq,
        _TAG + "map": yaml.SafeLoader.construct_yaml_map,
        None: _unknown,
    }

    def fetch_flow_collection_start(self, TokenClass):
        # PyYAML compares each bracket with all open ones: thousands would take seconds.
        if self.flow_level > _DEEPEST:
            raise _wrong(_TOO_DEEP, self.get_mark())
        super().fetch_flow_collection_start(TokenClass)

    def compose_scalar_node(self, anchor):
        node = super().compose_scalar_node(anchor)
        if len(node.value) > _LONGEST_VALUE:
            raise _wrong(
                f"a value has {len(node.value)} characters; at most {_LONGEST_VALUE} are read",
                node.start_mark,
            )
        if any("\ud800" <= character <= "\udfff" for character in node.value):
            raise _wrong(
                f"{shown(node.value)} holds half of a character (a lone surrogate)",
                node.start_mark,
            )
        return node

    def compose_mapping_node(self, anchor):
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key_node, value_node in node.value:
            if key_node.tag == _MERGE:
                key: Any = "<<"
                _check_merge(value_node)
            else:
                key = self._key(key_node)
            if key in seen:
                more = "; give it a list, as <<: [*a, *b]" if key_node.tag == _MERGE else ""
                raise _wrong(f"the key {shown(key)} is given twice{more}", key_node.start_mark)
            seen.add(key)
        return node

    def _key(self, node: Node) -> str | float:
        key = self.construct_object(node) if isinstance(node, ScalarNode) else None
        if isinstance(key, str) or is_number(key):
            return key
        kinds = {MappingNode: "a section", SequenceNode: "a list"}
        what = kinds.get(type(node)) or shown(node.value) if node.value != "" else "empty"
        raise _wrong(f"a key must be a plain name, but is {what}", node.start_mark)


def _check_merge(node: Node) -> None:
    """Raise an error unless the value of a merge key is a section or a list of sections."""
    parts = node.value if isinstance(node, SequenceNode) else [node]
    for part in parts:
        if not isinstance(part, MappingNode):
            raise _wrong(
                "the merge key << must be given sections from elsewhere, as <<: *name or "
                f"<<: [*a, *b], but is given {shown(part.value) if part.value else 'nothing'}",
                node.start_mark,
            )


def _wrong(problem: str, mark) -> ConstructorError:
    return ConstructorError(None, None, problem, mark)


_NUMBER = re.compile(
    r"[-+]?(?:[0-9][0-9_]*\.?[0-9_]*(?:[eE][-+]?[0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+]?[0-9]+)?"
    r"|\.(?:inf|Inf|INF))|\.(?:nan|NaN|NAN)"
)
_WHOLE = re.compile(r"[-+]?(?:0b[01_]+|0o[0-7_]+|0x[0-9a-fA-F_]+|[0-9][0-9_]*)")
_CONSTANTS = {
    "bool": {"true": True, "True": True, "TRUE": True}
    | {"false": False, "False": False, "FALSE": False},
    "null": dict.fromkeys(("", "~", "null", "Null", "NULL")),
}


def _whole(text: str) -> int:
    if _WHOLE.fullmatch(text) is None:
        raise ValueError
    digits = text.replace("_", "")
    return int(digits, 0 if digits.lstrip("+-")[1:2] in ("b", "o", "x") else 10)


def _real(text: str) -> float:
    if _NUMBER.fullmatch(text) is None:
        return float(_whole(text))
    return float(text.lower().replace("_", "").replace(".inf", "inf").replace(".nan", "nan"))


def _scalar(kind: str, words: str, read: Callable[[str], Any]) -> None:
    """Register `read` as the function that converts scalars of a YAML type `kind`.

    `words`: what such a scalar must be, for messages. `read` must raise `ValueError`, `KeyError` or
    `OverflowError` for text that is not valid."""

    def construct(loader, node):
        text = loader.construct_scalar(node)
        try:
            if len(text) > _MOST_DIGITS:
                raise ValueError
            return read(text)
        except (ValueError, KeyError, OverflowError):
            raise _wrong(f"{shown(text)} is not a {words}", node.start_mark) from None

    _Loader.add_constructor(_TAG + kind, construct)


_scalar("bool", "truth value (true or false)", _CONSTANTS["bool"].__getitem__)
_scalar("null", "way to write an empty value (null or ~)", _CONSTANTS["null"].__getitem__)
_scalar("int", "whole number that can be read", _whole)
_scalar("float", "number that can be read", _real)
for _kind, _pattern, _first in (
    ("bool", "|".join(_CONSTANTS["bool"]), "tTfF"),
    ("null", "|".join(_CONSTANTS["null"]), ["", "~", "n", "N"]),
    ("int", _WHOLE.pattern, "-+0123456789"),
    ("float", _NUMBER.pattern, "-+.0123456789"),
    ("merge", "<<", "<"),
):
    _Loader.add_implicit_resolver(_TAG + _kind, re.compile(rf"^(?:{_pattern})\Z"), list(_first))


def override_in(data: dict, override: str) -> None:
    """Set the value of an `override`, as for `--set`, in plain `data`.

    Raises `InputError` if it is not of the form `dotted.key=value`."""
    key, equals, value = override.partition("=")
    parts = key.strip().split(".")
    name = f"--set {shown(override)}"
    if not equals or not all(parts):
        raise InputError(f"{name}: must be dotted.key=value, as in scene.speed_rpm=1500")
    if len(parts) > _MOST_PARTS:
        raise InputError(f"{name}: has more than {_MOST_PARTS} dotted keys; no key is that deep")
    put(data, ".".join(parts), read_document(value, name))
