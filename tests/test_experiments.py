"""The experiments run, write their files, and give sane numbers; with `--quick` throughout."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba")

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """Environment in which both scripts keep their compiled programs in one place."""
    return os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("programs")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


def run(script, folder, environment):
    """Run an experiment; its standard output."""
    command = [sys.executable, f"experiments/{script}.py", "--quick", "-o", str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def numbers(rows, key):
    return [float(row[key]) for row in rows]


def is_picture(path: Path):
    return path.read_bytes()[:4] == PNG


def test_work_precision(tmp_path, programs):
    """Errors fall with the tolerance; a longer smoothing has a greater bias."""
    run("work_precision", tmp_path, programs)
    rows = rows_of(tmp_path / "work_precision.csv")
    assert {row["status"] for row in rows} == {"periodic"}
    for key in ("mean_error", "peak_error"):
        first, *tighter = numbers(rows, key)
        # The quick run's linear contact begins with a jump, which sets a floor to the error.
        assert 0 < max(tighter) < first / 5
        assert tighter[-1] < 1e-7 < first < 1e-2
    assert numbers(rows, "orbit_steps") == sorted(numbers(rows, "orbit_steps"))
    bias = numbers(rows_of(tmp_path / "smoothing.csv"), "mean_bias")
    assert bias[0] == 0 < bias[1] < bias[2] < 0.1
    assert is_picture(tmp_path / "work_precision.png")
    assert is_picture(tmp_path / "smoothing.png")
    summary = json.loads((tmp_path / "work_precision.json").read_text())
    assert summary["references"]["cic"]["error"]["mean"] < 1e-7


def test_extremes(tmp_path, programs):
    """Every scene has a named outcome, results are finite, and SciPy finds those looked at."""
    run("extremes", tmp_path, programs)
    rows = rows_of(tmp_path / "extremes.csv")
    assert len(rows) == 40
    assert {row["named"] for row in rows} == {"true"}
    assert {"periodic", "solver_failed"} < {row["status"] for row in rows}
    summary = json.loads((tmp_path / "extremes.json").read_text())
    assert summary["not_finite"] == summary["unnamed"] == 0
    assert summary["checks"]["law"]["float32"]["values"] > 10_000
    assert summary["scipy"]["compared"] >= 1
    assert summary["scipy"]["worst_end"] < 1e-3
    assert is_picture(tmp_path / "extremes.png")


def test_benchmark(tmp_path, programs):
    """Every part gives rows, the tools agree, the table of targets is complete."""
    out = run("benchmark", tmp_path, programs)
    rows = rows_of(tmp_path / "benchmark.csv")
    assert all(float(row["run_s"]) > 0 for row in rows)
    parts = {row["part"] for row in rows}
    expected = {"scipy", "numba", "single", "batch 4", "table", "revolutions", "main job"}
    assert parts == expected
    for row in rows:
        if row["value_error"]:
            # The quick run's reference is the linear contact, 6 % off the competitors'.
            limit = 0.1 if row["tool"].startswith("(") else 1e-2
            assert float(row["value_error"]) < limit
    assert all(float(row["peak_memory_MB"]) > 10 for row in rows)
    result = json.loads((tmp_path / "benchmark.json").read_text())
    assert set(result["not_measured"]) == {"orbit", "reverse"}
    goals = {goal["target"]: goal for goal in result["targets"]}
    assert len(result["targets"]) == 14
    assert all(name.split(",")[0] in out for name in goals)
    for name in ("gap table (ms)", "gap table and Jacobian (ms)"):
        assert goals[name]["figure"] > 0
        assert isinstance(goals[name]["reached"], bool)
    assert 0.5 < goals["exponent of cost over revolutions"]["figure"] < 1.6
    assert is_picture(tmp_path / "benchmark.png")
