"""Tests of the YAML reader: what it accepts, rejects and limits. Also random
configs."""

import os
import random
import re
import socket
import time
from pathlib import Path

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from rootsopt.config import load, parse
from rootsopt.config.document import MOST_BYTES, read_document
from tests.config.test_config import MINIMAL
from tests.fuzz import configs
from tests.standins import refusal as refused


def refusal(text, *overrides):
    """Return the message of a config that must be rejected soon, in one line of limited length."""
    began = time.process_time()
    message = refused(parse, text, overrides)
    assert time.process_time() - began < 2
    return message


def laughs(levels):
    """Return a YAML text in which every level contains the previous one nine times."""
    rows = [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, levels)]
    return "a0: &a0 [x]\n" + "".join(rows) + f"profile: *a{levels - 1}\n"


def merges(levels):
    """Return a YAML text in which every level merges the previous one nine times."""
    rows = [f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}\n" for k in range(1, levels)]
    return "a0: &a0 {k: 1}\n" + "".join(rows) + f"profile: *a{levels - 1}\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (laughs(10), "more than 5000 values"),
        (laughs(30), "more than 5000 values"),
        (merges(10), "more than 5000 values"),
        ("a: &a [" + "1, " * 60 + "]\nb: [" + "*a, " * 100 + "]", "more than 5000 values"),
        (
            "a: &a [[[[[[[[[[[[1]]]]]]]]]]]]\nb: [[[[[[[[[[[[[[[[[[[[[[*a]]]]]]]]]]]]]]]]]]]]]]",
            "32",
        ),
        ("[" * 10_000, "more than 32 nested levels"),
        ("- " * 3_000, "more than 32 nested levels"),
        ("\n".join(" " * k + "a:" for k in range(200)), "more than 32 nested levels"),
        ("[" + "1, " * 6000 + "]", "more than 5000 values"),
        ("x" * MOST_BYTES + "x", f"at most {MOST_BYTES} bytes"),
        ("é" * (MOST_BYTES // 2 + 1), f"at most {MOST_BYTES} bytes"),
        ("a: '" + "x" * 100_000 + "'", "at most 4096"),
        ("profile: &a [*a]", "an alias is inside"),
        ("profile: &a {lobes: {x: *a}}", "an alias is inside"),
        ("profile: &a {<<: *a}", "an alias is inside"),
        ("a: *" + "x" * 5000, "undefined alias"),
    ],
)
def test_size_of_what_is_read_is_bounded(text, words):
    """Alias bombs, loops, deep nesting and long values are rejected at once, in the file and with
    --set."""
    assert words in refusal(text)
    value = text.partition(": ")[2] if text.startswith(("a: ", "profile: ")) else text
    refusal(MINIMAL, f"profile={value}")


@pytest.mark.parametrize(
    "value",
    [
        '!!float ""',
        "!!float x",
        "!!bool maybe",
        "!!bool ''",
        "!!timestamp foo",
        "!!timestamp 2020-01-01",
        '!!int "x"',
        "!!int ''",
        "!!int 3.5",
        "!!null x",
        "!!int [1]",
        "!!seq x",
        "!!map [1]",
        "!!str {a: 1}",
        "!!binary '?'",
        "!!binary aGFsbG8=",
        "!!set {a, b}",
        "!!omap [a: 1]",
        "!!python/object:os.system {}",
        "!!python/name:os.system",
        "!!merge x",
        "!own x",
        "!" + "x" * 5000,
        '"\\UFFFFFFFF"',
        '"\\U00110000"',
        '"\\uD800"',
        '"\\uDFFF x"',
        '"\\q"',
        "a\x00b",
        "a\ud800b",
        "a\x07b",
        "9" * 4000,
        "0x" + "f" * 4000,
        "1" * 400,
        "-" + "9" * 350,
        "1e999",
        "._",
        "-._",
        "0b_",
        "1__.__e",
        "`x",
        "%x",
        "[1, 2",
        "{a: 1, a: 2}",
        "{1: 1, 1.0: 2}",
        "{null: 1}",
        "{true: 1}",
        "{? [a] : 1}",
        "{? {a: b} : 1}",
        "{.nan: 1}",
        "{1: 2}",
        "{float: 1}",
        "{'a[b': 1}",
        "{'': 1}",
        "{<<: 3}",
        "{<<: [1]}",
        "{<<: }",
        "{<<: {a: 1}, <<: {b: 1}}",
        "{<<: *x}",
        "1\n---\n2",
        "[" + "{a: 1}, " * 300 + "]",
        "x" * 4000,
        "\u202e",
        "{" + "k" * 1000 + ": 1}",
        "\t- x",
    ],
    ids=lambda value: ascii(value[:24]),
)
@pytest.mark.parametrize("key", ["scene.speed_rpm", "scene"])
def test_odd_value_is_refused_in_one_line(key, value):
    refusal(MINIMAL, f"{key}={value}")
    if "." in key:
        section, name = key.split(".", 1)
        refusal(f"{section}: {{{name}: {value}}}\n")
        refusal(f"{section}:\n  {name}: {value}\n")
    refusal(value)


