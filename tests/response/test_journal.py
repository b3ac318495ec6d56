"""The file with the results of a run: what is kept, dropped and refused."""

import dataclasses
import json
import random
import types
from unittest import mock

import numpy as np
import pytest

from rootsopt import InputError, Status, load_config
from rootsopt.dynamics.maxima import Maxima
from rootsopt.optimize.tradeoffs.study import Study
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.journal import (
    Checkpoint,
    Journal,
    _line,
    header_of,
    plain_evaluation,
    set_aside,
)
from rootsopt.response.reducers import Point
from rootsopt.response.result import Part
from rootsopt.response.sweeps.plan import plan_of
from rootsopt.response.sweeps.points import lost
from rootsopt.response.sweeps.scenes import Points
from tests.optimize.test_optimize import evaluation

ROW = lost(Status.INVALID) | {"response": {"mean_force_N": 0.1 + 0.2, "peak_force_N": float("nan")}}
SPEED = "scene.speed_rpm"
PLAN = plan_of({SPEED: "1,2,3,4,5,6,7,8"})
CIC = load_config("cic_drawn")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "points"


def sweep(path, resume=False, plan=PLAN):
    return Points(CIC, plan, (), path, resume)


def search(path, resume=False):
    return Checkpoint({"a": 1}, path, resume)


def rows_of(kind):
    """Return results as a run would add them."""
    if kind is sweep:
        return [(k, ROW | {"message": f"row {k}"}) for k in (3, 1, 0, 7, 5, 6)]
    parts = tuple(Part({"speed_rpm": x}, evaluation(x / 7), 0.5) for x in (1000.0, 2000.0))
    several = dataclasses.replace(parts[0].evaluation, speeds=parts)
    maxima = Maxima(np.array([0.1]), np.array([1 / 3]), np.array([[2 / 3]]))
    corner = dataclasses.replace(evaluation(0.5), maxima=maxima, rivals=(evaluation(0.25),))
    every = [evaluation(0.1), several, corner, evaluation(float("nan"))]
    keys = [(0, 3), (-1, 2), ("search", "0123"), (1, 0)]
    return [(key, ([0.1 * k], one)) for k, (key, one) in enumerate(zip(keys, every, strict=True))]


def texts(journal):
    """Return all results as text, which preserves every bit."""
    return {key: json.dumps(journal.plain(one)) for key, one in journal.rows.items()}


def filled(path, kind=sweep):
    journal = kind(path)
    for row in rows_of(kind):
        journal.add([row])
    journal.close()
    return path.read_bytes()


@pytest.mark.parametrize("kind", [sweep, search])
def test_results_come_back_exactly(path, kind):
    data, rows = filled(path, kind), rows_of(kind)
    journal = kind(path, resume=True)
    assert [*texts(journal).items()] == [(k, json.dumps(journal.plain(one))) for k, one in rows]
    assert (journal.dropped, journal.damage) == (0, "")
    journal.add([(rows[0][0], rows[1][1])])  # The first result of a key counts.
    journal.close()
    assert path.read_bytes() == data


def damaged(data, chance):
    """Return the content of a file after one to three damages, as any of them may happen."""
    for _ in range(chance.randint(1, 3)):
        lines, place = data.split(b"\n"), chance.randrange(max(1, len(data)))
        one, other = sorted(chance.randrange(len(lines)) for _ in range(2))
        before, line, after = lines[:one], lines[one], lines[one + 1 :]
        odd = [b"{}", b"[1]", b"null", b"\xff", b"NaN", b"[" * 9999, b"1 2"]
        bit, many = 1 << chance.randrange(8), chance.choice([1, 9])
        data = chance.choice([
            bytes(x ^ bit * (0 <= k - place < many) for k, x in enumerate(data)),
            data[:place],
            data[:place] + data[place + chance.randint(1, 90) :],
            *map(b"\n".join, (
                [*lines[:one], *lines[one:other + 1][::-1], *lines[other + 1 :]],
                [*lines[:other], line, *lines[other:]],
                [*before, *after],
                [*before, chance.choice(odd), *after],
                [*before, line.replace(b"[3, ", b"[99, ").replace(b"0.3", b"NaN"), *after],
            )),
        ])  # fmt: skip
    return data


@pytest.mark.parametrize("kind", [sweep, search])
def test_damage_costs_results_but_never_changes_them(path, kind):
    """No error, no changed result; the same file as without damage once the rest is added again."""
    data, chance = filled(path, kind), random.Random(5)
    whole, known = sorted(data.splitlines()), texts(kind(path, resume=True))
    counts = []
    for _ in range(100):
        path.write_bytes(damaged(data, chance))
        journal = kind(path, resume=True)
        assert texts(journal).items() <= known.items()
        assert bool(journal.dropped) == bool(journal.damage)
        counts.append((len(journal.rows), journal.dropped > 0))
        journal.add(rows_of(kind))
        journal.close()
        assert sorted(path.read_bytes().splitlines()) == whole
    kept, dropped = np.mean(counts, axis=0)
    assert dropped > 0.5
    assert kept > 0.5 * len(known)


def appended(path, kind, rows):
    """Return the journal of a file with more `rows`, all of which must be dropped."""
    data = filled(path, kind)
    path.write_bytes(data + b"".join(_line([*row], data.split(b" ")[0]) for row in rows))
    journal = kind(path, resume=True)
    assert (len(journal.rows), journal.dropped) == (len(rows_of(kind)), len(rows))
    return journal


