"""Points of a sweep: crossed, zipped, sampled, and what is refused."""

import json

import pytest

from rootsopt import InputError, load_config
from rootsopt.response.scatter import draw
from rootsopt.response.sweeps.plan import check_values, plan_of, scattered

SPEED, LOAD, ANGLE = "scene.speed_rpm", "scene.load.torque_N_m", "profile.pressure_angle_deg"


@pytest.mark.parametrize(
    ("zipped", "shape", "values"),
    [
        (False, (2, 2), [(1, 4.0), (1, 5.0), (2, 4.0), (2, 5.0)]),
        (True, (2,), [(1, 4.0), (2, 5.0)]),
    ],
)
def test_keys_are_crossed_or_advance_together(zipped, shape, values):
    plan = plan_of({SPEED: "1,2", LOAD: [4.0, 5.0]}, zipped=zipped)
    assert (plan.shape, plan.count, plan.keys) == (shape, len(values), (SPEED, LOAD))
    assert [tuple(plan.at(number).values()) for number in range(plan.count)] == values


def test_groups_of_keys_advance_together():
    part = plan_of({SPEED: "1,2", ANGLE: "7,8,9", LOAD: "4,5"}, zipped=[[SPEED, LOAD]])
    assert part.shape == (2, 3)
    assert [one.name for one in part.dimensions] == ["point", ANGLE]
    assert part.at(4) == {SPEED: 2, LOAD: 5, ANGLE: 8}
    pairs = plan_of({"a": "1", "b": "2", "c": "3", "d": "4"}, zipped=[["a", "b"], ["d", "c"]])
    assert [one.name for one in pairs.dimensions] == ["point_1", "point_2"]


def test_values_of_zipped_and_drawn_keys_may_repeat():
    assert plan_of({SPEED: "1,1,2", LOAD: "3,4,3"}, zipped=True).count == 3
    assert plan_of({"profile.lobes": "2:3"}, sobol=8).count == 8
    assert plan_of({"profile.lobes": [True, 1, 10**400]}).count == 3  # for the config to refuse


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
    chosen = plan_of({SPEED: "1:3:3"}, sample=9).dimensions[0].columns[SPEED]
    assert {*chosen} <= {1.0, 2.0, 3.0}


def test_sobol_fills_every_part():
    """A sample of 2^m points has one in each of 2^m equal parts of every axis."""
    (column,) = plan_of({SPEED: "0:16"}, sobol=16).dimensions[0].columns.values()
    assert sorted(int(x) for x in column) == list(range(16))


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
    columns = [*map(list, plan.dimensions[0].columns.values())]
    assert columns == draw(config, 8, fresh=True).T.tolist()
    check_values(plain, plan)
    for wrong in ((load_config("cic_drawn"), 8), (config, 0)):
        with pytest.raises(InputError, match="--tolerances"):
            scattered(*wrong)
