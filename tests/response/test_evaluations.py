"""Evaluations of a search in real processes: the same results, whatever happens to a process."""

import os
import pickle
import subprocess
import sys
import threading
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import numpy as np
import pytest

from rootsopt import InputError, load_config
from rootsopt.commands.work.searching import runs_of
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import HERE, Point
from rootsopt.response.sweeps import cluster
from rootsopt.response.sweeps.cluster import ClosedError, DaskRunner, Settings, running
from tests.response.test_cluster import IMPORT
from tests.response.workers import DEADLY


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
    assert design.tolist() == [1.0, 1.0, 1.0]
    assert start is None


def test_without_workers_evaluations_run_here():
    with running() as runs:
        assert runs is HERE


def test_the_price_of_workers_is_said_before_they_start(capsys):
    """The context is not entered, so nothing has started yet."""
    runs_of(Namespace(workers=3, scheduler=None, imports=[], no_cache=False))
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