@pytest.mark.parametrize(
    "override",
    [
        *("=", "", "=1", ".", "a.", ".a=1", "a.b.c.d=1", "scene.speed_rpm.x=1"),
        *("scene.speed_rpm.x.y=1", "\ud800=1", "\x1b[31m=1", "profile.lobes\n=1"),
        *("a." * 5000 + "a=1", "k" * 50_000, "k" * 50_000 + "=1"),
        *("scene.speed_rpm=" + "[" * 50_000, "scene=" + "x" * 300_000),
    ],
    ids=lambda override: ascii(override[:24]),
)
def test_odd_override_is_refused_in_one_line(override):
    refusal(MINIMAL, override)


def test_merge_keys_work():
    """`<<` accepts one section or a list of them. Own keys have precedence, then those merged
    first."""
    head = "ensemble: &one {seed: 5}\nattractors: &two {rates: 7}\n"
    message = refusal(head + MINIMAL.replace("rotor:\n", "rotor:\n  <<: [*one, *two]\n"))
    assert re.search("`rotor.(seed|rates)` is not a known key", message)
    data = read_document(
        "{one: &one {a: 1, b: 2}, two: &two {b: 3, c: 4}, x: {<<: [*one, *two], c: 5}, "
        "y: {a: 6, <<: *one}, z: *one}",
        "text",
    )
    assert [data["x"], data["y"]] == [{"a": 1, "b": 2, "c": 5}, {"a": 6, "b": 2}]
    assert data["z"] == data["one"] == {"a": 1, "b": 2}


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("1:30", "1:30"),
        ("2020-01-01", "2020-01-01"),
        ("yes", "yes"),
        ("off", "off"),
        ("=", "="),
        ("<<x", "<<x"),
        ("true", True),
        ("False", False),
        ("~", None),
        ("", None),
        ("010", 10),
        ("0x1F", 31),
        ("0o17", 15),
        ("-0b11", -3),
        ("1_000", 1000),
        ("+5.", 5.0),
        (".5e3", 500.0),
        ("1e5", 1e5),
        ("1.5E+5", 1.5e5),
        ("+3e5", 3e5),
        ("-.inf", float("-inf")),
        ("!!float 3", 3.0),
        ("!!int '12'", 12),
        ("!!str 12", "12"),
        ("1e", "1e"),
        ("\ufeff[1]", [1]),
        ("%YAML 1.2\n--- 1", 1),
    ],
)
def test_words_and_numbers_are_told_apart(written, value):
    """A time, a date or an octal is not a number, and a word is not a boolean."""
    found = read_document(written, "text")
    assert (type(found), found) == (type(value), value)


# Files


def test_what_is_no_regular_file_is_refused(tmp_path):
    """The command neither waits for a pipe nor reads a device without end."""
    pipe, bound = tmp_path / "pipe.yaml", tmp_path / "socket"
    os.mkfifo(pipe)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(bound))
        for path in (pipe, bound, Path("/dev/zero"), Path("/dev/null")):
            assert re.search(f"{path}.*regular file", refused(load, path))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a\x00b.yaml", "not a path"),
        ("x" * 5000, "cannot be read"),
        ("no/such\n/folder.yaml", "no such file"),
        ("\udcff.yaml", "no such file"),
        ("", "folder"),
    ],
)
def test_odd_path_is_refused(name, words):
    assert words in refused(load, name)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (MINIMAL.encode("utf-16"), "UTF-8"),
        (MINIMAL.encode("utf-16-le"), "not valid YAML"),
        (b"\xed\xa0\x80", "UTF-8"),
        (b"\xff", "UTF-8"),
        (b"\xc3", "UTF-8"),
        (b"a: \x00", "not valid YAML"),
        (b"#" * (MOST_BYTES + 1), "bytes"),
        (b"#" * MOST_BYTES + b"\xff" * 100, "bytes"),
        (b"#" * 50_000_000, "bytes"),
    ],
    ids=range(9),
)
def test_bytes_that_are_no_config_are_refused(tmp_path, data, words):
    path = tmp_path / "x.yaml"
    path.write_bytes(data)
    assert words in refused(load, path)


# Commands and random configs


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("configs")


@pytest.mark.parametrize("kind", configs.CLASSES)
@given(seed=st.integers(0))
def test_random_configs(kind, folder, seed):
    """Random configs are refused in one line, or accepted and read back as they were written."""
    config, failure = configs.tried(configs.CLASSES[kind](random.Random(seed)), folder)
    assert failure is None
    event("refused" if config is None else "accepted")
