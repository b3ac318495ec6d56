"""Studies, run with `--quick`, write their files and give sane numbers."""

import csv
import json
import os
import subprocess
import sys
from collections import Counter
from types import SimpleNamespace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.__main__ import studies
from experiments._common import engines
from experiments._common.engines.scipy_nodes import ScipyNodes
from experiments._common.scenes import FORCES
from experiments.gradients import study as gradients
from experiments.paper.scene import PAPER, Response, config_of, pair_of, polished
from rootsopt.config import load
from rootsopt.scene import Scene, design_vector

pytest.importorskip("numba")

PNG = b"\x89PNG"
KNOWN = studies()


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """Return an environment in which the studies share a folder of compiled programs."""
    return os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("programs")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


def run(study, folder, environment, *options):
    """Make a reduced run of a study, which draws its published figures; return its output."""
    command = [sys.executable, "-m", "experiments", study, "--quick", "-o", str(folder), *options]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    drawn = {path.name for path in folder.glob("*.png") if path.read_bytes()[:4] == PNG}
    searched = "--search" in options
    assert drawn == {x for x in KNOWN[study][1].published if ("search" in x) == searched}
    return done.stdout


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def numbers(rows, key):
    return [float(row[key]) for row in rows]


@pytest.mark.long
def test_gradients(tmp_path, programs):
    """Gradients of a few random pairs are those of differences, at every tolerance."""
    said = run("gradients", tmp_path, programs)
    assert said.endswith("0 promises broken\n")
    rows = rows_of(tmp_path / "gradients.csv")
    assert len(rows) == 12
    # What the differences do not know is no error of the gradient.
    off = np.subtract(*(numbers(rows, f"mean_force_N_{what}") for what in ("error", "noise")))
    assert np.max(off) < 1e-4


def test_gradients_that_are_off_are_told():
    """A gradient with too great an error fails, and so does a tighter tolerance that errs more."""
    good = {"scene": "one", "period": 1, "status": "periodic", "gradient_disagreement": 1e-6}
    good |= {f"{name}_error": 9e-7 for name in gradients.MEASURES}
    good |= {f"{name}_noise": 1e-8 for name in gradients.MEASURES}
    rows = [good | {"rtol": rtol} for rtol in gradients.TOLERANCES]
    assert gradients.judge(rows)[1] == []
    for name in gradients.MEASURES:
        said, more = gradients.judge([*rows[:2], rows[2] | {f"{name}_error": 1e-2}])[1]
        assert said.startswith("OFF 1e-10")
        assert more == "UNBOUNDED 11.1 % of 9 gradients"
    (said,) = gradients.judge([*rows[:2], rows[2] | {"status": "not_settled"}])[1]
    assert said.startswith("WORSE")


@pytest.mark.long
def test_smoothing(tmp_path, programs):
    """The default's bias is below its limit, and grows with the smoothing length."""
    run("smoothing", tmp_path, programs)
    summary = json.loads((tmp_path / "smoothing.json").read_text())["cic"]
    assert summary["settled"] >= 5
    sharp, wide, default = summary["by_width"].values()
    assert sharp["greatest_bias"] == 0 < default["greatest_bias"] < 1e-4
    assert default["greatest_bias"] <= wide["greatest_bias"]
    assert max(default["median_gradient_error"]) < 1e-4


@pytest.mark.long
def test_tolerances(tmp_path, programs):
    """All designs are evaluated in every fresh scene.

    The robust optimum is no worse over the search's sample."""
    run("tolerances", tmp_path, programs)
    rows = rows_of(tmp_path / "tolerances.csv")
    assert [row["design"] for row in rows] == ["baseline", "nominal", "robust"]
    assert numbers(rows, "robust_objective")[0] == 1 > max(numbers(rows, "robust_objective")[1:])
    scenes = rows_of(tmp_path / "tolerances_scenes.csv")
    mean = np.mean(numbers(scenes, "robust_peak_force_N"))
    assert mean == pytest.approx(float(rows[2]["peak_force_N_mean"]), rel=1e-8)


