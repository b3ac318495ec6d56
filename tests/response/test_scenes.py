"""Sweeps from Python: what the dataset holds, also where a point fails, and batches of points."""

import threading
import time
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rootsopt
from rootsopt import InputError, Status
from rootsopt.response import together
from rootsopt.response.evaluation import Evaluator, _motion
from rootsopt.response.reducers import LocalRunner
from rootsopt.response.sweeps import points, scenes
from rootsopt.response.sweeps.plan import plan_of
from rootsopt.response.sweeps.points import configured, lost, simulated, simulated_together
from rootsopt.response.sweeps.scenes import dataset_of

SPEED, LOAD, CLEARANCE = "scene.speed_rpm", "scene.load.torque_N_m", "contact.clearance_mm"
ANGLE, FAMILY = "profile.pressure_angle_deg", "profile.family"


@pytest.fixture(scope="module")
def config() -> rootsopt.Config:
    return rootsopt.load_config("cic_drawn", ["objective.terms={outer_radius_mm: 0.5}"])


def test_grid_of_any_keys(config):
    found = rootsopt.sweep_scenes(config, {LOAD: [4.0, 3000.0], CLEARANCE: [0.0, 0.3]})
    assert found.mean_force_N.dims == (LOAD, CLEARANCE)
    assert found.status.values.tolist() == [["periodic", "idle"], ["passed_through"] * 2]
    point = {LOAD: 4.0, CLEARANCE: 0.0}
    one, here = rootsopt.evaluate(config.replaced(point)), found.sel(point)
    assert float(here.mean_force_N) == one.response["mean_force_N"]
    slope = one.gradient["outer_radius_mm"]["involute_length_mm"]
    assert float(here.gradient_outer_radius_mm.sel(design_key="involute_length_mm")) == slope
    assert float(here.area_efficiency) == one.geometry["area_efficiency"]
    first, *_ = one.steady_state["floquet_multipliers"]
    parts = here.floquet_multiplier_real, here.floquet_multiplier_imaginary
    assert [float(part[0]) for part in parts] == first
    assert abs(complex(*first)) == pytest.approx(float(here.floquet_multiplier), rel=1e-12)
    assert found.mean_force_N.attrs == {"units": "N", "long_name": "mean contact force"}
    assert found[LOAD].attrs["units"] == "N m"
    assert found.design_unit.values.tolist() == ["deg", "mm", "deg"]
    codes, meanings = (found.status_code.attrs[f"flag_{x}"] for x in ("values", "meanings"))
    names = dict(zip(codes.tolist(), meanings.split(), strict=True))
    named = np.vectorize(names.get)(found.status_code.values)
    np.testing.assert_array_equal(named, found.status.values)
    assert all("units" in v.attrs or v.dtype.kind in "Oi" for v in found.data_vars.values())
    assert all("long_name" in v.attrs for v in found.variables.values())


def test_wrong_keys_and_values_are_refused_before_anything_runs(config, monkeypatch):
    monkeypatch.setattr(points, "simulated", None)
    for wrong in ({"scene.sped_rpm": [1.0]}, {"scene.speed_rpm": [-1.0]}, {}, {LOAD: []}):
        with pytest.raises(InputError):
            rootsopt.sweep_scenes(config, wrong)


def test_family_takes_its_own_parameters(config):
    """Those of another family, in the config or among the axes, are left out."""
    assert configured(config, {FAMILY: "EE", ANGLE: 30.0}).profile.parameters == {}
    own = configured(config, {FAMILY: "cic", ANGLE: 37.0}).profile
    assert own.parameters == config.profile.parameters | {"pressure_angle_deg": 37.0}
    for base, values, words in (
        (rootsopt.load_config("ee"), {ANGLE: 37.0}, "does not belong to family ee"),
        (config, {FAMILY: "arc"}, "is required for family arc"),
    ):
        with pytest.raises(InputError, match=words):
            configured(base, values)
    assert configured(config, {"scene.timing_gear": None}).scene.timing_gear is None


