"""Tests of the distinct optima of several starts, and of the estimated number of unseen optima."""

import numpy as np
import pytest

from rootsopt.optimize.optimality import StartOutcome, distinct, unseen


def outcome(number, objective, *point):
    design = {"a": point[0]}
    return StartOutcome(number, objective, 1e-9, "converged", 10, design, np.array(point))


def test_optima_are_told_apart_by_objective_and_point():
    starts = [outcome(0, 0.9, 0.5), outcome(1, 0.8, 0.2), outcome(2, 0.8 + 1e-6, 0.2001)]
    found = distinct([*starts, outcome(3, 0.8, 0.9)])
    assert [(one.objective, one.found) for one in found] == [(0.8, 2), (0.8, 1), (0.9, 1)]
    # Two designs that agree in one parameter only are two.
    assert len(distinct([outcome(0, 0.8, 0.2, 0.1), outcome(1, 0.8, 0.2, 0.9)])) == 2


def test_unseen_optima_by_simulation():
    """The estimated share of unseen basins agrees with draws from the posterior of the formulas.

    The sizes are Dirichlet with a uniform prior for a known number of basins, averaged over many
    numbers."""
    expected = {"share_of_starts": 2 / 90, "expected_optima": 9 / 7}
    assert {key: unseen(10, 1)[key] for key in expected} == pytest.approx(expected)
    rng = np.random.default_rng(0)
    hidden, hits = 0.0, 0
    # Prior: any number of basins is equally likely (improper; cut at 60), sizes uniform.
    for _ in range(10_000):
        count = rng.integers(1, 61)
        sizes = rng.dirichlet(np.ones(count))
        seen = np.unique(rng.choice(count, 10, p=sizes))
        if len(seen) == 2:
            hits += 1
            hidden += 1 - sizes[seen].sum()
    assert hits > 100
    assert hidden / hits == pytest.approx(unseen(10, 2)["share_of_starts"], rel=0.2)
