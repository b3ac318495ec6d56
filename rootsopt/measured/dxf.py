"""Reads outlines from DXF drawings, text or binary."""

import io
from collections import Counter
from typing import Any

import numpy as np

from rootsopt.config.units import named
from rootsopt.errors import InputError
from rootsopt.measured.entities import KINDS, chain, strokes
from rootsopt.measured.estimates import UNITS
from rootsopt.measured.loop import Loop, guarded, silenced

with silenced():  # Importing ezdxf writes to its log.
    from ezdxf import recover
    from ezdxf.document import Drawing
    from ezdxf.lldxf import types
    from ezdxf.lldxf.tagger import binary_tags_loader

# Approximate distance between points on arcs and splines, as a fraction of the drawing's size.
_SPACING = 1 / 400
_LAYER = "OUTLINE"
_CURVES = ("LINE", "ARC", "SPLINE", "ELLIPSE")
_PARTS = ("VERTEX", "INSERT")

# Number of entities (including block inserts and the vertices of a POLYLINE) above which a
# drawing is rejected.
_ENTITIES = 100_000

# Total number of points on all entities above which a drawing is rejected.
_POINTS = 500_000

# Number of levels of nested blocks above which a drawing is rejected.
_DEEPEST = 8

# Absolute value of a number in an entity (drawing units) above which a drawing is rejected as
# damaged. A drawing whose diagonal (mm) reaches this value is also rejected.
_LARGEST = 1e9
_BINARY = b"AutoCAD Binary DXF\r\n\x1a\x00"
_NOT = "is not a DXF file that can be read"
_AGAIN = "export it again (DXF R2000 or newer) or save the outline as CSV"
_INCH, _SURVEY_FOOT = 25.4, 1200 / 3937 * 1e3
_METRE = 1e3

# Length (mm) of each drawing unit, keyed by its code in $INSUNITS. Other codes, such as those of
# astronomical units (17 to 20), are rejected.
_UNITS = {
    0: 1.0,
    1: _INCH,
    2: 12 * _INCH,
    3: 63360 * _INCH,
    4: 1.0,
    5: 10.0,
    6: _METRE,
    7: 1e3 * _METRE,
    8: 1e-6 * _INCH,
    9: 1e-3 * _INCH,
    10: 36 * _INCH,
    11: 1e-10 * _METRE,
    12: 1e-9 * _METRE,
    13: 1e-6 * _METRE,
    14: 1e-1 * _METRE,
    15: 1e1 * _METRE,
    16: 1e2 * _METRE,
    21: _SURVEY_FOOT,
    22: _SURVEY_FOOT / 12,
    23: 3 * _SURVEY_FOOT,
    24: 5280 * _SURVEY_FOOT,
}


def from_dxf(data: bytes, name: str, unit: str | None = None) -> list[Loop]:
    """Return the points (mm) on each entity that may belong to the outline, as open chains.

    `data`: content of the file; `name`: name of the file in messages; `unit`: name of the unit of
    its numbers, instead of the unit that the drawing states. Raises `InputError` if the
    drawing cannot be read, is too large or contains no such entity."""
    binary = data.startswith(_BINARY)
    counted = _check_tags(data, binary, name)
    with guarded(name, _NOT, _AGAIN):
        if binary:
            document = Drawing.load(binary_tags_loader(data))
            auditor = document.audit()
        else:
            document, auditor = recover.read(io.BytesIO(data))
        code = document.header.get("$INSUNITS", 0)
        kept = Counter(e.dxftype() for e in document.entitydb.values() if e.is_alive)
        reasons = [str(fix.message) for fix in auditor.fixes]
    for kind in _CURVES:
        if kept[kind] < counted[kind]:
            # The library has removed entities, so the rest may be another outline.
            reason = next((text for text in reasons if kind in text), "damaged")
            raise InputError(
                f"{name}: {counted[kind] - kept[kind]} of {counted[kind]} {kind} are not valid "
                f"({named(reason, 100)}); repair or remove them in the drawing"
            )
    scale = _UNITS.get(code) if isinstance(code, int) else None
    scale = scale if unit is None else UNITS[unit]
    if scale is None:
        raise InputError(
            f"{name}: $INSUNITS must be the code of a length unit (4: mm, 1: inch, 0: none), but "
            f"is {named(code)}; set the drawing's units, or `profile.outline_unit`"
        )
    with silenced():
        parts = [strokes(entity, scale, name) for entity in _chosen(document, name)]
    parts = [part for part in parts if part]
    if not parts:
        raise InputError(
            f"{name}: must hold an outline of {', '.join(KINDS)}, but those in it have no extent; "
            "export it again"
        )
    rough = np.concatenate([stroke.rough for part in parts for stroke in part])
    size = float(np.hypot(np.ptp(rough.real), np.ptp(rough.imag)))
    if not 0 < size < _LARGEST:
        raise InputError(
            f"{name}: must hold an outline, but its entities measure {size:.4g} mm; check the "
            "drawing and its units ($INSUNITS)"
        )
    count = sum(stroke.intervals(_SPACING * size) for part in parts for stroke in part)
    if count > _POINTS:
        raise InputError(
            f"{name}: must hold an outline of at most {_POINTS} points, but its entities need "
            f"{count}; draw the outline alone on a layer {_LAYER}"
        )
    return [chain(part, _SPACING * size, scale) for part in parts]


