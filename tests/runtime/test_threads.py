"""Work divided among threads: results do not depend on the number of cores."""

import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import rootsopt
from rootsopt.config import load
from rootsopt.errors import InputError
from rootsopt.optimize import design
from rootsopt.runtime.environment import own_process
from rootsopt.runtime.programs import CachedFunction
from rootsopt.runtime.threads import on_all_cores, one_thread
from tests.standins import ROOT, refusal


def counts():
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


@CachedFunction
def mixed(rows, shift):
    return jnp.exp(rows) * 2, jnp.sum(jnp.sin(rows), axis=-1) + shift


def test_work_is_divided_among_the_cores(monkeypatch):
    """Every row is computed once and returned in its place, with the same bits on 1 to 16 cores."""
    rng = np.random.default_rng(0)
    for count in (1, 5):
        rows, shift = jnp.asarray(rng.normal(size=(count, 300))), jnp.arange(float(count))
        bits = set()
        for cores in (1, 2, 16):
            monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
            found = on_all_cores(mixed, rows, shift)
            bits.add(tuple(np.asarray(x).tobytes() for x in found))
        np.testing.assert_allclose(found[0], 2 * np.exp(rows))
        np.testing.assert_allclose(found[1], np.sum(np.sin(rows), axis=1) + np.arange(count))
        assert len(bits) == 1


def test_overlapping_contexts_keep_one_thread_to_the_end():
    """A context that ends early does not return the threads that another one has set aside."""
    inside, ending = threading.Event(), threading.Event()

    @one_thread
    def other():
        inside.set()
        ending.wait(10)
        return counts()

    with threadpool_limits(2), ThreadPoolExecutor(1) as pool:
        with one_thread:
            found = pool.submit(other)
            inside.wait(10)
        assert counts() == {1}
        ending.set()
        assert found.result(10) == {1}
    with threadpool_limits(2):
        with one_thread, one_thread:
            assert counts() == {1}
        assert counts() == {2}


@pytest.mark.parametrize(
    ("search", "run"),
    [("search_of", rootsopt.optimize_design), ("Tracer", rootsopt.pareto_front)],
)
def test_searches_from_python_use_one_thread_and_restore_the_others(monkeypatch, search, run):
    seen = []

    def made(*_, **__):
        seen.append(counts())
        raise InputError("enough")

    monkeypatch.setattr(design, search, made)
    with threadpool_limits(2):
        assert refusal(run, load("cic_drawn")) == "enough"
        assert [*seen, counts()] == [{1}, {2}]


def test_commands_use_one_thread_whatever_the_user_has_set(monkeypatch):
    """In libraries that are loaded already, and in those that are loaded later."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "16")
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with threadpool_limits(2):
        own_process()
        assert counts() == {1}
    script = (
        "import scipy.linalg, threadpoolctl as t; "
        "print({x['num_threads'] for x in t.threadpool_info()})"
    )
    assert subprocess.check_output([sys.executable, "-c", script], text=True) == "{1}\n"


# Runs a console command; its first argument is the number of cores that Python reports.
FAKED = """
import os, sys
cores = int(sys.argv.pop(1))
os.cpu_count = lambda: cores
from rootsopt.commands.console import main
sys.exit(main())
"""
RUNS = {
    "optimize": ["optimizer.screening=4", "optimizer.starts=2", "optimizer.iterations=12"],
    "pareto": ["optimizer.screening=4", "pareto.points=3", "optimizer.iterations=6"],
    "attractors": ["scene.timing_gear.backlash_mm=0.2"],
    "simulate": ["solver.accuracy=1e-7"],
}


@pytest.mark.long
@pytest.mark.parametrize("command", RUNS)
def test_a_run_has_the_same_bits_on_1_2_and_16_cores(tmp_path, command):
    """Compiled on each of them, with as many threads of XLA and of dense algebra."""
    files = []
    for cores in ("1", "2", "16"):
        out = tmp_path / cores
        arguments = [command, "cic_drawn", "-o", str(out), "--no-figures", "--no-cache"]
        arguments += [part for text in RUNS[command] for part in ("--set", text)]
        own = {"NPROC": cores, "OPENBLAS_NUM_THREADS": cores, "OMP_NUM_THREADS": cores}
        faked = [sys.executable, "-c", FAKED, cores, *arguments]
        assert subprocess.run(faked, cwd=ROOT, env=os.environ | own, check=False).returncode in (
            0,
            3,
        )
        found = {file.name: file.read_bytes() for file in out.glob("*.csv")}
        files.append((found, without_times(json.loads((out / "result.json").read_bytes()))))
    assert files[0][0]
    assert files[0] == files[1] == files[2]


def without_times(tree):
    if isinstance(tree, dict):
        return {k: without_times(v) for k, v in tree.items() if "seconds" not in k}
    return [*map(without_times, tree)] if isinstance(tree, list) else tree
