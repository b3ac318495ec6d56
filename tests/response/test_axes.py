"""Values of one key as a user writes them."""

import itertools
import tracemalloc

import numpy as np
import pytest

from rootsopt.errors import InputError
from rootsopt.response.sweeps import plan
from rootsopt.response.sweeps.plan import axis_of, parse_over

SPEED, BACKLASH = "scene.speed_rpm", "scene.timing_gear.backlash_mm"


@pytest.mark.parametrize(
    ("key", "given", "values"),
    [
        (BACKLASH, "0.05,0.1, 0.2", (0.05, 0.1, 0.2)),
        (SPEED, "300:600:4", (300.0, 400.0, 500.0, 600.0)),
        (SPEED, "600:300:3", (600.0, 450.0, 300.0)),
        (SPEED, "1:100:3:log,7", (1.0, 10.0, 100.0, 7)),
        (SPEED, "-1e1:+.5E1:2", (-10.0, 5.0)),
        (SPEED, "2:4:3", (2.0, 3.0, 4.0)),
        (SPEED, np.array([1.0, 2.0]), (1.0, 2.0)),
        (SPEED, [np.int64(3)], (3,)),
        (SPEED, (100.0 * x for x in range(1, 3)), (100.0, 200.0)),
        ("profile.lobes", range(2, 5), (2, 3, 4)),
        ("profile.lobes", "2:3:3", (2, 2.5, 3)),  # for the config to refuse
        ("profile.lobes", "2:6:5", (2, 3, 4, 5, 6)),
        ("profile.family", "cic, ee", ("cic", "ee")),
        ("scene.timing_gear", "null,{backlash_mm: 0.1}", (None, {"backlash_mm": 0.1})),
        ("profile.coefficients", "[1, 0.5],[0.2,0.3]", ([1, 0.5], [0.2, 0.3])),
        ("profile.outline_file", "'a,b.csv'", ("a,b.csv",)),
    ],
)
def test_values(key, given, values):
    """Texts, lists, arrays and iterators; whole numbers stay whole."""
    found = axis_of(key, given)
    assert found == values
    assert [*map(type, found)] == [*map(type, values)]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        *((one, rf"`{SPEED}` must have at least one value") for one in (
            [], (), iter(()), np.array([]), 3.0, {1.0: 2.0}, None, np.ones(()),
        )),
        ("", "at least one value"),
        ("1:1:3", "two different"),
        ("1:2:1", "2 to"),
        ("0:2:3:log", "positive"),
        ("1:2,5", "cannot be mixed"),
        ("[1", "not valid YAML"),
        ("1:1e999:3", "finite"),
        ("1:2:-3", "from:to:count"),
        ("1:2:3:4", "from:to:count"),
        ("1:2:3.5", "from:to:count"),
    ],
)  # fmt: skip
def test_wrong_values(given, words):
    with pytest.raises(InputError, match=words):
        axis_of(SPEED, given)


@pytest.mark.parametrize(
    "given",
    [
        range(10**9),
        range(10**30),
        itertools.count(1),
        (x for x in itertools.repeat(1.0)),
        np.broadcast_to(1.0, 10**9),
        "1:2:600,3:4:600",
    ],
    ids=["range", "long range", "count", "generator", "array", "text"],
)
def test_too_many_values_are_refused_before_they_are_made(given, monkeypatch):
    monkeypatch.setattr(plan, "MOST", 1000)
    tracemalloc.start()
    with pytest.raises(InputError, match=rf"`{SPEED}` must have at most 1000 values"):
        axis_of(SPEED, given)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1e6


@pytest.mark.parametrize("text", ["scene.speed_rpm", "=3", "scene..x=1", ".=1"])
def test_wrong_options(text):
    with pytest.raises(InputError, match=r"dotted\.key=values"):
        parse_over(text)
    assert parse_over(" scene.speed_rpm =1,2")[0] == SPEED


def test_levels_cover_an_interval():
    """The ends are reached, on a logarithmic scale and with whole numbers as well."""
    levels = np.array([0.0, 0.5, 1.0])
    assert plan.drawn(axis_of(SPEED, "1:3"), levels) == [1.0, 2.0, 3.0]
    assert plan.drawn(axis_of(SPEED, "1:100:log"), levels) == pytest.approx([1.0, 10.0, 100.0])
    assert plan.drawn(axis_of(SPEED, "a,b,c"), levels) == ["a", "b", "c"]
    even = (np.arange(500) + 0.5) / 500
    counts = np.unique(plan.drawn(axis_of("profile.lobes", "2:6"), even), return_counts=True)
    assert [part.tolist() for part in counts] == [[2, 3, 4, 5, 6], [100] * 5]