def from_file(path, more="") -> rootsopt.Config:
    """Return a config whose rotor is read from the file `path`, which need not exist."""
    profile = f"{{family: outline, lobes: 3, pitch_radius_mm: 33, outline_file: '{path}'{more}}}"
    return rootsopt.load_config("cic_drawn", [f"profile={profile}"])


def test_family_leaves_the_file_of_an_outline():
    """A point with another family has nothing of the file, and a point without keeps it."""
    more = ", outline_smoothing_mm: 0.002, outline_center: fit, outline_unit: inch"
    config = from_file("rotor.csv", more)
    names = [name for name in type(config.profile).model_fields if name.startswith("outline_")]
    own = {ANGLE: 36.0, "profile.involute_length_mm": 8.0, "profile.tip_arc_angle_deg": 4.0}
    found = configured(config, {FAMILY: "cic", **own}).profile
    assert not found.from_file
    assert [*found.parameters.values()] == [36.0, 8.0, 4.0]
    assert {getattr(found, name) for name in names} == {None}
    for values in ({LOAD: 1.0}, {FAMILY: "outline"}):
        assert configured(config, values).profile == config.profile


@pytest.mark.parametrize("place", ["config", "axis"])
def test_points_of_another_outline_are_not_used_again(tmp_path, monkeypatch, place):
    """Known points are those of the file as it was; after a change of it they are refused."""
    files = [tmp_path / f"{number}.csv" for number in range(3)]
    for file in files:
        file.write_text("x_mm,y_mm\n1,0\n")
    axes = {"profile.outline_file": [*map(str, files[1:])]} if place == "axis" else {SPEED: "1,2"}
    check = mock.Mock(side_effect=InputError("not simulated"))
    monkeypatch.setattr(points, "check_geometry", check)
    known = from_file(files[0]), axes
    rootsopt.sweep_scenes(*known, checkpoint=tmp_path / "points")
    rootsopt.sweep_scenes(*known, checkpoint=tmp_path / "points", resume=True)
    assert check.call_count == 2
    files[place == "axis"].write_text("x_mm,y_mm\n2,0\n")
    with pytest.raises(InputError, match="files: "):
        rootsopt.sweep_scenes(*known, checkpoint=tmp_path / "points", resume=True)


def test_stopped_sweep_keeps_what_has_begun(config, monkeypatch):
    """Points that wait are dropped without an error, those that have begun are reported."""
    stop, begun = threading.Event(), []

    def check(config):
        begun.append(config.scene.speed_rpm)
        if len(begun) == 2:
            stop.set()
        time.sleep(0.1)
        raise InputError("not simulated")

    here = LocalRunner(2)
    for module, name, stand_in in (
        (points, "check_geometry", check),
        (points, "HERE", here),
        (scenes, "HERE", here),
    ):
        monkeypatch.setattr(module, name, stand_in)
    plan = plan_of({SPEED: "1,2,3,4,5,6"})
    found = scenes.complete(config, plan, here, scenes.Points(config, plan), stop=stop)
    assert 2 <= len(begun) < 6
    assert sorted(found) == [*range(len(begun))]


def test_an_error_costs_one_point(config, monkeypatch):
    broken = mock.Mock(side_effect=ZeroDivisionError("a bug"))
    monkeypatch.setattr(points, "check_geometry", broken)
    row = simulated(config, {LOAD: 1.0})
    assert row["status"] == "failed"
    assert row["message"].endswith("ZeroDivisionError: a bug")


def test_points_of_two_families_have_all_parameters():
    """NaN where a point has no such parameter; texts where an axis has no numbers."""
    plan = plan_of({FAMILY: "cic,arc", "rotor.bore_mm": "null,10"})
    # The number of mesh periods belongs to a periodic motion, not to one that is given up.
    rows = {
        number: lost(status) | {
            "response": {"mean_force_N": 3.0}, "gradient": {"mean_force_N": slope},
            "steady_state": {"period": 3},
        }
        for number, status, slope in (
            (0, Status.PERIODIC, {"pressure_angle_deg": 1.0}),
            (2, Status.CHAOTIC, {"arc_center_mm": 2.0}),
        )
    }  # fmt: skip
    found = dataset_of(rootsopt.load_config("cic_drawn"), plan, rows)
    slope = found.gradient_mean_force_N
    assert slope.design_key.values.tolist() == ["pressure_angle_deg", "arc_center_mm"]
    np.testing.assert_array_equal(slope.values[:, 0], [[1.0, np.nan], [np.nan, 2.0]])
    assert found["rotor.bore_mm"].values.tolist() == ["null", "10"]
    assert found.status.values[:, 1].tolist() == ["not_simulated"] * 2
    assert found.period.values.tolist() == [[3, 0], [0, 0]]


