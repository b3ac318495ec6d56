"""`rootsopt new`: write a config from a catalogue sheet, asking for what is missing."""

import argparse
import os
import re
import shlex
import sys
import textwrap
from typing import Any

from pydantic import ValidationError

from rootsopt.commands import cli
from rootsopt.config.document import read_document
from rootsopt.config.explain import Key, explain, keys_of
from rootsopt.config.families import family_of
from rootsopt.config.plausible import notes
from rootsopt.config.reading import Config, parse
from rootsopt.config.sheet import Sheet, made, option
from rootsopt.config.sources import regular_file
from rootsopt.config.units import placed, sentence
from rootsopt.errors import InputError
from rootsopt.runtime.environment import say
from rootsopt.scene.check import shape_of, sized
from rootsopt.view import files

_POWERS = "power_kW", "pressure_difference_bar"


def body(options: argparse.Namespace) -> int:
    """Run `rootsopt new`: write a config from a catalogue sheet. Return the exit code.

    Raises `InputError` if an entry is missing or wrong, if no profile meets the sheet, or if the
    file exists."""
    path = regular_file(options.config, "a new config")
    if os.path.lexists(path) and not options.overwrite:
        raise InputError(
            f"{placed(path)}: exists; give `--overwrite` to replace it, or another name"
        )
    sheet = Sheet.model_validate(_entries(options))
    with cli.waiting("looking for a profile"):
        config = _met(sheet)
        efficiency = float(shape_of(config).area_efficiency)
    given = shlex.join(word for one in options.overrides for word in ("--set", one))
    head = textwrap.fill(f"Made by: rootsopt new {path.name} {sheet.command} {given}", 98)
    head += "\nA comment names the option or table of a value, and usual values in its unit."
    text = sheet.text(config.profile, efficiency, head, options.overrides)
    for note in notes(parse(text, source="the config")):
        say(note)
    if not sheet.clearance_mm and sheet.clearance_mm is not None:
        say(
            "without `--clearance-mm` of more than 0, the flanks hammer each other: the motion may "
            "be chaotic, and `rootsopt simulate` end with exit code 3"
        )
    new = path.with_name(f".{path.name}.{os.getpid()}") if options.overwrite else path
    files.create(new, text.encode())
    os.replace(new, path)
    named = zip(config.design_keys, config.design, strict=True)
    flow = sheet.displaced(efficiency)
    print(
        f"profile: {', '.join((config.profile.family, *(f'{k} {v:.6g}' for k, v in named)))}\n"
        f"load: {sheet.compared(efficiency)}\n"
        f"displaced: {flow * 1e3:.4g} l per turn, {flow * sheet.speed_rpm * 60:.4g} m³/h\n"
        f"config in {path}; next: rootsopt simulate {path}"
    )
    return cli.OK


def _entries(options: argparse.Namespace) -> dict[str, Any]:
    """Return the entries of the sheet that are given, by option or at a terminal.

    Raises `InputError` if one is wrong, or if one that is needed is missing."""
    keys = keys_of(Sheet)
    given = {
        key.name: _value(key, text)
        for key in keys
        if (text := getattr(options, key.name)) is not None
    }
    if _missing(given, keys) and sys.stdin is not None and sys.stdin.isatty():
        for key in keys:
            answered = key.name in given or (key.name == _POWERS[1] and _POWERS[0] in given)
            while not answered and (text := _answer(key)):
                try:
                    given[key.name], answered = _value(key, text), True
                except InputError as error:
                    print(error, file=sys.stderr)
    if missing := _missing(given, keys):
        raise InputError(f"{', '.join(missing)} must be given; see `rootsopt new --help`")
    return given


def _value(key: Key, text: str) -> Any:
    """Return the value of a `text`; raise `InputError` if the key cannot have it."""
    value = read_document(text, option(key.name))
    try:
        Sheet.model_validate({key.name: value})
    except ValidationError as error:
        if message := explain(error, Sheet, [[key.name]]):
            raise InputError(sentence(message.replace(key.name, option(key.name), 1))) from None
    return value


def _answer(key: Key) -> str:
    """Return the answer at the terminal, "" for the default."""
    name, _, implied = key.meaning.partition("; default: ")
    unit = f" in {key.unit}" if key.unit else ""
    choices = f" ({key.choices})" if key.choices else ""
    default = "" if key.required else f" [{key.default or implied or 'none'}]"
    name = re.split("[:;,]", name)[0]
    print(f"{name}{unit}{choices}{default}: ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip()


def _missing(given: dict[str, Any], keys: list[Key]) -> list[str]:
    """Return the names of the required options that are not `given`."""
    names = [f"`{option(key.name)}`" for key in keys if key.required and key.name not in given]
    either = " or ".join(f"`{option(name)}`" for name in _POWERS)
    return names if {*_POWERS} & {*given} else [*names, either]


def _met(sheet: Sheet) -> Config:
    """Return a config with a profile of the sheet's size; raise `InputError` if there is none."""
    pair = f"{sheet.lobes} lobes and {sheet.centre_distance_mm:g} mm between axes"
    if sheet.outer_diameter_mm >= sheet.greatest:
        raise InputError(
            f"`--outer-diameter-mm` must be below {sheet.greatest:.6g} at {pair}, but is "
            f"{sheet.outer_diameter_mm:g}; lower it, or raise `--centre-distance-mm`"
        )
    radii: list[tuple[float, str]] = []
    for name in [sheet.family] if sheet.family else made():
        try:
            text = sheet.text(sheet.first_profile(family_of(name)))
        except ValidationError:  # A parameter that its key cannot have at this size.
            continue
        result = sized(parse(text, source="sheet"))
        if isinstance(result, Config):
            return result
        radii += [(radius, name) for radius in result]
    who = f"family {sheet.family}" if sheet.family else "all families"
    where = f"{who} at {pair}"
    if not radii:
        raise InputError(f"`--outer-diameter-mm`: no sound profile in {where}; change the lobes")
    low, (high, widest) = 2 * min(radii)[0], max(radii)
    bound = f"{2 * high:.6g}"
    if 2 * high - low >= 1e-6:
        bound = f"from {low:.1f} to {2 * high:.1f} (by search; the greatest in {widest})"
    rest = ", or leave out `--family`" if sheet.family else ""
    raise InputError(
        f"`--outer-diameter-mm` must be {bound} in {where}, but is {sheet.outer_diameter_mm:g}; "
        f"change one of them{rest}"
    )
