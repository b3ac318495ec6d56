"""Random configs of several classes, loaded as the commands load them.

A case fails if loading takes too long, or raises anything but an `InputError` with a proper
message. An accepted config must load again from its own `to_yaml` as the same config, and its
geometry must be finite or rejected."""

import copy
import functools
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import yaml

from rootsopt.config import FAMILY_KEYS, Config, load, parse
from rootsopt.config.explain import is_whole, limits_of, tree
from rootsopt.config.section import choices, put
from rootsopt.profiles import geometry
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene, check_geometry, design_vector
from tests.fuzz.verdict import fault_of, guarded

SECONDS = 2.0
"""CPU time (s) above which loading a config counts as a failure."""
SHIPPED = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))
_ONES = (1, 1, 1, 2, 3, 8)
"""Numbers of changes made at once, drawn at random."""

Case = tuple[bytes, tuple[str, ...]]
"""Bytes of a config file, and overrides."""


def tried(case: Case, folder: Path) -> tuple[Config | None, str | None]:
    """Return the config of a case if it is accepted, and a description of the failure, if any."""
    path = folder / "case.yaml"
    path.write_bytes(case[0])
    config = None

    def loaded():
        nonlocal config
        config = load(path, case[1])

    failure = fault_of(loaded, SECONDS)
    if config is not None and failure is None:
        with guarded(4 * SECONDS):
            same = parse(config.to_yaml().encode().decode()) == config
        failure = None if same else "does not load again as it was written"
    return config, failure


@CachedFunction
def _measured(model, design):
    return geometry(model.profile(design))


def wrong_geometry(config: Config) -> str | None:
    """Return what is wrong with the geometry of an accepted config, or None."""

    def made():
        check_geometry(config)
        shape = _measured(Scene.from_config(config), design_vector(config))
        finite = all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(shape))
        if not (finite and float(shape.area) > 0):
            raise ArithmeticError(f"not finite: {shape}")

    return fault_of(made)


# What configs are made of


@functools.cache
def _texts() -> tuple[list[str], list[dict]]:
    """Return the shipped configs without comments, as text and as plain data.

    Half of the texts are in YAML's other style."""
    trees = [yaml.safe_load(path.read_text()) for path in SHIPPED]
    return [
        yaml.safe_dump(tree, default_flow_style=k % 2 > 0) for k, tree in enumerate(trees)
    ], trees


def _shipped(draw: random.Random) -> str:
    return draw.choice(_texts()[0])


def _tree(draw: random.Random) -> dict:
    return copy.deepcopy(draw.choice(_texts()[1]))


@functools.cache
def _keys() -> list[str]:
    """Return all dotted keys and sections."""
    return list(tree(Config))


SIZES = (0, 1, 2, 3, 5, 7, 12, 20, 33, 34, 50, 100, 200, 500, 1000, 2000, 6000, 200_000)
NUMBERS = (  # noqa: SIM905
    "0 -0.0 1 -1 0.033 33 1e300 -1e300 1e-300 5e-324 1e999 -1e999 .nan .inf -.inf 1e5 1E+5 .5 5. "
    "1_000 0x1F 0b11 0o17 017 08 1:30 190:20:30.15 1__ ._ -._ +. 0b_ 0x_ 1e 2020-01-01 "
    "2001-12-14t21:59:43.10-05:00 3,5 33mm 1/3 9007199254740993 1e-400 +5 --5"
).split()
WORDS = (  # noqa: SIM905
    "yes no on off true false null ~ cic CIC Free-Form ee search MAP baseline = << - ? : , ' \" "
    "| > & * ! % @ ` # [] {} [ ] { } '' \"\" é ß 中 \u202e \ufeff \x7f \x1b[31m"
).split(" ")


