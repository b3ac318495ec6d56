"""Points of a sweep: crossed, zipped, sampled, values as a user writes them, what is refused."""

import itertools
import json
import tracemalloc

import numpy as np
import pytest

from rootsopt import InputError, load_config
from rootsopt.response.scatter import draw
from rootsopt.response.sweeps import plan
from rootsopt.response.sweeps.plan import axis_of, check_values, parse_over, plan_of, scattered

SPEED, LOAD, ANGLE = "scene.speed_rpm", "scene.load.torque_N_m", "profile.pressure_angle_deg"


@pytest.mark.parametrize(
    ("axes", "zipped", "sizes", "points"),
    [
        (
            {SPEED: "1,2", LOAD: [4.0, 5.0]},
            False,
            {SPEED: 2, LOAD: 2},
            [(1, 4.0), (1, 5.0), (2, 4.0), (2, 5.0)],
        ),
        ({SPEED: "1,2", LOAD: [4.0, 5.0]}, True, {"point": 2}, [(1, 4.0), (2, 5.0)]),
        (
            {SPEED: "1,2", ANGLE: "7,8,9", LOAD: "4,5"},
            [[SPEED, LOAD]],
            {"point": 2, ANGLE: 3},
            [(1, 4, 7), (1, 4, 8), (1, 4, 9), (2, 5, 7), (2, 5, 8), (2, 5, 9)],
        ),
        (
            {"a": "1", "b": "2", "c": "3", "d": "4"},
            [["a", "b"], ["d", "c"]],
            {"point_1": 1, "point_2": 1},
            [(1, 2, 3, 4)],
        ),
        # Values of zipped keys may repeat.
        ({SPEED: "1,1,2", LOAD: "3,4,3"}, True, {"point": 3}, [(1, 3), (1, 4), (2, 3)]),
        # For the config to refuse.
        (
            {"profile.lobes": [True, 1, 10**400]},
            False,
            {"profile.lobes": 3},
            [(True,), (1,), (10**400,)],
        ),
    ],
)
def test_keys_are_crossed_or_advance_together(axes, zipped, sizes, points):
    plan = plan_of(axes, zipped=zipped)
    assert {one.name: one.size for one in plan.dimensions} == sizes
    assert (plan.shape, plan.count) == (tuple(sizes.values()), len(points))
    assert {*plan.keys} == {*axes}
    assert [tuple(plan.at(number).values()) for number in range(plan.count)] == points


def test_samples_follow_from_their_seed():
    axes = {SPEED: "300:6000", "profile.family": "cic,ee"}
    for method in ({"sample": 64}, {"sobol": 64}):
        one, same, other = (plan_of(axes, **method, seed=seed) for seed in (1, 1, 2))
        assert one == same != other
        assert (one.count, one.seed, one.dimensions[0].name) == (64, 1, "sample")
        speeds, names = one.dimensions[0].columns.values()
        assert all(300 <= speed <= 6000 for speed in speeds)
        assert abs(names.count("cic") - 32) <= (12 if one.method == "random" else 0)
    assert json.loads(json.dumps(one.record())) == one.record()
    assert {*plan_of({SPEED: "1:3:3"}, sample=9).dimensions[0].columns[SPEED]} <= {1.0, 2.0, 3.0}


def test_sobol_fills_every_part():
    """A sample of 2^m points has one in each of 2^m equal parts of every axis."""
    (column,) = plan_of({SPEED: "0:16"}, sobol=16).dimensions[0].columns.values()
    assert sorted(int(x) for x in column) == list(range(16))
    # Drawn values may repeat.
    assert plan_of({"profile.lobes": "2:3"}, sobol=8).count == 8


@pytest.mark.parametrize(
    ("axes", "options", "words"),
    [
        ({}, {}, "at least one key"),
        ({SPEED: "1:2"}, {}, "needs a number of values, as in 1:2:11"),
        ({SPEED: "1:2"}, {"sobol": 4, "sample": 4}, "exclude each other"),
        ({SPEED: "1:2"}, {"sobol": 4, "zipped": True}, "--zip"),
        ({SPEED: "1:2"}, {"sample": 0}, "from 1 to"),
        ({SPEED: "1:2"}, {"sample": 1, "seed": -1}, "--seed"),
        ({SPEED: "1,2", LOAD: "1,2,3"}, {"zipped": True}, "2, `scene.load.torque_N_m` has 3"),
        ({SPEED: "1,2", LOAD: "1,2"}, {"zipped": [["scene.sped_rpm"]]}, "did you mean"),
        ({SPEED: "1,2"}, {"zipped": [[SPEED], [SPEED]]}, "two groups"),
        ({"scene": [{}], SPEED: "1"}, {}, "is inside `scene`"),
        ({SPEED: "1:2:2000", LOAD: "1:2:2000"}, {}, "at most 1000000 points"),
        ({SPEED: [1, 2, 1.0]}, {}, "`scene.speed_rpm`: values must differ, but 1.0 is given twice"),
        ({"profile.family": "cic,ee,cic"}, {}, "`profile.family`: values must differ, but 'cic'"),
        ({"scene.timing_gear": [None, {"a": 1}, {"a": 1}]}, {}, "`scene.timing_gear`: values"),
        ({SPEED: "1:2:3,1.5"}, {}, "1.5 is given twice"),
        ({SPEED: "1,1", LOAD: "2,2"}, {"zipped": True}, "`scene.load.torque_N_m`: values must"),
        ({"scene.sped_rpm": "1"}, {}, "`scene.sped_rpm` is not a known key; did you mean `scene.s"),
        ({"sped_rpm": "1"}, {}, "did you mean `scene.speed_rpm`"),
        ({"zzz": "1"}, {}, "`zzz` is not a known key; valid here"),
        ({SPEED: "1:2:3,-5"}, {}, "greater than 0 .*-5"),
        ({SPEED: "1,.nan"}, {}, "finite"),
        ({SPEED: "1,true"}, {}, "a number, but is True"),
        ({"profile.lobes": "2:3:3"}, {}, "whole number, but is 2.5"),
        ({"profile.family": "cic,eee"}, {}, "'eee'"),
        ({"scene.timing_gear": "null,{backlash: 1}"}, {}, "timing_gear.backlash"),
    ],
)
def test_wrong_plans(axes, options, words):
    with pytest.raises(InputError, match=words):
        check_values(load_config("cic_drawn"), plan_of(axes, **options))


def test_values_that_only_clash_are_accepted():
    check_values(load_config("cic_drawn"), plan_of({"profile.family": "cic,ee", ANGLE: "5,36"}))


def test_scenes_of_tolerances():
    """Those of the fresh sample, each of which is a config of its own."""
    over = {SPEED: {"uniform": 30.0}, ANGLE: {"normal": 0.01}}
    config = load_config("cic_drawn").replaced({"tolerances": {"over": over}})
    plain, plan = scattered(config, 8)
    assert (plain.tolerances, plan.method, plan.count) == (None, "tolerances", 8)
    columns = plan.dimensions[0].columns.values()
    assert [*map(list, columns)] == draw(config, 8, fresh=True).T.tolist()
    check_values(plain, plan)
    for wrong in ((load_config("cic_drawn"), 8), (config, 0)):
        with pytest.raises(InputError, match="--tolerances"):
            scattered(*wrong)


# Values of one key as a user writes them


@pytest.mark.parametrize(
    ("key", "given", "values"),
    [
        ("scene.timing_gear.backlash_mm", "0.05,0.1, 0.2", (0.05, 0.1, 0.2)),
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
