"""Scenes evaluated as one batch are those evaluated one by one."""

import threading
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import rootsopt
from rootsopt.response import together
from rootsopt.response.evaluation import Evaluator, _motion
from rootsopt.response.sweeps import points
from rootsopt.response.sweeps.points import simulated, simulated_together

SPEED, LOAD, ANGLE = "scene.speed_rpm", "scene.load.torque_N_m", "profile.pressure_angle_deg"
POINTS = [{SPEED: 2000.0}, {ANGLE: 5.0}, {SPEED: 3000.0}, {LOAD: 3000.0}]


@pytest.fixture(scope="module")
def config() -> rootsopt.Config:
    return rootsopt.load_config("cic_drawn")


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
    broken = mock.Mock(side_effect=MemoryError)
    monkeypatch.setattr(points, "evaluate_together", broken)
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
