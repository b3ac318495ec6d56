"""Coexisting motions: attractors, basins, and objectives over all of them."""

import csv
import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.commands.console import main
from rootsopt.config import load
from rootsopt.dynamics.flow import strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.response.attractors import find
from rootsopt.response.evaluation import Evaluator, evaluate
from rootsopt.runtime.programs import CachedFunction
from rootsopt.status import Status

COEXIST = (
    "scene.timing_gear.backlash_mm=0.2",
    "scene.timing_gear.damping_ratio=0.2",
    "scene.speed_rpm=6000",
)
WEAK = "scene.timing_gear.stiffness_N_m_per_rad=1", "scene.load.torque_N_m=40"
GRID = "attractors.relatives=3", "attractors.rates=3"
FORCES = ("mean_force_N", "peak_force_N", "rms_force_N")


def config_of(*overrides):
    return load("configs/cic_drawn.yaml", [*GRID, *overrides])


@pytest.fixture(scope="module")
def coexisting():
    """Return evaluator and basins of a scene with a quiet and noisy motions."""
    evaluator = Evaluator.of(config_of(*COEXIST))
    return evaluator, find(evaluator, series=True)


long_run = CachedFunction(lambda pair, state, how: strobe(pair, state, 48, how).states)


def test_motions_that_coexist_are_told_apart(coexisting):
    """There are at least two stable orbits of different force, and their shares add up to 1.

    The one reached is that of the plain evaluation."""
    evaluator, basins = coexisting
    assert basins.status is Status.PERIODIC
    peaks = [one.evaluation.response["peak_force_N"] for one in basins.attractors]
    assert len(peaks) >= 2
    assert max(peaks) > 1.5 * min(peaks)
    shares = [one.share for one in basins.attractors]
    assert sum(shares) == pytest.approx(1)
    assert shares == sorted(shares, reverse=True)
    (reached,) = (one.evaluation for one in basins.attractors if one.reached)
    plain = evaluate(evaluator.config).response
    assert {name: reached.response[name] for name in plain} == pytest.approx(plain, rel=1e-9)
    counts = np.bincount(basins.leads_to.ravel(), minlength=len(shares))
    assert counts / basins.leads_to.size == pytest.approx(shares)
    for one in basins.attractors:
        assert one.evaluation.steady_state["floquet_multiplier"] < 1
        assert len(one.cycle) == one.evaluation.steady_state["period"]


def test_initial_states_lead_where_a_long_simulation_ends(coexisting):
    """Cells of the grid lead to the attractor that a long simulation reaches.

    It runs for 48 mesh periods at another tolerance with another method."""
    evaluator, basins = coexisting
    pair = evaluator.pair(jnp.array([36.43, 9.0, 4.0]))
    how, reached = Integrator("dopri8", jnp.asarray(1e-9), 4096), set()
    for row, column in [(0, 0), (1, 1), (2, 1)]:
        start = jnp.array([basins.relative[column], basins.rate[row] * basins.mesh_period])
        ends = np.asarray(long_run(pair, start / basins.angle_scale, how))[-8:]
        number = int(basins.leads_to[row, column])
        apart = np.max(np.abs(ends[:, None] - basins.attractors[number].cycle[None]), axis=2)
        # Every point of the end lies on the cycle and every point of the cycle is visited.
        assert np.max(np.min(apart, axis=1)) < 1e-3
        assert np.max(np.min(apart, axis=0)) < 1e-3
        reached.add(number)
    assert len(reached) > 1


def test_a_known_motion_is_not_lost_on_a_coarse_grid(coexisting):
    """One initial state finds one motion; a state given on another motion adds that one."""
    _, basins = coexisting
    small = Evaluator.of(config_of(*COEXIST, "attractors.relatives=1", "attractors.rates=1"))
    alone = find(small)
    assert len(alone.attractors) < len(basins.attractors)
    others = [one.evaluation.state for one in basins.attractors]
    together = find(small, known=others)
    wanted, found = (
        np.array([one.evaluation.response["peak_force_N"] for one in some.attractors])
        for some in (basins, together)
    )
    assert np.all(np.min(np.abs(wanted[:, None] / found - 1), axis=1) < 1e-5)
    assert sum(one.share for one in together.attractors) == pytest.approx(1)