def _scalar(draw: random.Random) -> str:
    """Return a YAML scalar, in most cases an odd one."""
    size = draw.choice(SIZES)
    kinds: tuple[Callable[[], str], ...] = (
        lambda: draw.choice(NUMBERS),
        lambda: draw.choice(NUMBERS),
        lambda: draw.choice(WORDS),
        lambda: draw.choice(("9", "1", "0", "-7")) * size,
        lambda: draw.choice("ax '\"\\\n\t\x00_.:") * size,
        lambda: repr(draw.uniform(-1, 1) * 10 ** draw.uniform(-320, 308)),
        lambda: '"\\' + draw.choice(ESCAPES) + '"',
        lambda: draw.choice(TAGS) + " " + draw.choice((*NUMBERS, *WORDS, '"x"', "[1]", "{a: 1}")),
        lambda: "".join(chr(draw.choice((draw.randrange(128), draw.randrange(0xD800))))
                        for _ in range(draw.randrange(20))),
    )  # fmt: skip
    return draw.choice(kinds)()


ESCAPES = ("UFFFFFFFF", "U00110000", "uD800", "uDFFF", "x00", "q", "0", "N", "x1b", "u202e", "UZ")
TAGS = (  # noqa: SIM905
    "!!float !!bool !!timestamp !!int !!binary !!null !!str !!set !!omap !!pairs !!map !!seq "
    "!!merge !!value !!python/object:os.system !!python/name:os.system !x ! !<> "
    "!<tag:yaml.org,2002:int> !!python/object/apply:os.getcwd !%41"
).split()


def _hostile(draw: random.Random) -> str:
    """Return a construct meant to hang or break a YAML reader."""
    size, deep = draw.choice(SIZES), draw.randrange(2, 14)
    wide = draw.randrange(2, 12)

    def bomb(left, right, join):
        lines = [f"a0: &a0 {left}{join.join(['x'] * wide) if left == '[' else 'k: 1'}{right}"]
        for level in range(1, deep):
            inner = ", ".join([f"*a{level - 1}"] * wide)
            if left == "{":
                inner = draw.choice((f"<<: [{inner}]", f"k: *a{level - 1}, l: *a{level - 1}"))
            lines.append(f"a{level}: &a{level} {left}{inner}{right}")
        return "\n".join(lines) + f"\nprofile: *a{deep - 1}\n"

    kinds: tuple[Callable[[], str], ...] = (
        lambda: bomb("[", "]", ", "),
        lambda: bomb("{", "}", ", "),
        lambda: draw.choice(("&a [*a]", "&a {k: *a}", "&a {<<: *a}", "&a [[*a], *a]",
                             "&a {*a : 1}")),
        lambda: draw.choice("[{") * size,
        lambda: "[" * size + "]" * size,
        lambda: draw.choice(("- ", "? ", ": ", "a: ", "!!int ", "&a ", "--- ", "...\n")) * size,
        lambda: "\n".join(" " * k + "a:" for k in range(min(size, 400))),
        lambda: draw.choice(('"', "'", "|\n ", ">\n ", "#", "&", "*", "!", "%")) + "x" * size,
        lambda: "{" + ", ".join(f"k{k}: {k}" for k in range(size)) + "}",
        lambda: "[" + "1, " * size + "]",
        lambda: "{a: &b [" + "x" * min(size, 4000) + "], c: [" + "*b, " * draw.choice(SIZES) + "]}",
        lambda: draw.choice(("{a: 1, a: 2}", "{1: 1, 1.0: 2}", "{null: 1}", "{? [a]: 1}",
                             "{[a]: 1}", "{? {a: b} : 1}", "{.nan: 1}", "{true: 1}",
                             "{2020-01-01: 1}")),
        lambda: draw.choice(("a: 1\n---\nb: 2", "%YAML 2.0\n--- 1", "%YAML 1.1\n%YAML 1.1\n--- 1",
                             "%TAG ! tag:x,1:\n--- !y 1", "a:\n\tb: 1", "a: b: c", "- a\nb", "*x",
                             "{<<: 3}", "{<<: [1]}", "{<<: {a: 1}, <<: {b: 1}}", "<<: *x", "<<:")),
        lambda: draw.choice(TAGS) + " " + _scalar(draw),
        lambda: _scalar(draw),
    )  # fmt: skip
    return draw.choice(kinds)()


