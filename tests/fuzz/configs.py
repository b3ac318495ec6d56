"""Random configs of several classes, loaded as the commands load them.

A case fails if loading takes too long, or raises anything but an `InputError` with a proper
message. An accepted config must load again from its own `to_yaml` as the same config."""

import copy
import functools
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from rootsopt.config import Config, load, parse
from rootsopt.config.explain import tree
from tests.standins import fault_of, guarded

SECONDS = 2.0
"""CPU time (s) above which loading a config counts as a failure."""
SHIPPED = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))
# Numbers of changes made at once, drawn at random.
_ONES = (1, 1, 1, 2, 3, 8)

Case = tuple[bytes, tuple[str, ...]]
"""Bytes of a config file, and overrides."""


def tried(case: Case, folder: Path) -> tuple[Config | None, str | None]:
    """Return the config of a case if it is accepted, and a description of the failure, if any."""
    path = folder / "case.yaml"
    path.write_bytes(case[0])
    accepted: list[Config] = []
    failure = fault_of(lambda: accepted.append(load(path, case[1])), SECONDS)
    if accepted and failure is None:
        with guarded(4 * SECONDS):
            same = parse(accepted[0].to_yaml().encode().decode()) == accepted[0]
        failure = None if same else "does not load again as it was written"
    return next(iter(accepted), None), failure


# What configs are made of


@functools.cache
def _texts() -> tuple[list[str], list[dict]]:
    """Return the shipped configs without comments, as text and as plain data.

    Half of the texts are in YAML's other style."""
    trees = [yaml.safe_load(path.read_text()) for path in SHIPPED]
    return [
        yaml.safe_dump(tree, default_flow_style=k % 2 > 0) for k, tree in enumerate(trees)
    ], trees


def _tree(draw: random.Random) -> dict:
    return copy.deepcopy(draw.choice(_texts()[1]))


@functools.cache
def _keys() -> list[str]:
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


def _text(draw: random.Random) -> Case:
    text = draw.choice(_texts()[0])
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
    numbers = whole, real, float("nan"), float("inf"), [real, whole], draw.choice(NUMBERS)
    words = "", "x", "x" * 5000, draw.choice(WORDS)
    return draw.choice((None, True, False, *numbers, *words, [], {}, {"a": 1}))


def _structure(draw: random.Random) -> Case:
    data = _tree(draw)
    for _ in range(draw.choice(_ONES)):
        target: Any = data
        while target:
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
    count = draw.choice(_ONES)
    pairs = (f"{draw.choice(_keys())}={_scalar(draw)[:50_000]}" for _ in range(count))
    return draw.choice(_texts()[0]).encode(), tuple(pairs)


CLASSES: dict[str, Callable[[random.Random], Case]] = {
    "changed text": _text,
    "changed structure": _structure,
    "odd values": _values,
}
"""Classes of random configs, each made from a seeded source of random numbers."""
