"""Tests of `pareto` from outside: files, exit codes, messages, and a whole run with forces."""

import json

import pandas as pd
import pytest

import rootsopt
from rootsopt.commands.table import pareto
from rootsopt.config import load
from rootsopt.profiles import geometry
from rootsopt.response.records import geometry_record
from rootsopt.scene import Scene, design_vector
from rootsopt.view.files import design_file

CIC = "cic_drawn"
FEW = [
    "--set=pareto.terms=[outer_radius_mm, area_efficiency]",
    "--set=pareto.points=3",
    "--set=optimizer.starts=1",
]


def test_files_of_a_run_belong_together(tmp_path):
    """Every file of the run is listed; table, result and configs contain the same points."""
    folder = tmp_path / "run"
    assert pareto.main([CIC, "-o", str(folder), *FEW]) == 0
    result = json.loads((folder / "result.json").read_text())
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert set(result["run"]["files"]) == files
    assert {"config.yaml", "front.csv", "figures/front.png", design_file(3)} <= files
    rows = pd.read_csv(folder / "front.csv").to_dict("records")
    assert [row["point"] for row in rows] == [1, 2, 3]
    for row, point in zip(rows, result["points"], strict=True):
        assert row["status"] == point["status"] == "certified"
        assert point["certificate"]["residual"] <= point["certificate"]["required_residual"]
        values = point["terms"] | point["design"]
        assert {name: row[name] for name in values} == pytest.approx(values, rel=1e-9)
        # The config of the point gives its terms, computed in another way.
        config = load(folder / design_file(point["point"]))
        scene = Scene.from_config(config)
        found = geometry_record(scene, geometry(scene.profile(design_vector(config))))
        assert found == pytest.approx(point["geometry"] | point["terms"], rel=1e-12)
    assert [term["sense"] for term in result["terms"]] == ["min", "max"]
    assert result["edges"] == [[1, 2], [2, 3]]
    assert result["status"] == "geometry_only"


@pytest.mark.long
def test_front_with_forces(tmp_path):
    """The front of peak force against area efficiency agrees with single runs.

    Its ends are the optima of `optimize`. Each point agrees with a simulation of its config. The
    rates are slopes of the front."""
    given = [CIC, "-o", str(tmp_path / "run"), "--no-figures", "--set", "pareto.points=5"]
    assert pareto.main(given) == 0
    points = json.loads((tmp_path / "run" / "result.json").read_text())["points"]
    assert [point["status"] for point in points] == ["certified"] * len(points)
    for point in points[1:3]:
        config = load(tmp_path / "run" / design_file(point["point"]))
        force = rootsopt.evaluate(config).response["peak_force_N"]
        assert force == pytest.approx(point["terms"]["peak_force_N"], rel=1e-6)
    overrides = ["objective.mean_weight=0", "constraints.area_efficiency_min=0"]
    alone = rootsopt.optimize_design(rootsopt.load_config(CIC, overrides)).optimized
    assert points[0]["end_of"] == "peak_force_N"
    assert points[0]["terms"]["peak_force_N"] == pytest.approx(
        alone.response["peak_force_N"], rel=1e-4
    )
    assert points[0]["design"] == pytest.approx(alone.design, rel=1e-2)
    for name in ("peak_force_N", "area_efficiency"):
        values = [point["terms"][name] for point in points]
        assert values == sorted(values)