def _bytes(draw: random.Random) -> Case:
    data = draw.randbytes(draw.choice((0, 1, 3, 20, 200, 4000)))
    if draw.random() < 0.5:  # Most of it text.
        data = bytes(byte & 0x7F for byte in data)
    if draw.random() < 0.3:
        text = _shipped(draw)
        data = draw.choice(
            (
                text.encode(draw.choice(("utf-16", "utf-32", "utf-16-le", "utf-8-sig", "utf-7"))),
                data + text.encode(),
                text.encode()[: draw.randrange(len(text))] + data,
            )
        )
    return data, ()


def _text(draw: random.Random) -> Case:
    text = _shipped(draw)
    for _ in range(draw.choice(_ONES)):
        start = draw.randrange(len(text) + 1)
        stop = min(len(text), start + draw.choice((0, 1, 1, 2, 10, 200)))
        begin = draw.randrange(len(text) + 1)
        new = draw.choice(
            (
                "",
                draw.choice(" \n\t:-#[]{}&*!|>'\"%@`,?0123456789.eE_abc\x00é"),
                text[begin : begin + draw.choice((1, 5, 40))],
                _scalar(draw)[:2000],
            )
        )
        text = text[:start] + new + text[stop:]
    return text.encode("utf-8", "surrogatepass"), ()


def _leaf(draw: random.Random) -> Any:
    whole = draw.choice((0, 1, -1, 3, 2**63, -(2**70), 10 ** draw.choice((5, 20, 308, 309, 400))))
    real = draw.uniform(-1, 1) * 10 ** draw.uniform(-320, 308)
    leaves = (
        None,
        True,
        False,
        whole,
        real,
        float("nan"),
        float("inf"),
        "",
        "x",
        "x" * 5000,
        [],
        {},
    )
    return draw.choice((*leaves, draw.choice(WORDS), draw.choice(NUMBERS), [real, whole], {"a": 1}))


def _structure(draw: random.Random) -> Case:
    data = _tree(draw)
    for _ in range(draw.choice(_ONES)):
        target: Any = data
        while True:
            if not target:
                break
            key = draw.choice(list(target) if isinstance(target, dict) else range(len(target)))
            if isinstance(target[key], dict | list) and draw.random() < 0.8:
                target = target[key]
                continue
            change = draw.randrange(6)
            if change == 0:
                del target[key]
            elif change == 1 and isinstance(target, dict):
                odd = draw.choice((None, 1, 1.5, True, "", "x", "float", "int", "a[b", "k" * 3000))
                target[draw.choice((odd, draw.choice(_keys()).split(".")[-1]))] = target.pop(key)
            elif change == 2:
                target[key] = _tree(draw)
            elif change == 3 and isinstance(target[key], int | float):
                target[key] = min(abs(target[key]), 1e308) * draw.choice(
                    (0, -1, 1e-3, 1e3, 0.5, 2, 1e300, 57.3, 1 / 57.3)
                )
            elif change == 4:
                target[key] = draw.choice(([target[key]], {"a": target[key]}, str(target[key])))
            else:
                target[key] = _leaf(draw)
            break
    text = yaml.safe_dump(data, default_flow_style=draw.choice((True, False)), sort_keys=False)
    return text.encode("utf-8", "surrogatepass"), ()


def _values(draw: random.Random) -> Case:
    overrides = []
    for _ in range(draw.choice(_ONES)):
        overrides.append(f"{draw.choice(_keys())}={_scalar(draw)[:50_000]}")
    return _shipped(draw).encode(), tuple(overrides)