def test_single_precision_of_jax_is_refused(config, monkeypatch):
    monkeypatch.setattr("jax.config.read", lambda name: name != "jax_enable_x64")
    for refused, arguments in (
        (rootsopt.sweep_scenes, (config, {LOAD: [1.0]})),
        (rootsopt.Scene.from_config, (config,)),
    ):
        with pytest.raises(RuntimeError, match=r'jax.config.update\("jax_enable_x64", True\)'):
            refused(*arguments)


# Scenes that are evaluated as one batch


POINTS = [{SPEED: 2000.0}, {ANGLE: 5.0}, {SPEED: 3000.0}, {LOAD: 3000.0}]


@pytest.fixture
def in_turn(monkeypatch):
    """Replace the batch, which takes minutes to compile, by its motions one by one.

    The fixture is a list of the sizes of all batches."""
    sizes = []

    def motions(arrays, others):
        sizes.append(len(jax.tree.leaves(arrays)[0]))
        rows = [jax.tree.map(lambda x, k=k: x[k], arrays) for k in range(sizes[-1])]
        found = [_motion(*eqx.combine(row, others)) for row in rows]
        return jax.tree.map(lambda *x: jnp.stack(x), *found)

    monkeypatch.setattr(together, "_motions", motions)
    return sizes


def test_points_keep_their_places(config, in_turn):
    """One batch for all points of the same structure, whatever becomes of them."""
    found = simulated_together(config, POINTS)
    assert in_turn == [3]
    assert [row["status"] for row in found] == ["periodic", "invalid", "periodic", "passed_through"]
    assert found == [simulated(config, values) for values in POINTS]


def test_structures_are_told_apart(config):
    """Other numbers make the same batch, other choices another one."""
    kinds = []
    for keys in (
        *({}, {SPEED: 2000.0}),
        *({"solver.max_orbit_periods": 4}, {"scene.timing_gear": None}),
    ):
        scene = Evaluator.of(config.replaced(keys)).scene
        kinds.append(together._kind(*eqx.partition((scene.solver, scene.gear), eqx.is_array)))
    assert kinds[0] == kinds[1]
    assert len({*kinds}) == 3


def test_a_batch_that_fails_is_done_one_by_one(config, monkeypatch):
    monkeypatch.setattr(points, "evaluate_together", mock.Mock(side_effect=MemoryError))
    assert simulated_together(config, POINTS[:1]) == [simulated(config, POINTS[0])]


def test_accelerators_take_batches(config, monkeypatch):
    batch = mock.Mock(side_effect=lambda _, some: some)
    for name, stand_in in (("pays", lambda: True), ("_BATCH", 2), ("simulated_together", batch)):
        monkeypatch.setattr(points, name, stand_in)
    here, given = points.InProcess(), [(number, {SPEED: number + 1.0}) for number in range(2)]
    assert (here.slots, here.share(3)) == (1, 2)
    assert here.simulated(config, given, threading.Event()) == given
    batch.assert_called_once_with(config, tuple(values for _, values in given))


@pytest.mark.long
def test_arrays_of_scenes_agree_with_single_ones(config):
    found = simulated_together(config, POINTS)
    for row, values in zip(found, POINTS, strict=True):
        alone = simulated(config, values)
        assert row["status"] == alone["status"]
        assert row["response"] == pytest.approx(alone["response"], rel=1e-7)
        for name, slopes in alone["gradient"].items():
            assert row["gradient"][name] == pytest.approx(slopes, rel=1e-5)
