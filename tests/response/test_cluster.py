"""Sweeps over real processes: nothing is lost or duplicated if one of them is killed."""

import pickle
import signal
import sys
from pathlib import Path

import psutil
import pytest

import rootsopt
from rootsopt.config import load
from rootsopt.errors import InputError
from rootsopt.response.sweeps import cluster
from rootsopt.response.sweeps.cluster import running
from rootsopt.response.sweeps.plan import plan_of
from rootsopt.response.sweeps.scenes import Points, complete
from tests.response.workers import DEADLY

IMPORT = str(Path(__file__).with_name("workers.py"))
SPEED = "scene.speed_rpm"


def kill_a_worker() -> None:
    """Kill one of the processes that a cluster has started, if there is one."""
    for child in psutil.Process().children(recursive=True):
        if "spawn_main" in " ".join(child.cmdline()):
            child.send_signal(signal.SIGKILL)
            return


def swept(path, plan, after=0):
    """Sweep with two workers, and kill one after the first `after` points; return the journal."""
    config, killed = load("cic_drawn"), []

    def progress(done, expected):
        if after and done >= after and not killed:
            killed.append(done)
            kill_a_worker()

    journal = Points(config, plan, (), path)
    with running(2, imports=(IMPORT,)) as runs:
        complete(config, plan, runs, journal, progress)
    journal.close()
    assert bool(killed) == bool(after)
    return Points(config, plan, (), path, resume=True).rows


def test_a_killed_worker_loses_and_duplicates_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("TEST_SECONDS", "0.1")
    plan = plan_of({SPEED: "100:2000:20"})
    rows = swept(tmp_path / "points", plan, after=4)
    assert sorted(rows) == [*range(20)]
    assert len((tmp_path / "points").read_bytes().splitlines()) == 1 + 20
    for number, row in rows.items():
        assert row["message"].endswith(f"at {100 * (number + 1)}")
    left = psutil.Process().children(recursive=True)
    assert not any("spawn_main" in " ".join(one.cmdline()) for one in left)


@pytest.mark.long
def test_a_point_that_kills_its_process_is_a_status(tmp_path, monkeypatch):
    monkeypatch.setenv("TEST_SECONDS", "0.01")
    plan = plan_of({SPEED: f"100,200,{DEADLY},300,400,500"})
    rows = swept(tmp_path / "points", plan)
    statuses = [rows[number]["status"] for number in range(6)]
    assert statuses == ["invalid", "invalid", "failed", "invalid", "invalid", "invalid"]
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
            rootsopt.sweep_scenes(load("cic_drawn"), {SPEED: "1,2"}, **options)


@pytest.mark.parametrize(
    ("workers", "scheduler", "words"),
    [(0, None, "from 1 to"), (2, "tcp://127.0.0.1:1", "exclude each other")],
)
def test_wrong_clusters(workers, scheduler, words):
    with pytest.raises(InputError, match=words), running(workers, scheduler):
        pass


def test_scheduler_that_is_none(monkeypatch):
    monkeypatch.setattr("rootsopt.response.sweeps.cluster._ANSWER", 0.3)
    for address in ("tcp://127.0.0.1:9", "nonsense://x"):
        with pytest.raises(InputError, match=rf"'{address}' cannot be used"):
            rootsopt.sweep_scenes(load("cic_drawn"), {SPEED: "1,2"}, scheduler=address)
