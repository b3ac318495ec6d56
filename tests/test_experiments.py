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


def test_speed(tmp_path):
    """The slowest speed is as good as standstill; resonances lie where the harmonics meet them."""
    run("speed", tmp_path, os.environ | {"JAX_PLATFORMS": "cpu"})
    rows = rows_of(tmp_path / "speed.csv")
    assert {row["status"] for row in rows} == {"periodic"}
    summary = json.loads((tmp_path / "speed.json").read_text())
    for design, found in summary["linearised"]["shipped"].items():
        own = [row for row in rows if row["design"] == design]
        assert float(own[0]["speed_rpm"]) == 300
        assert float(own[0]["mean_force_N"]) == pytest.approx(found["static_mean_N"], rel=0.01)
        assert float(own[0]["peak_force_N"]) == pytest.approx(found["static_peak_N"], rel=0.06)
    resonances = rows_of(tmp_path / "speed_resonances.csv")
    assert {row["mode"] for row in resonances} == {"contact", "gear", "average"}
    for row in resonances:
        harmonic = int(row["order"]) * 3 * float(row["speed_rpm"]) / 60
        assert harmonic == pytest.approx(float(row["frequency_Hz"]), rel=1e-9)
    outcomes = {row["optimised"]: row for row in summary["optimisations"]}
    assert outcomes["over the range, mean"]["own_objective"] < 1
    found = outcomes["over the range, mean"]
    assert found["own_objective"] == pytest.approx(found["mean_over_listed"], rel=1e-6)
    for name in ("speed", "speed_objective", "speed_resonances"):
        assert is_picture(tmp_path / f"{name}.png")


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


def test_parts(tmp_path, programs):
    """Every part costs something, and the smallest scene least."""
    run("parts", tmp_path, programs)
    first, *others = rows_of(tmp_path / "parts.csv")
    assert first["states"] == "2"
    assert all(int(row["equations"]) > int(first["equations"]) for row in others)
    assert others[-1]["states"] == "11"
