"""Many evaluations, here and in real processes: nothing is lost or duplicated if one is killed."""

import os
import pickle
import subprocess
import sys
import threading
import time
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest import mock

import numpy as np
import psutil
import pytest

import rootsopt
from rootsopt import InputError, load_config
from rootsopt.commands.work.searching import runs_of
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import HERE, IN_TURN, LocalRunner, Point, as_done, evaluate_many
from rootsopt.response.sweeps import cluster
from rootsopt.response.sweeps.cluster import ClosedError, DaskRunner, Settings, running
from rootsopt.response.sweeps.plan import plan_of
from rootsopt.response.sweeps.scenes import Points, complete
from tests.response.workers import DEADLY
from tests.standins import evaluation_of

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
    expected = dict.fromkeys(range(6), "invalid") | {2: "failed"}
    assert {number: row["status"] for number, row in rows.items()} == expected
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


# Evaluations of a search: the same results, whatever happens to a process


@pytest.mark.long
def test_a_design_that_kills_its_process_ends_the_search(monkeypatch):
    monkeypatch.setenv("TEST_SECONDS", "0.01")
    evaluator = Evaluator.of(load_config("cic_drawn", [f"scene.speed_rpm={DEADLY}"]))
    with (
        running(1, imports=(IMPORT,)) as runs,
        pytest.raises(InputError, match=r"several times.*--resume"),
    ):
        runs.evaluated(Point(evaluator, np.ones(3)))


def point():
    return Point(Evaluator.of(load_config("cic_drawn")), np.ones(3))


def runs_of_silence(status="running", threads=(2, 1)):
    """Return (runner, its client): a client of Dask whose workers never answer."""
    client = mock.Mock(status=status)
    client.nthreads.return_value = dict(enumerate(threads))
    return DaskRunner(None, client, Settings(())), client


def test_threads_that_wait_end_with_the_search(monkeypatch):
    monkeypatch.setattr(cluster, "_POLL", 0.01)
    (runs, client), asked = runs_of_silence(), threading.Event()
    client.submit.return_value.add_done_callback = lambda call: asked.set()
    assert runs.slots == 6
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(runs.evaluated, point())
        assert asked.wait(10)
        runs.close()
        with pytest.raises(ClosedError):
            waiting.result(10)
    client.submit.return_value.cancel.assert_called()
    with pytest.raises(ClosedError):
        runs.evaluated(point())


@pytest.mark.parametrize(
    ("status", "threads", "words"),
    [
        ("closed", (2, 1), "connection to the scheduler was lost"),
        ("running", (), r"no worker for 0\.05 s"),
    ],
)
def test_a_scheduler_that_does_not_work_is_given_up(monkeypatch, status, threads, words):
    monkeypatch.setattr(cluster, "_POLL", 0.01)
    monkeypatch.setattr(cluster, "_DESERTED", 0.05)
    with pytest.raises(InputError, match=words):
        runs_of_silence(status, threads)[0].evaluated(point())


@pytest.mark.parametrize("motion", ["reached", "worst", "ensemble"])
def test_every_evaluator_travels(motion):
    sent = Evaluator.of_objective(load_config("cic_drawn", [f"objective.motion={motion}"]))
    found = pickle.loads(pickle.dumps(sent))
    assert (type(found), found.config) == (type(sent), sent.config)
    assert float(found.scene.speed) == float(sent.scene.speed)