@pytest.mark.long
def test_speed(tmp_path):
    """The slowest speed gives nearly the forces at standstill.

    Resonances lie where a harmonic of the mesh frequency is the mode's frequency."""
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


@pytest.mark.long
def test_extremes(tmp_path, programs):
    """Every scene has a named outcome, and results are finite.

    SciPy finds the same results in the scenes chosen for it."""
    run("extremes", tmp_path, programs)
    rows = rows_of(tmp_path / "extremes.csv")
    assert len(rows) == 40
    assert {row["named"] for row in rows} == {"true"}
    assert {"periodic", "solver_failed"} < {row["status"] for row in rows}
    summary = json.loads((tmp_path / "extremes.json").read_text())
    assert summary["not_finite"] == summary["unnamed"] == 0
    assert summary["checks"]["law"]["values"] > 10_000
    assert summary["scipy"]["compared"] >= 1
    assert summary["scipy"]["worst_end"] < 1e-3


@pytest.mark.long
def test_benchmark(tmp_path, programs):
    """Every part gives rows, the tools agree, cost grows with the revolutions."""
    run("benchmark", tmp_path, programs)
    rows = rows_of(tmp_path / "benchmark.csv")
    assert all(float(row["run_s"]) > 0 for row in rows)
    parts = {"scipy", "numba", "single", "batch 4", "revolutions", "main job"}
    assert {row["part"] for row in rows} == parts
    assert max(float(row["value_error"] or 0) for row in rows) < 1e-2
    assert all(float(row["peak_memory_MB"]) > 10 for row in rows)
    result = json.loads((tmp_path / "benchmark.json").read_text())
    assert result["not_measured"] == {}
    turned = [row for row in rows if row["part"] == "revolutions"]
    turns = np.log([[float(row[key]) for key in ("revolutions", "run_s")] for row in turned])
    assert 0.5 < np.polyfit(*turns.T, 1)[0] < 1.6


@pytest.mark.long
def test_accuracy(tmp_path, programs):
    """Errors are within the accuracy asked for."""
    run("accuracy", tmp_path, programs)
    table = json.loads((tmp_path / "accuracy.json").read_text())["table"]
    assert all(row["scenes"] == row["within"] == 1 for row in table)


@pytest.mark.long
@pytest.mark.parametrize(
    ("study", "table", "times"),
    [
        ("parts", "parts.csv", "equations"),
        ("sweeps", "sweeps.csv", "points_per_second"),
    ],
)
def test_studies_of_cost(study, table, times, tmp_path, programs):
    """Each row of the table has a cost."""
    run(study, tmp_path, programs)
    assert min(numbers(rows_of(tmp_path / table), times)) > 0


@pytest.mark.long
def test_pump_front(tmp_path, programs):
    """The front of a family: the ripple follows from radius and area efficiency alone."""
    run("pump_front", tmp_path, programs)
    rows = rows_of(tmp_path / "pump_front.csv")
    assert {row["family"] for row in rows} == {"ee", "arc_involute"}
    ratio, eta = (np.array(numbers(rows, key)) for key in ("radius_ratio", "area_efficiency"))
    ripple = (ratio - 1) ** 2 / (eta * ratio**2)
    # The file has ten digits.
    np.testing.assert_allclose(numbers(rows, "flow_ripple"), ripple, rtol=1e-8)
    np.testing.assert_allclose(numbers(rows, "sampled_ripple"), ripple, rtol=1e-5)
    volumes = np.array(numbers(rows, "displaced_volume_cm3"))
    assert np.min(volumes) >= volumes[0] * (1 - 1e-6)
    assert "true" in {row["best_of_all"] for row in rows}


@pytest.mark.long
def test_twist(tmp_path, programs):
    """A twist evens the flow by its closed form, and lowers the peak of the force."""
    run("twist", tmp_path, programs)
    straight, turned = rows_of(tmp_path / "twist.csv")
    assert float(straight["flow_ripple"]) == pytest.approx(2 / 13)
    assert float(turned["flow_ripple"]) == pytest.approx(2 / 13 * 2 / np.pi)
    assert float(turned["peak_force_N"]) < float(straight["peak_force_N"])
    assert float(turned["axial_force_max_N"]) > 1 > float(straight["axial_force_max_N"])


