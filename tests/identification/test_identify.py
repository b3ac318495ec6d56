"""Records of simulated scenes, whose values are known: `identify` finds them."""

import dataclasses
import functools
import importlib
import json

import numpy as np
import pandas
import pytest

import rootsopt
from rootsopt import Status, load_config
from rootsopt.commands.table import identify as command
from rootsopt.identification import answer, model
from rootsopt.identification import fit as search
from rootsopt.identification.model import Point, fitted
from rootsopt.identification.record import CHANNELS, observed
from rootsopt.response.attractors import find
from rootsopt.response.evaluation import Evaluator
from tests.standins import refusal

BACKLASH, LOAD = "scene.timing_gear.backlash_mm", "scene.load.torque_N_m"
DAMPING = "scene.timing_gear.damping_ratio"
TRUE = {BACKLASH: 0.14, LOAD: 5.5}
FEW = "attractors.relatives=4", "attractors.rates=3"
CIC = load_config("cic", FEW)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Try fewer scenes before local fits than the default, and once only. Consider further
    measurements at the config's speed alone."""
    for module, name, most in (
        (search, "_TRIED", 2),
        (search, "_ROUNDS", 1),
        (answer, "_SPEEDS", (1.0,)),
    ):
        monkeypatch.setattr(module, name, most)


@functools.cache
def simulated(speed):
    """Return the evaluation of the true scene at a speed (rpm)."""
    return rootsopt.evaluate(CIC.replaced(TRUE | {"scene.speed_rpm": speed}))


def sampled(noise, *names, step=10):
    """Return a record of every `step`-th sample of the second turn, with noise."""
    data, rng = simulated(3000.0).to_dataset(), np.random.default_rng(0)
    record = {name: data[name].values[3::step] for name in names}
    return {"rotation_deg": data.rotation_deg.values[3::step] + 360} | {
        name: x + noise * np.std(x) * rng.standard_normal(len(x)) for name, x in record.items()
    }


def test_samples_lead_to_the_true_values_with_their_errors(monkeypatch):
    monkeypatch.setattr(answer, "_SPEEDS", (0.5, 1.0))
    record = sampled(0.03, "relative_rotation_rad", "contact_force_N")
    config = CIC.replaced({LOAD: 5.5, DAMPING: 0.7})
    keys, true = {BACKLASH: (0.05, 0.3), DAMPING: (0.2, 0.9)}, {BACKLASH: 0.14, DAMPING: 0.5}
    found = rootsopt.identify(config, record, keys, profiles=[DAMPING], starts=1)
    assert found.status is Status.IDENTIFIED
    for key, one in found.parameters.items():
        low, high = one["interval_95"]
        assert low < true[key] < high < low + 0.1 * true[key]
        assert one["standard_error"] == pytest.approx((high - low) / 3.92, rel=0.3)
    assert found.fit["relative_errors"]["contact_force_N"] == pytest.approx(0.03, rel=0.2)
    assert found.config.value(BACKLASH) == found.parameters[BACKLASH]["value"]
    assert -1 < found.increase(true) < 9.2
    assert all(one["determined"] for one in found.combinations)
    first, *rises, last = (one["increase"] for one in found.profiles[DAMPING]["points"])
    assert min(rises) == 0
    assert min(first, last) > 3.5
    assert (
        found.further[0]["standard_errors"][DAMPING] < found.parameters[DAMPING]["standard_error"]
    )


def test_channels_have_the_slopes_of_difference_quotients_and_the_torque_of_the_law():
    """The gear's torque is stiffness times what ε exceeds half the backlash by, plus damping."""
    config = CIC.replaced(TRUE)
    record = sampled(0.0, *(name for name in CHANNELS if "torque" not in name), step=90)
    record |= {name: 0.0 * record["rotation_deg"] for name in CHANNELS if "torque" in name}
    _, quantities = fitted(config, [BACKLASH, LOAD, "rotation_offset_deg"], [])
    (seen,) = observed(config, record)
    point, values = Point.of(config, seen), np.array([*TRUE.values(), 0.0])
    found = point.predicted(quantities, values, None)
    column = dict(zip(seen.names, found.values.T, strict=True))
    for name in seen.names:
        if "torque" not in name:
            np.testing.assert_allclose(
                column[name], record[name], atol=2e-5 * np.max(np.abs(record[name]))
            )
    for k, step in enumerate((1.4e-5, 5.5e-4, 1e-2)):
        ends = [point.predicted(quantities, values + side * step * np.eye(3)[k], found.begin).values
                for side in (-1, 1)]  # fmt: skip
        slopes, size = (ends[1] - ends[0]) / (2 * step), np.abs(found.slopes[..., k])
        # Where a flank begins or ceases to touch, the difference quotient goes across a kink.
        away = np.abs(slopes - found.slopes[..., k]) / np.maximum(np.max(size, axis=0), 1e-9)
        assert np.median(away) < 1e-5
        assert np.mean(away < 3e-3) > 0.9
    inertia = simulated(3000.0).geometry["polar_inertia_kg_m2"]
    gear, radius = config.scene.timing_gear, 33e-3
    stiffness, half = gear.stiffness_N_m_per_rad, 0.14e-3 / (2 * radius)
    damping = 2 * gear.damping_ratio * np.sqrt(stiffness * inertia / 2)
    relative, rate = (column[name] for name in CHANNELS[:2])
    beyond = relative - np.clip(relative, -half, half)
    torque = stiffness * beyond + damping * rate * (beyond != 0)
    clear = np.abs(np.abs(relative) - half) * radius > 1e-6
    np.testing.assert_allclose(column["gear_torque_N_m"][clear], torque[clear], atol=1e-3)
    # Equal rotors: what the shaft gives, the load and the losses of gear and flanks take.
    assert 5.5 < np.mean(column["shaft_torque_N_m"]) < 1.6 * 5.5


