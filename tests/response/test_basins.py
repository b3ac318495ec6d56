"""Coexisting motions: attractors, basins, and objectives over all of them."""

import csv
import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import Status, load_config
from rootsopt.commands.console import main
from rootsopt.dynamics.flow import strobe
from rootsopt.dynamics.integrator import Integrator
from rootsopt.response.attractors import find
from rootsopt.response.evaluation import Evaluator, evaluate
from rootsopt.runtime.programs import CachedFunction

COEXIST = (
    "scene.timing_gear.backlash_mm=0.2",
    "scene.timing_gear.damping_ratio=0.2",
    "scene.speed_rpm=6000",
)
GRID = "attractors.relatives=3", "attractors.rates=3"
FORCES = ("mean_force_N", "peak_force_N", "rms_force_N")


def config_of(*overrides):
    return load_config("configs/cic_drawn.yaml", [*GRID, *overrides])


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
    assert max(peaks) > 1.5 * min(peaks)
    shares = [one.share for one in basins.attractors]
    assert sum(shares) == pytest.approx(1)
    assert shares == sorted(shares, reverse=True)
    (reached,) = (one.evaluation for one in basins.attractors if one.reached)
    assert reached.response == pytest.approx(evaluate(evaluator.config).response, rel=1e-9)
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
        assert max(np.max(np.min(apart, axis=k)) for k in (0, 1)) < 1e-3
        reached.add(number)
    assert len(reached) > 1


def test_a_known_motion_is_not_lost_on_a_coarse_grid(coexisting):
    """One initial state finds one motion; a state given on another motion adds that one."""
    _, basins = coexisting
    small = Evaluator.of(config_of(*COEXIST, "attractors.relatives=1", "attractors.rates=1"))
    assert len(find(small).attractors) < len(basins.attractors)
    together = find(small, known=[one.evaluation.state for one in basins.attractors])
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
    worst, mean = (
        Evaluator.of_objective(config_of(*settings, f"objective.motion={motion}"))()
        for motion in ("worst", "weighted")
    )
    assert worst.response["peak_force_N"] == max(r["peak_force_N"] for r in responses)
    for name in FORCES:
        expected = shares @ [r[name] for r in responses]
        assert mean.response[name] == pytest.approx(expected, rel=1e-9)
        slopes = [[*one.evaluation.gradient[name].values()] for one in basins.attractors]
        assert [*mean.gradient[name].values()] == pytest.approx(shares @ slopes, rel=1e-6)
    assert len(mean.steady_state["attractors"]) == len(shares)
    assert mean.start.shape == (len(shares), 2)


def test_the_reference_decides_which_is_worst(coexisting, monkeypatch):
    """The worst motion depends on the reference forces.

    Relative to a tiny mean force, the motion of the greatest mean is worst, not that of the
    greatest peak."""
    _, basins = coexisting
    responses = [dict(zip(FORCES, row, strict=True)) for row in ((2.0, 3.0, 2.0), (1.0, 4.0, 2.0))]
    made = tuple(
        dataclasses.replace(one, evaluation=dataclasses.replace(one.evaluation, response=response))
        for one, response in zip(basins.attractors, responses, strict=False)
    )
    monkeypatch.setattr(
        "rootsopt.response.attractors.find",
        lambda *_, **__: dataclasses.replace(basins, attractors=made),
    )
    evaluator = Evaluator.of_objective(config_of(*COEXIST, "objective.motion=worst"))
    for forces, worst in (((1e-3, 1e6, 1.0), 0), ((1e6, 1e-3, 1.0), 1)):
        base = dataclasses.replace(basins.rest, response=dict(zip(FORCES, forces, strict=True)))
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
    assert (found.status, found.usable, found.gradient) == (Status.CHAOTIC, False, {})
    assert {row["status"] for row in found.steady_state["attractors"]} == {"periodic", "chaotic"}


def test_a_motion_that_is_not_told_is_no_steady_state(coexisting):
    """A motion that is lost makes the status not periodic; a failure takes precedence."""
    _, basins = coexisting

    for lost, status in (
        ({}, Status.PERIODIC),
        ({"not_settled": 0.01}, Status.NOT_SETTLED),
        ({"not_settled": 0.5, "solver_failed": 0.1}, Status.SOLVER_FAILED),
        ({"non_finite": 0.1}, Status.NON_FINITE),
    ):
        assert dataclasses.replace(basins, lost=lost).status is status
    first, *others = basins.attractors
    wild = dataclasses.replace(first.evaluation, status=Status.CHAOTIC)
    mixed = dataclasses.replace(first, evaluation=wild), *others
    assert dataclasses.replace(basins, attractors=mixed).status is Status.CHAOTIC


def test_command(tmp_path, capsys):

    def run(folder, *keys, options=()):
        sets = (f"--set={key}" for key in (*GRID, *keys))
        code = main(["attractors", "configs/cic_drawn.yaml", *sets, "-o", str(folder), *options])
        record = json.loads((folder / "result.json").read_text())
        return code, record["status"], record["attractors"]

    *ending, attractors = run(tmp_path, *COEXIST)
    assert ending == [0, "periodic"]
    assert "Coexisting motions" in capsys.readouterr().out
    with open(tmp_path / "basins.csv", newline="") as file:
        numbers = [int(row["attractor"]) for row in csv.DictReader(file)]
    assert len(numbers) == 9
    counts = [numbers.count(k + 1) for k in range(len(attractors))]
    assert [9 * one["share"] for one in attractors] == pytest.approx(counts)
    assert (tmp_path / "figures" / "basins.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "response_2.csv").exists()
    weak = "scene.timing_gear.stiffness_N_m_per_rad=1", "scene.load.torque_N_m=40"
    assert run(tmp_path / "lost", *weak, options=["--no-figures"]) == (3, "passed_through", [])