def _check_tags(data: bytes, binary: bool, name: str) -> Counter[str]:
    """Check the raw tags of a DXF file and return the number of entities of each kind.

    `data`: content of the file; `binary`: whether the file is a binary DXF; `name`: its name in
    messages.

    Raises `InputError` if the file is incomplete, if a number of an entity is invalid, or if there
    are too many entities. This check is needed because the library reads "1,5" as 1. It also
    accepts a number that is cut off at the end of the file.
    """
    counted: Counter[str] = Counter()
    kind = ""
    # The guard is around the whole loop, as the library reads the file while it yields tags.
    with guarded(name, _NOT, _AGAIN):
        tags = binary_tags_loader(data) if binary else recover.bytes_loader(io.BytesIO(data))
        for number, (code, value) in enumerate(tags, 1):
            if code == 0:
                kind = _raw(value).decode("latin-1").strip().upper()
                counted[kind] += 1
            elif kind in (*KINDS, *_PARTS) and not _sound(code, _raw(value)):
                where = f"tag {number}" if binary else f"line {2 * number}"
                raise InputError(
                    f"{name}, {where}: a number of {kind} must be finite and at most "
                    f"{_LARGEST:g}, but is {named(_raw(value).decode('latin-1'))!r}; repair or "
                    "remove the entity, or export the drawing again"
                )
    count = sum(counted[kind] for kind in (*KINDS, *_PARTS))
    if count > _ENTITIES:
        raise InputError(
            f"{name}: must have at most {_ENTITIES} lines, arcs and vertices, but has {count}; "
            "export the outline alone"
        )
    if kind != "EOF":
        raise InputError(
            f"{name}: must end with the mark EOF of a complete drawing, but does not; {_AGAIN}"
        )
    return counted


def _raw(value: Any) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode(errors="backslashreplace")


def _sound(code: int, value: bytes) -> bool:
    """Return whether the `value` of a tag is no number, or one that an entity may have."""
    if code >= 1000 or not (code in types.POINT_CODES or types.TYPE_TABLE.get(code) is float):
        return True
    try:
        return abs(float(value)) <= _LARGEST and b"_" not in value
    except ValueError:
        return False


def _chosen(document: Drawing, name: str) -> list[Any]:
    """Return the entities that may form the outline: the first of these groups that is not empty.

    The groups are: entities on the layer OUTLINE drawn directly; entities on this layer in blocks;
    all entities drawn directly; all entities in blocks. Raises `InputError` if all are empty."""

    def on_layer(entities: list[Any]) -> list[Any]:
        return [e for e in entities if str(e.dxf.layer).upper() == _LAYER]

    with guarded(name, _NOT, _AGAIN):
        everything = list(document.modelspace())
        direct = [e for e in everything if e.dxftype() in KINDS]
        inserts = [e for e in everything if e.dxftype() == "INSERT"]
        group = on_layer(direct)
        if not group:
            blocks = _exploded(inserts, name)
            group = on_layer(blocks) or direct or blocks
    if not group:
        raise InputError(
            f"{name}: must hold an outline of {', '.join(KINDS)}, but "
            f"{'its blocks have' if inserts else 'has'} none of them; draw it with these"
        )
    return group


def _exploded(inserts: list[Any], name: str) -> list[Any]:
    """Return the entities of inserted and nested blocks, placed as they appear in the drawing.

    `inserts`: the library's block inserts; `name`: name of the drawing in messages. The library's
    `recursive_decompose` has no limit on depth or number, and leaves entities on layer 0 there."""

    def skipped(entity, reason):
        if entity.dxftype() in KINDS:
            raise InputError(
                f"{name}: {entity.dxftype()} in a block cannot be placed: {named(reason)}; "
                "explode the blocks in the drawing"
            )

    entities, handled = [], 0
    queue = [(insert, 1) for insert in inserts]
    for insert, depth in queue:  # Nested inserts join the queue.
        with guarded(name, "holds a block that cannot be read", "explode the blocks"):
            single = depth <= _DEEPEST and insert.mcount == 1
            own = list(insert.virtual_entities(skipped_entity_callback=skipped)) if single else []
            for entity in (e for e in own if e.dxf.layer == "0"):
                entity.dxf.layer = insert.dxf.layer  # CAD does so for layer 0.
        handled += 1 + len(own)
        if not single or handled > _ENTITIES:
            raise InputError(
                f"{name}: blocks must be inserted singly, nested at most {_DEEPEST} deep, with at "
                f"most {_ENTITIES} entities in total, but these are not; explode the blocks in the "
                "drawing"
            )
        entities += [e for e in own if e.dxftype() in KINDS]
        queue += [(e, depth + 1) for e in own if e.dxftype() == "INSERT"]
    return entities
