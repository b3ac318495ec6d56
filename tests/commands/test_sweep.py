"""`rootsopt sweep`: files, exit codes, and going on after a kill."""

import json
import os
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pytest
import xarray

from rootsopt.commands.table import sweep
from rootsopt.response.sweeps import points
from tests.weight import ROOT


def test_files_of_a_sweep(tmp_path):
    folder = tmp_path / "run"
    axes = "--over=scene.speed_rpm=1000:2000:2", "--over=profile.family=cic,arc"
    assert sweep.main(["cic", *axes, "-o", str(folder)]) == 0
    result = json.loads((folder / "result.json").read_text())
    assert result["statuses"] == {"periodic": 2, "invalid": 2}
    assert result["status"] == "periodic"
    assert result["sweep"]["dimensions"]["profile.family"] == {"profile.family": ["cic", "arc"]}
    assert result["message"].startswith("2 of 4 points")
    assert {"sweep.nc", "sweep.csv", "figures/sweep.png"} < {*result["run"]["files"]}
    found = xarray.load_dataset(folder / "sweep.nc", engine="h5netcdf")
    assert found.mean_force_N.dims == ("scene.speed_rpm", "profile.family")
    assert found.status.values.tolist() == [["periodic", "invalid"]] * 2
    assert found.attrs["Conventions"] == "CF-1.11"
    rows = pd.read_csv(folder / "sweep.csv")
    assert [*rows.status] == found.status.values.ravel().tolist()
    assert rows.mean_force_N[2] == pytest.approx(float(found.mean_force_N[1, 0]))
    assert not (folder.parent / ".run.checkpoint").exists()


def broken(config):
    raise points.InputError(f"at {config.scene.speed_rpm:g}")


def test_dataset_is_read_back(tmp_path, monkeypatch):
    """Texts, nulls, samples and their seed are read back; nothing usable gives exit code 3."""
    monkeypatch.setattr(points, "check_geometry", broken)
    axes = "--over=rotor.bore_mm=null,10", "--over=scene.speed_rpm=100:6000", "--sobol=4"
    options = "--seed=5", "--no-figures", "-o", str(tmp_path / "run")
    assert sweep.main(["cic", *axes, *options]) == 3
    with xarray.open_dataset(tmp_path / "run" / "sweep.nc", engine="h5netcdf") as found:
        assert sorted(found["rotor.bore_mm"].values.tolist()) == ["10", "10", "null", "null"]
        assert found.sizes["sample"] == 4
        assert (found.attrs["method"], found.attrs["seed"]) == ("sobol", 5)
        assert np.isnan(found.mean_force_N.values).all()
        assert found.mean_force_N.attrs["units"] == "N"


def test_speeds_without_keys(tmp_path, monkeypatch):
    """The speeds are those of the objective, or from 0.1 to 2 times that of the scene."""
    monkeypatch.setattr(points, "check_geometry", broken)
    for given, wanted in (("[3000,2000]", [2000, 3000]), ("[]", np.linspace(300, 6000, 39))):
        folder = tmp_path / str(len(wanted))
        speeds = f"--set=objective.speeds_rpm={given}"
        assert sweep.main(["cic", speeds, "--no-figures", "-o", str(folder)]) == 3
        with xarray.open_dataset(folder / "sweep.nc", engine="h5netcdf") as found:
            np.testing.assert_allclose(found["scene.speed_rpm"], wanted, rtol=1e-12)


def arguments(folder):
    """Of a sweep of 30 points, which need no simulation if `TEST_SECONDS` is set."""
    return [
        "cic", "--over=scene.speed_rpm=100:3000:30", "--no-figures", "-o", str(folder),
        f"--import={ROOT / 'tests' / 'response' / 'workers.py'}",
    ]  # fmt: skip


def test_killed_sweep_goes_on(tmp_path, capsys, monkeypatch):
    """After kill -9, `--resume` ends with all points; another config is refused."""
    folder, kept = tmp_path / "run", tmp_path / ".run.checkpoint"
    process = subprocess.Popen(
        [sys.executable, "-m", "rootsopt.sweep", *arguments(folder)],
        cwd=ROOT,
        env=os.environ | {"TEST_SECONDS": "0.1", "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
    )
    while not (kept.exists() and kept.read_bytes().count(b"\n") > 4):
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    before = kept.read_bytes()
    assert 4 < before.count(b"\n") < 31
    assert sweep.main([*arguments(folder), "--resume", "--set=scene.load.torque_N_m=9"]) == 2
    assert "load: torque_N_m (then 4.775, now 9" in capsys.readouterr().err
    assert kept.read_bytes() == before
    monkeypatch.setattr(points, "check_geometry", broken)
    assert sweep.main([*arguments(folder), "--resume"]) == 3
    result = json.loads((folder / "result.json").read_text())
    assert result["statuses"] == {"invalid": 30}
    assert result["statistics"]["resumed_points"] == len(before.splitlines(True)) - 1
    messages = xarray.load_dataset(folder / "sweep.nc").message.values
    assert [text.split()[-1] for text in messages] == [str(100 * k) for k in range(1, 31)]
    assert not kept.exists()
