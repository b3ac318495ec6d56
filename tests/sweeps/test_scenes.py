"""Sweeps from Python: what the dataset holds, also where a point fails."""

import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import rootsopt
from rootsopt import InputError, Status
from rootsopt.sweeps import points
from rootsopt.sweeps.plan import plan_of
from rootsopt.sweeps.points import configured, lost, simulated
from rootsopt.sweeps.table import dataset_of

LOAD, CLEARANCE = "scene.load.torque_N_m", "contact.clearance_mm"
ANGLE, FAMILY = "profile.pressure_angle_deg", "profile.family"


@pytest.fixture(scope="module")
def config() -> rootsopt.Config:
    return rootsopt.load_config("cic", ["objective.terms={outer_radius_mm: 0.5}"])


@pytest.fixture(scope="module")
def found(config) -> xarray.Dataset:
    return rootsopt.sweep_scenes(config, {LOAD: [4.0, 3000.0], CLEARANCE: [0.0, 0.3]})


def test_grid_of_any_keys(config, found):
    assert found.mean_force_N.dims == (LOAD, CLEARANCE)
    assert found.status.values.tolist() == [["periodic", "idle"], ["passed_through"] * 2]
    point = {LOAD: 4.0, CLEARANCE: 0.0}
    one = rootsopt.evaluate(config.replaced(point))
    here = found.sel(point)
    assert float(here.mean_force_N) == one.response["mean_force_N"]
    slope = one.gradient["outer_radius_mm"]["involute_length_mm"]
    assert float(here.gradient_outer_radius_mm.sel(design_key="involute_length_mm")) == slope
    assert float(here.area_efficiency) == one.geometry["area_efficiency"]
    first, *_ = one.steady_state["floquet_multipliers"]
    real, imaginary = here.floquet_multiplier_real, here.floquet_multiplier_imaginary
    assert [float(real[0]), float(imaginary[0])] == first
    assert abs(complex(*first)) == pytest.approx(float(here.floquet_multiplier), rel=1e-12)


def test_units_and_flags(found):
    assert found.mean_force_N.attrs == {"units": "N", "long_name": "mean contact force"}
    assert found[LOAD].attrs["units"] == "N m"
    assert found.design_unit.values.tolist() == ["deg", "mm", "deg"]
    codes, meanings = (found.status_code.attrs[f"flag_{x}"] for x in ("values", "meanings"))
    names = dict(zip(codes.tolist(), meanings.split(), strict=True))
    assert (
        np.vectorize(names.get)(found.status_code.values).tolist() == found.status.values.tolist()
    )
    assert all("units" in v.attrs or v.dtype.kind in "Oi" for v in found.data_vars.values())
    assert all("long_name" in v.attrs for v in found.variables.values())


def test_wrong_keys_and_values_are_refused_before_anything_runs(config, monkeypatch):
    monkeypatch.setattr(points, "simulated", None)
    for wrong in ({"scene.sped_rpm": [1.0]}, {"scene.speed_rpm": [-1.0]}, {}, {LOAD: []}):
        with pytest.raises(InputError):
            rootsopt.sweep_scenes(config, wrong)


def test_point_that_cannot_be_built_is_a_status(config):
    found = rootsopt.sweep_scenes(config, {ANGLE: "5,36.43"})
    assert found.status.values.tolist() == ["invalid", "periodic"]
    assert "profile.involute_length_mm" in str(found.message.values[0])
    assert np.isnan(found.mean_force_N.values).tolist() == [True, False]


def test_family_takes_its_own_parameters(config):
    """Those of another family, in the config or among the axes, are left out."""
    ellipse = {"profile.family": "EE", ANGLE: 30.0}
    assert configured(config, ellipse).profile.parameters == {}
    own = configured(config, {FAMILY: "cic", ANGLE: 37.0}).profile
    assert own.pressure_angle_deg == 37.0
    assert own.involute_length_mm == config.profile.involute_length_mm
    with pytest.raises(InputError, match="does not belong to family ee"):
        configured(rootsopt.load_config("ee"), {ANGLE: 37.0})
    with pytest.raises(InputError, match="is required for family arc"):
        configured(config, {FAMILY: "arc"})


def test_part_can_be_null(config):
    assert configured(config, {"scene.timing_gear": None}).scene.timing_gear is None


def test_an_error_costs_one_point(config, monkeypatch):
    def broken(config):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(points, "check_geometry", broken)
    row = simulated(config, {LOAD: 1.0})
    assert row["status"] == "failed"
    assert row["message"].endswith("ZeroDivisionError: a bug")


def test_points_of_two_families_have_all_parameters():
    """NaN where a point has no such parameter; texts where an axis has no numbers."""
    plan = plan_of({FAMILY: "cic,arc", "rotor.bore_mm": "null,10"})
    slopes = {"mean_force_N": {"pressure_angle_deg": 1.0}}, {"mean_force_N": {"arc_center_mm": 2.0}}
    rows = {
        number: lost(Status.PERIODIC) | {"response": {"mean_force_N": 3.0}, "gradient": slope}
        for number, slope in zip((0, 2), slopes, strict=True)
    }
    found = dataset_of(rootsopt.load_config("cic"), plan, rows)
    slope = found.gradient_mean_force_N
    assert slope.design_key.values.tolist() == ["pressure_angle_deg", "arc_center_mm"]
    np.testing.assert_array_equal(slope.values[:, 0], [[1.0, np.nan], [np.nan, 2.0]])
    assert found["rotor.bore_mm"].values.tolist() == ["null", "10"]
    assert found.status.values[:, 1].tolist() == ["not_simulated"] * 2


def test_single_precision_of_jax_is_refused(config, monkeypatch):
    monkeypatch.setattr("jax.config.read", lambda name: False)
    assert jnp.ones(1).dtype == jnp.float64
    with pytest.raises(RuntimeError, match="jax_enable_x64"):
        rootsopt.sweep_scenes(config, {LOAD: [1.0]})
