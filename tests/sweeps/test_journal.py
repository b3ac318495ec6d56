"""The file with the points of a sweep: what is kept, and what is refused."""

import json

import numpy as np
import pytest

import rootsopt
from rootsopt.config import load
from rootsopt.errors import InputError
from rootsopt.status import Status
from rootsopt.sweeps import points
from rootsopt.sweeps.journal import Journal, read
from rootsopt.sweeps.plan import plan_of
from rootsopt.sweeps.points import lost
from rootsopt.sweeps.scenes import header

ROW = lost(Status.INVALID) | {"response": {"mean_force_N": 0.1 + 0.2, "peak_force_N": float("nan")}}
SPEED = "scene.speed_rpm"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "points"


def filled(path, numbers=(3, 1)):
    journal = Journal(path, {"a": 1})
    for number in numbers:
        journal.add([(number, ROW)])
    journal.close()
    return path.read_bytes()


def test_points_come_back_exactly(path):
    filled(path)
    journal = Journal(path, {"a": 1}, resume=True)
    assert [*journal.rows] == [3, 1]
    assert journal.rows[3]["response"]["mean_force_N"] == 0.1 + 0.2
    assert np.isnan(journal.rows[3]["response"]["peak_force_N"])
    journal.add([(3, lost(Status.FAILED)), (2, ROW)])
    journal.close()
    found = read(path)[1]
    assert [*found] == [3, 1, 2]
    assert found[3]["status"] == "invalid"  # The first record of a point counts.
    assert len(path.read_bytes().splitlines()) == 4


def test_every_cut_leaves_a_file_to_go_on_with(path):
    """As a kill at any byte would."""
    data = filled(path)
    ends = [k + 1 for k, byte in enumerate(data) if byte == ord("\n")]
    for size in (0, 3, *(end + d for end in ends for d in (-1, 0, 1) if end + d <= len(data))):
        path.write_bytes(data[:size])
        journal = Journal(path, {"a": 1}, resume=True)
        assert len(journal.rows) == max(0, sum(end <= size for end in ends) - 1)
        journal.add([(7, ROW)])
        journal.close()
        assert 7 in read(path)[1]


@pytest.mark.parametrize("junk", [b"{}\n", b"[1]\n", b'{"number": 1}\n', b"\xff\n", b"null\n"])
def test_junk_ends_the_file(path, junk):
    data = filled(path)
    path.write_bytes(data + junk)
    header, rows, kept = read(path)
    assert (header, [*rows], kept) == ({"a": 1}, [3, 1], len(data))


def test_a_file_without_points_is_not_left_behind(path):
    Journal(path, {"a": 1}).close()
    assert not path.exists()


def test_what_differs_is_named(path):
    config, plan = load("cic"), plan_of({SPEED: "1,2"})
    journal = Journal(path, header(config, plan))
    journal.add([(0, ROW)])
    journal.close()
    before = path.read_bytes()
    others = {
        "config: scene: load: torque_N_m": (config.replaced({"scene.load.torque_N_m": 9.0}), plan),
        "scene.speed_rpm .then .1, 2., now .1, 3.": (config, plan_of({SPEED: "1,3"})),
        "method": (config, plan_of({SPEED: "1,2"}, sobol=2)),
    }
    for words, changed in others.items():
        with pytest.raises(InputError, match=words):
            Journal(path, header(*changed), resume=True)
    old = header(config, plan)
    old["versions"]["jax"] = "0.0.1"
    with pytest.raises(InputError, match=r"versions: jax \(then"):
        Journal(path, old, resume=True)
    assert path.read_bytes() == before
    with pytest.raises(InputError, match="there is no"):
        Journal(path.with_name("absent"), {}, resume=True)


def test_sweep_goes_on_where_it_stopped(path, monkeypatch):
    """Each point is simulated once, and the dataset is that of an uninterrupted sweep."""
    asked = []

    def check(config):
        asked.append(config.scene.speed_rpm)
        if len(asked) == 3:
            raise KeyboardInterrupt
        raise InputError("no")

    monkeypatch.setattr(points, "check_geometry", check)
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    config, axes = load("cic"), {SPEED: "1,2,3,4,5"}
    with pytest.raises(KeyboardInterrupt):
        rootsopt.sweep_scenes(config, axes, checkpoint=path)
    done = len(read(path)[1])
    assert 1 <= done <= 3
    found = rootsopt.sweep_scenes(config, axes, checkpoint=path, resume=True)
    assert found.identical(rootsopt.sweep_scenes(config, axes))
    numbers = [json.loads(line)["number"] for line in path.read_text().splitlines()[1:]]
    assert sorted(numbers) == [0, 1, 2, 3, 4]