def test_averages_over_speeds_lead_to_the_true_values_with_gaps(tmp_path):
    rng, names = np.random.default_rng(1), ("peak_force_N", "mean_force_N", "rms_force_N")
    rows = [
        {"scene.speed_rpm": speed}
        | {key: simulated(speed).response[key] * (1 + 1e-3 * rng.standard_normal())
           for key in names} for speed in (1500.0, 3000.0)
    ]  # fmt: skip
    rows[1]["mean_force_N"] = np.nan
    pandas.DataFrame(rows).to_csv(tmp_path / "record.csv", index=False)
    config, keys = CIC.replaced({LOAD: 5.5}), [f"{BACKLASH}=0.05:0.3"]
    found = rootsopt.identify(config, str(tmp_path / "record.csv"), keys, starts=1)
    assert found.fit["measured_values"] == 5
    low, high = found.parameters[BACKLASH]["interval_95"]
    assert low < 0.14 < high < low + 0.01


@functools.cache
def coexisting():
    """Return (config, its motions) of a scene with quiet and noisy motions side by side."""
    config = load_config("cic_drawn", FEW).replaced(
        {"scene.speed_rpm": 4100.0, BACKLASH: 0.2, DAMPING: 0.2}
    )
    found = find(Evaluator.of(config), series=True).attractors
    return config, {one.reached: one.evaluation for one in reversed(found)}


def matched(record):
    """Return the fit of the backlash in a scene with several motions to one of them."""
    fit = rootsopt.identify(
        coexisting()[0].replaced({BACKLASH: 0.19}), record, {BACKLASH: (0.15, 0.25)}, starts=1
    )
    (motion,) = fit.motions
    return fit, motion, fit.parameters[BACKLASH]["value"]


@pytest.mark.parametrize("kind", ["force", "averages"])
def test_a_motion_that_is_not_reached_from_rest_is_matched(kind):
    _, found = coexisting()
    quiet, rng = found[False], np.random.default_rng(0)
    assert quiet.response["peak_force_N"] < 0.8 * found[True].response["peak_force_N"]
    data = quiet.to_dataset()
    values = data["contact_force_N"].values[::20]
    noise = 0.03 * np.std(values) * rng.standard_normal(len(values))
    record = {"rotation_deg": data.rotation_deg.values[::20], "contact_force_N": values + noise}
    if kind == "averages":
        record = {
            name: quiet.response[name] * (1 + 1e-3 * rng.standard_normal())
            for name in ("mean_force_N", "peak_force_N", "rms_force_N", "line_1_force_N")
            if name in quiet.response
        }
    fit, motion, value = matched(record)
    assert value == pytest.approx(0.2, rel=0.01)
    assert (motion["period"], motion["reached_from_rest"]) == (1, False)
    assert "not reached from rest" in fit.message
    if kind == "averages":
        assert motion["other_motions"] >= 1
        assert "At 1 of 1 operating points other motions coexist" in fit.message


def test_a_motion_of_two_mesh_periods_is_matched_whichever_comes_first(monkeypatch):
    monkeypatch.setattr(search, "_TRIED", 8)
    data = coexisting()[1][True].to_dataset()
    record = {"rotation_deg": data.rotation_deg.values[::20] + 120}
    record["contact_force_N"] = data["contact_force_N"].values[::20]
    fit, motion, value = matched(record)
    assert value == pytest.approx(0.2, rel=1e-3)
    assert (motion["period"], motion["reached_from_rest"]) == (2, True)
    assert "not reached" not in fit.message


def test_more_quantities_than_values_are_not_determined():
    keys = {BACKLASH: (0.05, 0.3), LOAD: (3.0, 9.0), "contact.stiffness_N_per_mm_e": (1e5, 4e5)}
    record = {name: simulated(3000.0).response[name] for name in ("mean_force_N", "peak_force_N")}
    found = rootsopt.identify(CIC.replaced({LOAD: 12.0}), record, keys, starts=1)
    assert (found.status, found.combinations[0]["determined"]) == (Status.IDENTIFIED, False)
    assert found.fit["relative_misfit"] < 1e-4
    for said in (f"{LOAD} is 12 in the config, outside its", "nothing to estimate errors from"):
        assert said in found.message
    assert found.record()["parameters"][LOAD]["interval_95"] == [3.0, 9.0]