@pytest.mark.long
def test_paper(tmp_path, programs):
    """The shipped values give the paper's four forces (its section 4), both motions periodic; here
    with linear contact, which is some 3 % off."""
    run("paper", tmp_path, programs)
    (row,) = rows_of(tmp_path / "paper.csv")
    forces = {"cic": (102.4, 1973.3), "ee": (1047.1, 5661.4)}
    for family, (mean, peak) in forces.items():
        assert row[f"{family}_status"] == "periodic"
        assert float(row[f"{family}_mean_force_N"]) == pytest.approx(mean, rel=0.035)
        assert float(row[f"{family}_peak_force_N"]) == pytest.approx(peak, rel=0.035)
    # Each quantity matters, and a thousandth of it changes no force by more than a hundredth.
    rows = rows_of(tmp_path / "paper_slices.csv")
    assert len({one["changed"] for one in rows}) == 6
    for name in ("cic_mean_force_N", "cic_peak_force_N", "ee_mean_force_N", "ee_peak_force_N"):
        assert numbers(rows, name) == pytest.approx([float(row[name])] * 12, rel=1e-2)
    assert len({one["ee_mean_force_N"] for one in rows}) == 12


def test_paper_by_scipy():
    """SciPy finds the paper's forces in the shipped scene of the CIC pair."""
    config = load("configs/paper_cic.yaml")
    found = ScipyNodes(
        engines.Scene.of(config), nodes=400, rtol=1e-5, settle=10, window=2
    ).simulate([36.43, 9.0, 4.0])
    assert found.mean == pytest.approx(102.4, rel=1e-3)
    assert found.peak == pytest.approx(1973.3, rel=1e-3)


def test_paper_scene_is_shared():
    """Both pairs have the same scene."""
    cic, ee = (load(f"configs/paper_{family}.yaml").model_dump() for family in ("cic", "ee"))
    assert cic.pop("profile") != ee.pop("profile")
    assert cic == ee


def test_pair_of_quantities():
    """The pair differentiated with respect to the quantities is that of the config with them."""
    values = np.array([123.0, 4.5, 6.7e4, 0.21, 0.43, 0.065])
    config = config_of("ee", values)
    design = design_vector(config)
    expected = jax.tree.leaves(Scene.from_config(config).pair(design))
    shipped = Scene.from_config(config_of("ee"))
    found = jax.tree.leaves(pair_of(shipped, design, jnp.asarray(values)))
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert np.asarray(one) == pytest.approx(np.asarray(other), rel=1e-12)


def test_polished():
    """Gauss-Newton steps find the quantities for forces that are powers of them.

    The quantities stay in their ranges, and those held stay as they are."""
    powers = np.random.default_rng(3).normal(size=(4, 6))
    start = np.array([100.0, 2.0, 2e4, 0.2, 0.3, 0.1])

    def pairs(values) -> Any:
        forces = (PAPER.ravel() * 1.2 * np.prod((values / start) ** powers, axis=1)).reshape(2, 2)
        evaluations: Any = [
            SimpleNamespace(response={"mean_force_N": mean, "peak_force_N": peak})
            for mean, peak in forces
        ]
        return Response(np.asarray(values), evaluations, powers.reshape(2, 2, 6))

    for held in ([], [1], [0, 4]):
        found = polished(cast(Any, pairs), start, held=held)
        assert found.misfit < 1e-4
        assert found.values[held] == pytest.approx(start[held], rel=1e-12)


@pytest.mark.long
def test_paper_search(tmp_path, programs):
    """A generation of a search simulates all its scenes inside the given box."""
    run("paper", tmp_path, programs, "--search", "--seed", "1", "--least-clearance", "0.1")
    rows = rows_of(tmp_path / "paper_search.csv")
    record = json.loads((tmp_path / "paper_search.json").read_text())
    assert len(rows) == record["scenes"] > 10
    assert min(numbers(rows, "contact.clearance_mm")) >= 0.1
    assert record["seed"] == 1