def test_worst_and_weighted(coexisting, monkeypatch):
    """The worst has the greatest weighted force, the weighted one averages by share."""
    _, basins = coexisting
    shares = np.array([one.share for one in basins.attractors])
    responses = [one.evaluation.response for one in basins.attractors]
    monkeypatch.setattr("rootsopt.response.attractors.find", lambda *_, **__: basins)
    settings = *COEXIST, "objective.mean_weight=0", "objective.peak_weight=1"
    worst = Evaluator.of_objective(config_of(*settings, "objective.motion=worst"))()
    assert worst.response["peak_force_N"] == max(r["peak_force_N"] for r in responses)
    weighted = config_of(*settings, "objective.mean_weight=1", "objective.motion=weighted")
    mean = Evaluator.of_objective(weighted)()
    for name in FORCES:
        expected = shares @ [r[name] for r in responses]
        assert mean.response[name] == pytest.approx(expected, rel=1e-9)
        gradients = [one.evaluation.gradient[name] for one in basins.attractors]
        for key, value in mean.gradient[name].items():
            assert value == pytest.approx(shares @ [g[key] for g in gradients], rel=1e-6)
    assert len(mean.steady_state["attractors"]) == len(shares)
    assert isinstance(mean.start, np.ndarray)
    assert mean.start.shape == (len(shares), 2)


def test_the_reference_decides_which_is_worst(coexisting, monkeypatch):
    """The worst motion depends on the reference forces.

    Relative to a tiny mean force, the motion of the greatest mean is worst, not that of the
    greatest peak."""
    _, basins = coexisting
    responses = [
        {"mean_force_N": mean, "peak_force_N": peak, "rms_force_N": 2.0}
        for mean, peak in ((2.0, 3.0), (1.0, 4.0))
    ]
    made = tuple(
        dataclasses.replace(one, evaluation=dataclasses.replace(one.evaluation, response=response))
        for one, response in zip(basins.attractors, responses, strict=False)
    )
    told = dataclasses.replace(basins, attractors=made)
    monkeypatch.setattr("rootsopt.response.attractors.find", lambda *_, **__: told)
    evaluator = Evaluator.of_objective(config_of(*COEXIST, "objective.motion=worst"))
    for mean, peak, worst in ((1e-3, 1e6, 0), (1e6, 1e-3, 1)):
        forces = {"mean_force_N": mean, "peak_force_N": peak, "rms_force_N": 1.0}
        base = dataclasses.replace(basins.rest, response=forces)
        assert evaluator.relative_to(base)(series=False).response == responses[worst]


def test_a_chaotic_basin_is_no_steady_state():
    """Some initial states lead to chaos: the objective over all motions has no gradient."""
    scene = (
        "scene.timing_gear.backlash_mm=0.1",
        "scene.timing_gear.damping_ratio=0.05",
        "scene.load.torque_N_m=2",
        "scene.speed_rpm=6000",
        "attractors.rates=1",
    )
    found = Evaluator.of_objective(config_of(*scene, "objective.motion=worst"))(series=False)
    assert found.status is Status.CHAOTIC
    assert not found.usable
    assert found.gradient == {}
    kinds = {row["status"] for row in found.steady_state["attractors"]}
    assert kinds == {"periodic", "chaotic"}


def test_a_motion_that_is_not_told_is_no_steady_state(coexisting):
    """A motion that is lost makes the status not periodic; a failure takes precedence."""
    _, basins = coexisting

    def status(**lost):
        return dataclasses.replace(basins, lost=lost).status

    assert status() is Status.PERIODIC
    assert status(not_settled=0.01) is Status.NOT_SETTLED
    assert status(not_settled=0.5, solver_failed=0.1) is Status.SOLVER_FAILED
    assert status(non_finite=0.1) is Status.NON_FINITE
    first, *others = basins.attractors
    wild = dataclasses.replace(first.evaluation, status=Status.CHAOTIC)
    mixed = dataclasses.replace(first, evaluation=wild), *others
    assert dataclasses.replace(basins, attractors=mixed).status is Status.CHAOTIC


def test_command(tmp_path, capsys):
    """The command writes table, result file, a CSV of basins that agrees with it, and a picture.

    The exit codes are checked too."""
    overrides = [f"--set={key}" for key in (*GRID, *COEXIST)]
    assert main(["attractors", "configs/cic_drawn.yaml", *overrides, "-o", str(tmp_path)]) == 0
    assert "Coexisting motions" in capsys.readouterr().out
    record = json.loads((tmp_path / "result.json").read_text())
    shares = [one["share"] for one in record["attractors"]]
    assert record["status"] == "periodic"
    assert len(shares) >= 2
    with open(tmp_path / "basins.csv", newline="") as file:
        numbers = [int(row["attractor"]) for row in csv.DictReader(file)]
    assert len(numbers) == 9
    assert [numbers.count(k + 1) / 9 for k in range(len(shares))] == pytest.approx(shares)
    assert (tmp_path / "figures" / "basins.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "response_2.csv").exists()
    weak = (f"--set={key}" for key in WEAK)
    lost = ["attractors", "configs/cic_drawn.yaml", *weak, *overrides[:2]]
    assert main([*lost, "-o", str(tmp_path / "lost"), "--no-figures"]) == 3
    record = json.loads((tmp_path / "lost" / "result.json").read_text())
    assert (record["status"], record["attractors"]) == ("passed_through", [])