def _overrides(draw: random.Random) -> Case:
    def one():
        key = draw.choice(_keys())
        odd = (
            *("", ".", "a.b.c.d", f"{key}.x", f"x.{key}", f".{key}", key + ".", key.upper()),
            *("a." * 3000 + "a", key.split(".")[0], f" {key} ", "k" * 20_000, "\x1b[31m", "é"),
        )
        key = draw.choice((key, draw.choice(odd)))
        return draw.choice(
            (f"{key}={_hostile(draw)[:100_000]}", f"{key}={_scalar(draw)}", key, "=")
        )

    return _shipped(draw).encode(), tuple(one() for _ in range(draw.choice(_ONES)))


def _hostiles(draw: random.Random) -> Case:
    construct = _hostile(draw)
    if draw.random() < 0.5:
        text = construct
    else:
        lines = _shipped(draw).splitlines()
        number = draw.randrange(len(lines))
        head = lines[number].partition(":")[0]
        lines[number] = draw.choice((f"{head}: {construct}", construct, f"x: {construct}"))
        text = "\n".join(lines)
    return text.encode("utf-8", "surrogatepass"), ()


DESIGNS: dict[str, dict[str, Any]] = {
    "cic": {"pressure_angle_deg": 36.43, "involute_length_mm": 8.0, "tip_arc_angle_deg": 4.0},
    "ee": {},
    "arc": {"arc_center_mm": 29.7},
    "arcs_epicycloid": {"arc_center_mm": 27.0, "tip_arc_angle_deg": 8.0, "edge_radius_mm": 1.0},
    "arc_involute": {"pressure_angle_deg": 36.0, "involute_length_mm": 6.0},
    "four_arcs": {"arc_center_mm": 30.0, "tip_arc_radius_mm": 13.0, "tip_arc_turn_deg": 40.0},
    "five_arcs": {
        "outer_radius_mm": 45.0,
        "tip_arc_angle_deg": 3.0,
        "tip_arc_radius_mm": 13.0,
        "tip_arc_turn_deg": 60.0,
    },
    "circle_epicycloid": {"rolling_radius_mm": 7.0, "tip_arc_turn_deg": 30.0},
    "hypo_epicycloid": {"tip_arc_angle_deg": 4.0},
    "extended_cycloid": {"trochoid_ratio": 1.3},
    "ellipse": {"ellipse_center_mm": 27.0, "ellipse_height_mm": 18.0},
    "free_form": {"tip_arc_angle_deg": 4.0, "coefficients": [0.2, 0.1, 0.0, 0.1, 0.3, 0.5]},
}
"""A sound design of each family at 33 mm and three lobes."""
UNDRAWN = ("profile.", "scene.", "sweep.", "pareto.", "tolerances.", "optimizer.bounds")
"""Sections whose choices are not drawn at random."""
TIED = ("optimizer.family", "objective.motion", "objective.over_speeds")
"""Choices that require certain other keys."""
OPTIONAL = ("rotor.bore_mm", "contact.friction", "scene.timing_gear", "scene.supports")
SCATTER = {"rotor.length_mm": {"relative_uniform": 0.01}}
"""Distributions of a config with `tolerances`."""


def _inside(draw: random.Random, low: float, high: float) -> float:
    """Return a number within limits: an end, or a number drawn evenly in its logarithm."""
    if draw.random() < 0.3:
        return draw.choice((low, high))
    if low <= 0:
        return draw.uniform(low, high) * 10 ** draw.uniform(-6, 0)
    return min(high, max(low, low * (high / low) ** draw.random()))


@functools.cache
def _numbers() -> dict[str, tuple[float, float, bool]]:
    """Return limits of every plain number outside `profile`, and whether it is whole."""
    found = {}
    for key, field in tree(Config).items():
        words, limits = str(field.annotation), limits_of(field)
        low, high = limits.ends
        low += 1e-6 * (limits.gt is not None)
        high -= 1e-6 * (limits.lt is not None)
        plain = "tuple" not in words and "dict" not in words and high < float("inf")
        if plain and not key.startswith("profile."):
            found[key] = low, high, is_whole(field)
    return found