@pytest.mark.long
def test_landscape(tmp_path, programs):
    """No design of the grids is better than the optimum by more than 0.1 %."""
    run("landscape", tmp_path, programs)
    (record,) = json.loads((tmp_path / "landscape.json").read_text())["scenes"]
    assert record["agrees"]
    rows = rows_of(tmp_path / "landscape.csv")
    assert len(rows) == record["grid_designs"] + record["finer_designs"]
    assert min(record["grid_designs"], record["finer_designs"]) > 5


@pytest.mark.long
def test_prices(tmp_path, programs):
    """The price of a limit is the slope of the optimal objective, found again on either side."""
    run("prices", tmp_path, programs)
    (row,) = rows_of(tmp_path / "prices.csv")
    assert row["limit"] == "area efficiency"
    assert float(row["price"]) > 0
    assert float(row["by_moving"]) == pytest.approx(float(row["price"]), rel=0.02)


@pytest.mark.long
def test_geometry(tmp_path, programs):
    """Area and inertia are those of the polygons, in every family of the reduced run."""
    run("geometry", tmp_path, programs)
    rows = rows_of(tmp_path / "geometry.csv")
    assert {(row["family"], row["lobes"]) for row in rows} >= {("cic", "2"), ("ee", "3")}
    assert max(numbers(rows, "area_error") + numbers(rows, "polar_moment_error")) < 1e-11


@pytest.mark.long
def test_measured(tmp_path, programs):
    run("measured", tmp_path, programs)
    found = json.loads((tmp_path / "measured.json").read_text())
    assert found["form_found_um"] == pytest.approx(found["form_given_um"], abs=1.5)
    assert found["outline"]["interference_um"] == pytest.approx(20, abs=1.5)
    assert found["outline"]["reversed"]


@pytest.mark.long
def test_freeform(tmp_path, programs):
    """The optimum is better than the start, by the figures of both designs."""
    run("freeform", tmp_path, programs)
    designs = json.loads((tmp_path / "freeform.json").read_text())["designs"]
    assert designs["free form"]["objective"] < designs["best CIC"]["objective"] < 1
    assert designs["paper"]["objective"] == 1
    found = load(tmp_path / "freeform.yaml")
    assert len(found.profile.coefficients) == 12


@pytest.mark.long
def test_families(tmp_path, programs):
    """All families share one housing, and the reference's bore and area efficiency.

    Forces and ranks are in the output."""
    out = run("families", tmp_path, programs)
    rows = {row["family"]: row for row in rows_of(tmp_path / "families.csv")}
    assert set(rows) == {"cic", "arc", "free_form"}
    reference = json.loads((tmp_path / "families.json").read_text())["references"]["cic"]
    for row in rows.values():
        shape = reference["geometry"]
        assert row["status"] == "periodic"
        assert 0 <= shape["outer_radius_mm"] - float(row["outer_radius_mm"]) <= 1.1e-3
        if row["reached"] == "true":
            assert float(row["area_efficiency"]) >= shape["area_efficiency"] - 6e-5
        forces = (float(row[key]) / reference["response"][key] for key in FORCES)
        assert float(row["objective"]) == pytest.approx(np.mean(list(forces)), rel=1e-8)
    # The single arc of this bore is known, and has too small an area efficiency.
    assert rows["arc"]["reached"] == "false"
    assert float(rows["arc"]["area_efficiency"]) == pytest.approx(0.43363, abs=4e-5)
    assert "| 1 | `" in out


@pytest.mark.long
def test_optimisers(tmp_path, programs):
    """Every method improves on the start of every problem, and each evaluation is recorded."""
    run("optimisers", tmp_path, programs)
    rows = rows_of(tmp_path / "optimisers.csv")
    designs = Counter(row["method"] for row in rows)
    assert {"slsqp", "augmented_lagrangian", "interior_point"} <= set(designs)
    assert all(2 < number <= 30 for number in designs.values())
    record = json.loads((tmp_path / "optimisers.json").read_text())
    assert all(row["designs"] > 1 for row in record["summary"])