def test_averages_of_chaos_are_fitted_over_an_ensemble(monkeypatch):
    """Averages that are linear in the quantity: the slope through neighbours is theirs."""

    def evaluated(self, evaluator, design, start, series):
        load = evaluator.config.scene.load.torque_N_m
        response = {"mean_force_N": 20 * load, "peak_force_N": 50 + load, "rms_force_N": load}
        errors = {name.replace("_N", "_standard_error_N"): 0.1 for name in response}
        found = {"response": response, "steady_state": errors, "start": np.zeros((16, 2))}
        return dataclasses.replace(simulated(3000.0), status=Status.AVERAGED, **found)

    monkeypatch.setattr(model.Ensemble, "evaluated", evaluated)
    config = CIC.replaced({"objective.motion": "ensemble"})
    _, quantities = fitted(config, {LOAD: (3.0, 9.0)}, [])
    (seen,) = observed(config, {"mean_force_N": 110.3, "peak_force_N": 55.4})
    found = Point.of(config, seen).predicted(quantities, np.array([5.0]), None)
    np.testing.assert_allclose(found.slopes[0, :, 0], [20, 1], rtol=1e-6)
    np.testing.assert_allclose((found.values, found.errors), ([[100, 55]], [[0.1, 0.1]]))
    samples = observed(config, sampled(0.0, "contact_force_N"))
    assert "must have columns among mean_force_N" in refusal(Point.of, config, *samples)


def test_command_writes_the_fit_and_says_what_is_wrong(tmp_path, capsys, monkeypatch):
    """The record has an unknown gain, constant and rotation, which are found, too."""
    monkeypatch.chdir(tmp_path)
    record = sampled(0.01, "contact_force_N", "relative_rotation_rad")
    record["rotation_deg"] = record["rotation_deg"] + 17.0
    record["contact_force_N"] = 0.3 * record["contact_force_N"] + 5
    pandas.DataFrame(record).to_csv("record.csv", index=False)
    quick = ["cic", "--starts", "1", *(f"--set={one}" for one in FEW)]
    options = ["--data", "record.csv", "-o", "run", "--set", f"{BACKLASH}=0.14"]
    options += ["--gain", "contact_force_N", "--constant", "contact_force_N",
                "--fit", f"{LOAD}=3:9", "--fit", "rotation_offset_deg"]  # fmt: skip
    assert command.main([*quick, *options]) == 0
    out = capsys.readouterr().out
    assert "Quantities that fit the record" in out
    assert "rootsopt simulate run/identified.yaml" in out
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["status"] == "identified"
    load, turned = (result["parameters"][key] for key in (LOAD, "rotation_offset_deg"))
    assert load["interval_95"][0] < 5.5 < load["interval_95"][1]
    assert turned["value"] == pytest.approx(17.0, abs=0.1)
    gain, constant = result["fit"]["gains"].values()
    assert (gain, constant) == (pytest.approx(0.3, rel=0.02), pytest.approx(5, abs=1))
    assert load_config("run/identified.yaml").value(LOAD) == pytest.approx(load["value"])
    assert {"config.yaml", "residuals.csv", "identified.png"} <= {
        path.name for path in (tmp_path / "run").rglob("*") if path.is_file()
    }
    (tmp_path / "other.csv").write_text("rotation_deg,contact_force\n0,1\n")
    for wrong, said in (
        (["--data", "none.csv", "--fit", f"{BACKLASH}=0:1"], "must be a file that can be read"),
        (["--data", "other.csv", "--fit", f"{BACKLASH}=0:1"], "did you mean contact_force_N?"),
        (["--data", "record.csv"], "`--fit` is missing"),
        (["--data", "record.csv", "--fit", "backlash=0:1"], "did you mean"),
        (["--data", "record.csv", "--fit", f"{BACKLASH}=0:1", "--gain", "x"], "is that of x"),
        (["--data", "record.csv", "--fit", f"{BACKLASH}=0:1", "--profile", "x"], "a fitted key"),
    ):
        assert command.main(["cic", "-o", "wrong", *wrong]) == 2
        (message,) = capsys.readouterr().err.splitlines()
        assert said in message
    # A load of no use for a record of another size ends without a usable fit.
    (tmp_path / "other.csv").write_text("mean_force_N,mean_force_N_std\n1e6,1\n")
    options = ["--data", "other.csv", "-o", "none", "--no-figures"]
    assert command.main([*quick, *options, "--fit", f"{BACKLASH}=0.1:0.12"]) == 3
    assert json.loads((tmp_path / "none" / "result.json").read_text())["status"] == "not_identified"


def test_function_and_door_share_a_name():
    assert importlib.import_module("rootsopt.identify") is rootsopt.identify
