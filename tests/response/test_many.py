"""Many points: their order, their errors, and where they are evaluated."""

import dataclasses
import pickle
import time

import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import IN_TURN, LocalRunner, Point, as_done, evaluate_many
from tests.standins import evaluation_of


def late(number, *_):
    """Stand in for an evaluator that takes the longer the earlier it is asked."""
    time.sleep(0.02 / (1 + number))
    return evaluation_of(float(number))


@pytest.mark.parametrize("runs", [IN_TURN, LocalRunner(3)])
def test_results_are_in_the_order_of_the_points(runs):
    done = []
    found = evaluate_many([Point(late, number) for number in range(7)], runs, done.append)
    assert [one.response["mean_force_N"] for one in found] == [*range(7)]
    assert done == [*range(1, 8)]
    assert evaluate_many([], runs) == []


@pytest.mark.parametrize("slots", [1, 3])
def test_points_are_taken_when_they_can_begin(slots):
    """No more are under way than can run, and an iterator that ends leaves out the rest."""
    taken, running, counts = [], set(), []

    def work(item):
        running.add(item)
        counts.append(len(running))
        time.sleep(0.005)
        running.remove(item)
        return -item

    def items():
        for number in range(8):
            assert len(running) < slots
            taken.append(number)
            yield number

    found = as_done(work, items(), slots)
    assert taken == []
    assert sorted(found) == [(k, -k) for k in range(8)]
    assert max(counts) == slots


@pytest.mark.parametrize("slots", [1, 3])
def test_an_error_is_raised_and_ends_the_rest(slots):
    begun = []

    def work(item):
        begun.append(item)
        if item == 2:
            raise ArithmeticError(item)
        time.sleep(0.01)
        return item

    with pytest.raises(ArithmeticError):
        [*as_done(work, range(100), slots)]
    assert len(begun) <= 2 + 2 * slots


@dataclasses.dataclass(frozen=True)
class Told(Evaluator):
    """Stand in for an evaluator: its force is the speed of its scene (rad/s)."""

    def reached(self, design=None, start=None, series=True):
        return evaluation_of(float(self.scene.speed), design=design)


class Away:
    """Runs points as if in another process: what a point refers to must travel."""

    slots = 2

    def __init__(self):
        self.asked = []

    def evaluated(self, point):
        self.asked.append(point)
        evaluator, *rest = pickle.loads(pickle.dumps(point))
        return evaluator(*rest)


def test_the_scenes_of_a_sample_travel():
    """They are evaluated where `runs` says, at all speeds, and as in this process."""
    config = load("cic_drawn", ["objective.speeds_rpm=[2000, 3000]"]).replaced(
        {"tolerances": {"over": {"scene.load.torque_N_m": {"uniform": 0.1}}, "samples": 3}}
    )
    runs, evaluator = Away(), Told.of_objective(config).surveying()
    found = evaluator.scattered(runs)()
    assert len(runs.asked) == 3
    assert all(not point.series for point in runs.asked)
    here = evaluator.scattered()()
    rows = [[part.evaluation.response for part in one.scenes] for one in (found, here)]
    assert rows[0] == rows[1]
    for sample in found.samples:
        speeds = [part.evaluation.response["mean_force_N"] for part in sample.evaluation.speeds]
        np.testing.assert_allclose(speeds, [200 * np.pi / 3, 100 * np.pi])