def test_results_of_the_wrong_type_are_dropped(path):
    """Although their checksum is right, as after a mistake of the program that wrote them."""
    plain = plain_evaluation(evaluation(0.5))
    wrong = [
        (99, ROW), (-1, ROW), ("1", ROW), (None, ROW), ([], ROW), ({}, ROW),
        (2, None), (2, []), (2, {}), (2, ROW | {"status": "well"}), (2, ROW | {"more": 1}),
        (2, ROW | {"response": {"mean_force_N": "1"}}), (2, ROW | {"gradient": {"a": 1.0}}),
    ]  # fmt: skip
    assert f"{len(wrong)} lines are damaged" in appended(path, sweep, wrong).damage
    wrong = [
        plain | {"status": "WELL"}, plain | {"start": "a"}, plain | {"start": [[1.0], [1.0, 2.0]]},
        plain | {"start": {"state": [0.0]}}, plain | {"start": {"state": [0.0], "orbit": [1]}},
        *(plain | {"start": {"state": [0.0], "orbit": [one]}} for one in (
            ["float64", [2], "AAAA"], ["object", [1], "AAAAAAAAAAA="], ["float64", [1], "?"],
        )),
        plain | {"maxima": [[1.0], [2.0]]}, plain | {"maxima": [[1.0], [2.0], [1.0, 2.0, 3.0]]},
        plain | {"response": {"a": None}}, plain | {"design": []}, plain | {"more": 1},
        plain | {"rivals": [1]}, plain | {"parts": [[1.0]]}, {}, None, plain | {"message": 1},
    ]  # fmt: skip
    rows = [([5, k], [[0.5], one]) for k, one in enumerate(wrong)]
    appended(path, search, [*rows, ([5, 98], [["a"], plain]), (5, [[0.5], plain])])


def test_an_evaluation_is_known_by_its_stage_point_and_start(path):
    """This holds for a front. What a file holds under a key for another point does not count."""
    asked, one, study = [], Evaluator.of(CIC), object.__new__(Study)

    def run(point):
        asked.append(point)
        return evaluation(point.design[0] if point.start is None else point.start[0])

    doubling = types.SimpleNamespace(design=lambda point: 2 * point)
    vars(study).update(problem=doubling, runs=types.SimpleNamespace(evaluated=run))
    point, start = np.array([0.5]), np.array([0.25, 1.0])
    tasks = [("search", None), ("search", start), ("search", 2 * start), ("verification", None)]
    numbers = []
    for resume in (False, True):
        vars(study)["checkpoint"] = journal = search(path, resume)
        found = [study._simulated(stage, one, point, begun) for stage, begun in tasks]
        numbers.append([each.response["mean_force_N"] for each in found])
        journal.close()
        assert len(asked) == 4
    assert numbers[0] == numbers[1] == [1 / 3, 0.25 / 3, 0.5 / 3, 1 / 3]
    vars(study)["checkpoint"] = journal = search(path, resume=True)
    study._simulated("search", one, point + 0.25)
    assert len(asked) == 5
    journal.evaluated(run, min(journal.resumed), Point(one, point), point + 0.25)
    assert len(asked) == 6


def test_a_line_of_another_run_is_dropped(path):
    """A row of another plan could have the same number."""
    other = path.with_name("other")
    sweep(other, plan=plan_of({SPEED: "1,2,3,4,5,6,7,9"})).add([(2, ROW)])
    path.write_bytes(filled(path) + other.read_bytes().splitlines(keepends=True)[1])
    told = "1 line is damaged or of another run, and dropped; 6 results are kept"
    assert told in sweep(path, resume=True).damage


def test_a_run_that_does_not_resume_keeps_the_older_file(path):
    """A file without results is removed when it is closed. One with results gets another name."""
    sweep(path).close()
    assert not [*path.parent.iterdir()]
    assert set_aside(path) is None
    data, older = filled(path), path.with_name("points.old")
    assert set_aside(path) == older
    assert older.read_bytes() == data


def test_a_full_disk_does_not_end_the_run(path):
    journal = sweep(path)
    with mock.patch("os.fsync", side_effect=OSError(28, "No space left on device")):
        journal.add([(1, ROW)])
    journal.add([(2, ROW)])
    assert [*journal.rows] == [1, 2]
    journal.close()
    journal.add([(3, ROW)])  # A search that was stopped may still finish an evaluation.
    assert [*sweep(path, resume=True).rows] == [1, 2]


def test_what_differs_is_named(path, tmp_path):
    plan = plan_of({SPEED: "1,2"})
    rotor = tmp_path / "rotor.csv"
    rotor.write_text("1,2")
    files = {"imports": [], "others": [str(rotor), None]}
    head = header_of("sweep", CIC, **files, sweep=plan.record())
    Journal(head, path).add([(0, ROW)])
    before = path.read_bytes()
    slower = CIC.replaced({"scene.load.torque_N_m": 9.0})
    rotor.write_text("1,3")
    others = {
        "config: scene: load: torque_N_m": header_of("sweep", slower, **files, sweep=plan.record()),
        "scene.speed_rpm .then .1, 2., now .1.0, 3.0.": header_of(
            "sweep", CIC, **files, sweep=plan_of({SPEED: [1.0, 3.0]}).record()
        ),
        r"command \(then 'sweep', now 'pareto'": header_of("pareto", CIC, **files),
        r"versions: jax \(then": head | {"versions": head["versions"] | {"jax": "0.0.1"}},
        r"files: .*rotor\.csv \(then '": header_of("sweep", CIC, **files, sweep=plan.record()),
    }
    for words, changed in others.items():
        with pytest.raises(InputError, match=words):
            Journal(changed, path, resume=True)
    assert path.read_bytes() == before
    with pytest.raises(InputError, match="there is no"):
        Journal({}, path.with_name("absent"), resume=True)
    with pytest.raises(InputError, match="cannot be read"):
        header_of("sweep", CIC, others=[str(tmp_path / "absent.csv")])