def _valid(draw: random.Random) -> Case:
    """Return a config whose numbers lie within their limits, with a design near a sound one."""
    family = draw.choice(list(DESIGNS))
    radius = _inside(draw, 1, 5000)
    spread = draw.choice((0.0, 0.0, 0.01, 0.1, 1.0))
    profile: dict[str, Any] = {"family": family, "pitch_radius_mm": radius}
    profile["lobes"] = draw.choice((3, 3, 2, 4, 5, 6))
    for key in FAMILY_KEYS[family]:
        value = DESIGNS[family][key]
        if isinstance(value, list):
            count = draw.choice((3, 6, 64)) if spread else len(value)
            profile[key] = [draw.uniform(-1, 1) if spread else value[k] for k in range(count)]
            continue
        size = radius / 33 if key.endswith("_mm") else 1.0
        turn = 3 / profile["lobes"] if key.endswith("_deg") else 1.0
        profile[key] = value * size * turn * 10 ** draw.gauss(0, spread)
    data: dict[str, Any] = {"profile": profile}
    fields = tree(Config)
    gone = [part for part in OPTIONAL if draw.random() < 0.5]
    if draw.random() < 0.2:
        data["tolerances"] = {"over": SCATTER}
    else:
        gone.append("tolerances.")
    load = draw.choice(("torque_N_m", "pressure_difference_Pa"))
    motor = draw.random() < 0.3
    data["scene"] = {"drive": "torque" if motor else "prescribed"}
    for key, (low, high, whole) in _numbers().items():
        name = key.split(".")[-1]
        needed = fields[key].is_required()
        if any(key.startswith(part) for part in gone) or ("motor" in key and not motor):
            continue
        if key.startswith("scene.load.") and name != load:
            continue
        if name == "phase_error_mrad" and "scene.timing_gear" in gone:
            continue
        if needed or draw.random() < 0.5 or key.startswith(("scene.load.", "contact.friction")):
            value = _inside(draw, low, high)
            put(data, key, round(value) if whole else value)
    if "contact.friction" not in gone:
        friction = data["contact"]["friction"]
        stiction = friction["stiction_speed_mm_s"]
        friction["friction_speed_mm_s"] = stiction * _inside(draw, 1.01, 10)
    constraints = data.get("constraints", {})
    if (low := constraints.get("outer_radius_min_mm")) is not None:
        constraints["outer_radius_max_mm"] = min(1e4, low * 1.1 + 1)
        constraints["outer_radius_min_mm"] = min(low, 9e3)
    if any(part not in gone for part in ("contact.friction", "scene.supports")):
        data["scene"].pop("center_distance_error_mm", None)
    for part in set(OPTIONAL[1:]) - set(gone):
        put(data, part, data.get(part.split(".")[0], {}).get(part.split(".")[1], {}))
    for key, field in fields.items():
        words = choices(field)
        free = not key.startswith(UNDRAWN) and key not in TIED
        if words and free and draw.random() < 0.2:
            word = draw.choice(words)
            put(data, key, draw.choice((word, word.upper(), word.replace("_", "-").title())))
    if draw.random() < 0.3:
        word = draw.choice(("weighted", "Worst"))
        put(data, "objective.speeds_rpm", [1000, 2000.5])
        put(data, "objective.over_speeds", word)
    return yaml.safe_dump(data, sort_keys=False).encode(), ()


CLASSES: dict[str, Callable[[random.Random], Case]] = {
    "random bytes": _bytes,
    "changed text": _text,
    "changed structure": _structure,
    "odd values": _values,
    "odd overrides": _overrides,
    "hostile YAML": _hostiles,
    "numbers within limits": _valid,
}
"""Classes of random configs, each made from a seeded source of random numbers."""