def test_classes_of_a_script_travel(tmp_path):
    """A contact law that a script defines is part of its scene, and unknown to another process."""
    script, task = tmp_path / "script.py", tmp_path / "task"
    script.write_text(
        "import sys\n"
        "from rootsopt.runtime import environment\n"
        "environment.use_float64()\n"
        "import numpy as np\n"
        "from rootsopt.config import load\n"
        "from rootsopt.response.evaluation import Evaluator\n"
        "from rootsopt.response.reducers import Point\n"
        "from rootsopt.response.sweeps.cluster import DaskRunner, Settings\n"
        "class Own(Evaluator):\n"
        "    answer = 42\n"
        "config = load('cic_drawn')\n"
        "own = Own(config, Evaluator.of(config).scene)\n"
        "class Client:\n"
        "    status = 'running'\n"
        "    def submit(self, function, settings, task, pure):\n"
        f"        open({str(task)!r}, 'wb').write(task)\n"
        "        sys.exit(0)\n"
        "DaskRunner(None, Client(), Settings(())).evaluated(Point(own, np.ones(3)))\n"
    )
    subprocess.run([sys.executable, str(script)], check=True, env={**os.environ, "PYTHONPATH": "."})
    _, (evaluator, design, start, _) = pickle.loads(task.read_bytes())
    assert type(evaluator).answer == 42
    assert (design.tolist(), start) == ([1.0, 1.0, 1.0], None)


def test_the_price_of_workers_is_said_before_they_start(capsys):
    """Without workers, evaluations run here, and nothing is said."""
    options = {"scheduler": None, "imports": [], "no_cache": False}
    with runs_of(Namespace(workers=None, **options)) as runs:
        assert runs is HERE
    assert capsys.readouterr().err == ""
    # The context is not entered, so nothing has started yet.
    runs_of(Namespace(workers=3, **options))
    assert "are no faster than this process" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "options", "file"),
    [
        ("optimize", ["optimizer.screening=4", "optimizer.starts=2"], "history.csv"),
        ("pareto", ["pareto.points=3", "pareto.refinements=0"], "front.csv"),
        (
            "optimize",
            [
                "tolerances={over: {scene.speed_rpm: {normal: 30}}, samples: 4, check_samples: 8}",
                "optimizer.screening=4",
                "optimizer.starts=1",
            ],
            "tolerances.csv",
        ),
    ],
    ids=["starts", "points of a front", "samples"],
)
def test_workers_find_the_same_to_the_last_bit(command, options, file, tmp_path):
    sets = [part for option in options for part in ("--set", option)]
    for name, more in (("here", []), ("there", ["--workers", "2"])):
        run = [sys.executable, "-m", "rootsopt", command, "configs/cic_drawn.yaml", *sets, *more]
        subprocess.run([*run, "--no-figures", "-o", str(tmp_path / name)], check=True)
    here, there = ((tmp_path / name / file).read_bytes() for name in ("here", "there"))
    assert here == there


# Many points: their order, their errors, and when each begins


def late(number, *_):
    """Stand in for an evaluator that takes the longer the earlier it is asked."""
    time.sleep(0.02 / (1 + number))
    return evaluation_of(float(number))


@pytest.mark.parametrize("runs", [IN_TURN, LocalRunner(3)])
def test_results_are_in_the_order_of_the_points(runs):
    done = []
    found = evaluate_many([Point(late, number) for number in range(7)], runs, done.append)
    assert [one.response["mean_force_N"] for one in found] == [*range(7)]
    assert done == [*range(1, 8)]
    assert evaluate_many([], runs) == []


@pytest.mark.parametrize("slots", [1, 3])
def test_points_are_taken_when_they_can_begin(slots):
    """No more are under way than can run, and an iterator that ends leaves out the rest.

    An error is raised and ends the rest."""
    taken, running, counts = [], set(), []

    def work(item):
        if item == 8:
            raise ArithmeticError(item)
        running.add(item)
        counts.append(len(running))
        time.sleep(0.005)
        running.remove(item)
        return -item

    def items(count):
        for number in range(count):
            assert len(running) < slots
            taken.append(number)
            yield number

    found = as_done(work, items(8), slots)
    assert taken == []
    assert sorted(found) == [(k, -k) for k in range(8)]
    assert max(counts) == slots
    taken.clear()
    with pytest.raises(ArithmeticError):
        [*as_done(work, items(100), slots)]
    assert len(taken) <= 8 + 2 * slots
