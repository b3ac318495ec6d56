"""Sweeps over real processes: nothing is lost or duplicated if one of them is killed."""

import pickle
import sys
from pathlib import Path

import psutil
import pytest

import rootsopt
from rootsopt import InputError, load_config
from rootsopt.response.sweeps import cluster
from rootsopt.response.sweeps.cluster import running
from rootsopt.response.sweeps.plan import plan_of
from rootsopt.response.sweeps.scenes import Points, complete
from tests.response.workers import DEADLY

IMPORT = str(Path(__file__).with_name("workers.py"))
SPEED = "scene.speed_rpm"


def spawned():
    """Return the processes that a cluster has started."""
    every = psutil.Process().children(recursive=True)
    return [one for one in every if "spawn_main" in " ".join(one.cmdline())]


def swept(path, plan, after=0):
    """Sweep with two workers, and kill one after the first `after` points; return the journal."""
    config, killed = load_config("cic_drawn"), []

    def progress(done, expected):
        if after and done >= after and not killed:
            killed.append(done)
            spawned()[0].kill()

    journal = Points(config, plan, (), path)
    with running(2, imports=(IMPORT,)) as runs:
        complete(config, plan, runs, journal, progress)
    journal.close()
    assert bool(killed) == bool(after)
    return Points(config, plan, (), path, resume=True).rows


def test_a_killed_worker_loses_and_duplicates_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("TEST_SECONDS", "0.1")
    rows = swept(tmp_path / "points", plan_of({SPEED: "100:2000:20"}), after=4)
    found = sorted((number, row["message"].rpartition("at ")[2]) for number, row in rows.items())
    assert found == [(number, str(100 * (number + 1))) for number in range(20)]
    assert len((tmp_path / "points").read_bytes().splitlines()) == 1 + 20
    assert spawned() == []


@pytest.mark.long
def test_a_point_that_kills_its_process_is_a_status(tmp_path, monkeypatch):
    monkeypatch.setenv("TEST_SECONDS", "0.01")
    rows = swept(tmp_path / "points", plan_of({SPEED: f"100,200,{DEADLY},300,400,500"}))
    statuses = {number: row["status"] for number, row in rows.items()}
    assert statuses == dict.fromkeys(range(6), "invalid") | {2: "failed"}
    assert "may need more memory" in rows[2]["message"]


def test_workers_of_other_versions_are_refused():
    with pytest.raises(InputError, match=r"jax .* instead of 0\.0\.1") as caught:
        cluster.work(cluster.Settings((("jax", "0.0.1"),)), b"")
    # It reaches the process that asks.
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    for options in ({"workers": 2}, {"scheduler": "tcp://127.0.0.1:1"}):
        with pytest.raises(InputError, match=r"pip install 'rootsopt\[cluster\]'"):
            rootsopt.sweep_scenes(load_config("cic_drawn"), {SPEED: "1,2"}, **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"workers": 0}, "from 1 to"),
        ({"workers": 2, "scheduler": "tcp://127.0.0.1:1"}, "exclude each other"),
        ({"scheduler": "tcp://127.0.0.1:9"}, "'tcp://127.0.0.1:9' cannot be used"),
        ({"scheduler": "nonsense://x"}, "'nonsense://x' cannot be used"),
    ],
)
def test_wrong_clusters(monkeypatch, options, words):
    monkeypatch.setattr("rootsopt.response.sweeps.cluster._ANSWER", 0.3)
    with pytest.raises(InputError, match=words):
        rootsopt.sweep_scenes(load_config("cic_drawn"), {SPEED: "1,2"}, **options)
