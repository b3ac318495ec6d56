"""Tests of the lower bound of all designs: made-up problems of several basins, and real ones."""

import functools
import math

import numpy as np
import pytest

from rootsopt import load_config
from rootsopt.optimize import bounding
from rootsopt.optimize.local import FEASIBLE, Group, Linearization
from rootsopt.optimize.search import Search
from tests.optimize.test_search import searching


class Made:
    """Objective max over branches of wells, and a ball that designs must keep within or out of.

    A `jump` lowers the objective where the first coordinate is above it; designs within 0.1 of a
    `hole` are not usable."""

    def __init__(self, seed: int, jump: float = math.inf, hole: float = math.inf):
        rng = np.random.default_rng(seed)
        self.size, self.jump, self.hole = 1 + seed % 3, jump, hole
        self.branches = [
            (rng.random((count, self.size)), rng.uniform(0.12, 0.4, count),
             rng.uniform(0.1, 0.5, count), 0.2 * rng.normal(size=self.size))
            for count in rng.integers(2, 6, rng.integers(1, 4))
        ]  # fmt: skip
        self.sign, self.middle = rng.choice([-1.0, 0.0, 1.0]), rng.random(self.size)
        self.square = (0.35 if self.sign < 0 else 0.08) * self.size

    def values(self, points):
        """Return the branches (k, n) and their gradients (k, n, d) at points (n, d)."""
        values, slopes = [], []
        for centers, widths, depths, tilt in self.branches:
            away = points[:, None] - centers
            wells = depths * np.exp(-0.5 * np.sum(away**2, axis=2) / widths**2)
            values.append(1 - wells.sum(axis=1) + points @ tilt)
            slopes.append(np.einsum("nk,nkd->nd", wells / widths**2, away) + tilt)
        return np.array(values) - 0.1 * (points[:, 0] > self.jump), np.array(slopes)

    def limits(self, point):
        away = point - self.middle
        slack = self.sign * (away @ away - self.square) + (self.sign == 0)
        return np.array([slack]), 2 * self.sign * away[None]

    def local(self, point):
        values, slopes = (one[:, 0] for one in self.values(point[None]))
        group = Group(np.zeros((len(values), 2)), values, slopes)
        return Linearization(0.0, np.zeros(self.size), (group,), *self.limits(point))

    def truth(self, point):
        point = np.asarray(point)
        usable = np.max(np.abs(point - self.hole)) > 0.1
        return self.local(point).objective if usable else math.nan

    @functools.cached_property
    def least(self) -> float:
        """Least feasible objective, on a grid and on finer ones around its best points."""
        points, first = np.full((1, self.size), 0.5), {1: 1001, 2: 101, 3: 25}[self.size]
        finer = ((half, 11) for half in (0.03, 0.006, 1.2e-3, 2.4e-4, 5e-5))
        for half, count in ((0.5, first), *finer):
            axis = np.linspace(-half, half, count)
            steps = np.stack(np.meshgrid(*[axis] * self.size), axis=-1).reshape(-1, self.size)
            points = np.concatenate([np.clip(one + steps, 0.0, 1.0) for one in points])
            away = np.sum((points - self.middle) ** 2, axis=1) - self.square
            points = points[(self.sign == 0) | (self.sign * away >= 0)]
            top = np.max(self.values(points)[0], axis=0)
            order = np.argsort(top)
            points = points[order[:20]]
        return float(top[order[0]])


def bounded(made: Made):
    """Return (bound, best objective found before it, and with it) of a made-up problem.

    A search begins at one random feasible point, so that it often ends in a wrong basin."""
    search = searching(made.truth, prove=True, iterations=60)
    search.noisy = False
    vars(search.problem).update(
        feasible=lambda point: bool(made.limits(point)[0] >= -FEASIBLE),
        toward=lambda point, inside: np.clip(point, 0.0, 1.0),
        limits_at=made.limits,
        local=lambda one, point: made.local(point) if one.usable else None,
    )
    drawn = np.random.default_rng(1).random((100, made.size))
    start = next(x for x in drawn if search.problem.feasible(x) and abs(x[0] - made.hole) > 0.2)
    trials = search._solve(0, start)
    before = min(one.objective for one in trials if one.candidate)
    found, further = search._bounded(trials, 1)
    best = min(one.objective for one in [*trials, *further] if one.candidate)
    return (None if found is None else found.bound(best)), before, best


@pytest.mark.parametrize(
    ("seeds", "sure", "begun"),
    [(range(5), 5, 1), pytest.param(range(9, 59), 45, 10, marks=pytest.mark.long)],
)
def test_a_wrong_basin_is_never_proven(seeds, sure, begun):
    """Problems of one to three parameters, with corners and limits, against grids.

    `sure`, `begun`: how many at least are proven, and begin in a wrong basin."""
    proven = wrong = 0
    for seed in seeds:
        made = Made(seed)
        bound, before, best = bounded(made)
        assert best >= made.least - 1e-4
        assert bound.lower_bound <= made.least + 1e-5, seed
        assert not bound.proven or best <= made.least + 1.2e-4 * max(1.0, abs(best)), seed
        proven, wrong = proven + bound.proven, wrong + (before > made.least + 1e-3)
    assert proven >= sure
    assert wrong >= begun


def proven(found, local, starts):
    """Return the bound, which must be proven, and the numbers of designs that were asked for."""
    points, asked = starts, []
    while points:
        for point in points:
            found.tell(point, local(point))
        points = found.ask(8)
        asked.append(len(points))
    bound = found.bound(found.best)
    assert bound.proven
    return bound, asked


def test_jumps_and_holes_are_counted():
    """A bound is not proven if the motion jumps, or if the best designs have no usable one."""
    made = Made(0, jump=0.8)
    bound, _, best = bounded(made)
    assert bound.jumps > 0
    assert not bound.proven or best <= made.least + 1.2e-4
    points = np.linspace(0, 1, 1001)
    least = points[np.argmin(np.max(Made(6).values(points[:, None])[0], axis=0))]
    bound, _, _ = bounded(Made(6, hole=least))
    assert bound.unusable > 0
    assert not bound.proven
    assert 0.02 < bound.volume_left < 0.22


def test_a_limited_force_is_bounded_too():
    """Minorants of a limit exclude what violates it: least of x + y on a circle's outside.

    The least is at the corner of the box and the circle that the limit cuts out."""

    def local(point):
        cap = Group(np.zeros((1, 2)), np.array([0.16 - point @ point]), -2 * point[None])
        free = np.ones(1), np.zeros((1, 2))
        return Linearization(float(point.sum()), np.ones(2), (), *free, (cap,))

    bound, _ = proven(
        bounding.Bounding(lambda point: (np.ones(1), np.zeros((1, 2))), 2, 0.4),
        local,
        [*np.array([[0.4, 0.0], [0.9, 0.9], [0.1, 0.6]])],
    )
    assert bound.lower_bound == pytest.approx(0.4, abs=1e-4)


def wave(y):
    return 0.05 * np.cos(3 * np.pi * y) + 0.1 * y


def test_limits_that_grow_without_bound_are_no_obstacle():
    """A limit like an undercut margin: -∞ beside the designs that cannot be made, NaN beyond."""

    def limits(point):
        edge = point[0] - 0.3 - 0.2 * point[1]
        edge = edge if edge > 0 else np.nan
        return np.array([1 - 0.05 / edge]), 0.05 / edge**2 * np.array([[1.0, -0.2]])

    def local(point):
        x, y = point
        slope = np.array([0.3, 0.1 - 0.15 * np.pi * np.sin(3 * np.pi * y)])
        return Linearization(0.3 * x + wave(y), slope, (), *limits(point))

    start, y = np.array([0.9, 0.9]), np.linspace(0, 1, 10_001)
    least = np.min(0.3 * (0.35 + 0.2 * y) + wave(y))
    found = bounding.Bounding(limits, 2, local(start).objective, boxes=1000)
    assert proven(found, local, [start])[0].lower_bound == pytest.approx(least, abs=2e-5)


@pytest.mark.parametrize("width", [pytest.param(1e-3, marks=pytest.mark.long), 1e-4])
def test_a_thin_feasible_set_is_searched_too(width):
    """Designs within `width` of a curved surface, against grids; hardly a drawn one is feasible."""

    def limits(point):
        away, normal = point[0] - 0.2 - 0.5 * point[1] ** 2, np.array([1.0, -point[1], 0.0])
        return np.array([width - away, width + away]) / width, np.array([-normal, normal]) / width

    def local(point):
        assert np.min(limits(point)[0]) >= -FEASIBLE
        slope = 0.1 - 0.15 * np.pi * np.sin(3 * np.pi * point)
        slope[0] = 0.3
        return Linearization(0.3 * point[0] + np.sum(wave(point[1:])), slope, (), *limits(point))

    start, y = np.array([0.325, 0.5, 0.5]), np.linspace(0, 1, 100_001)
    least = np.min(0.3 * (0.2 + 0.5 * y**2 - width) + wave(y)) + np.min(wave(y))
    bound, asked = proven(bounding.Bounding(limits, 3, local(start).objective), local, [start])
    assert asked[0] == 8
    assert bound.evaluations < 150
    assert bound.lower_bound == pytest.approx(least, abs=2e-5)


def test_minorants_hold_across_a_corner_that_bends_downwards():
    """A roof: in small boxes minorants are below it, and the best is close to it.

    They may be too high by the bend over half the distance of two points, here at most 2.5e-3."""

    def roof(x):
        return -5 * np.abs(x - 0.5)

    rng, surface = np.random.default_rng(0), bounding.Surface(1)
    for x in rng.uniform(0.48, 0.52, 160):
        surface.add(np.array([x]), (np.array([roof(x)]), np.array([[5.0 if x < 0.5 else -5.0]])))
    assert surface.jumps > 0
    lows = []
    for middle, half in rng.uniform((0.496, 1e-5), (0.504, 2e-4), (200, 2)):
        values, slopes = surface.within(
            bounding.Box(0.0, 0, np.array([middle]), np.array([half]), np.zeros(1), 0)
        )
        steps = np.linspace(-half, half, 21)
        least = np.max(values[:, None] + slopes * steps, axis=0) - 0.5 * surface.curved * steps**2
        assert np.all(least <= roof(middle + steps) + 2.5e-3)
        lows.append(np.min(roof(middle + steps) - least))
    assert np.max(lows) < 0.01


@pytest.mark.long
def test_the_bound_of_a_real_problem_holds():
    """No design of a sample, simulated from rest, is below the bound; a few touch the optimum.

    The problem has two parameters. Searches with other seeds find the same optimum."""
    few = "profile.tip_arc_angle_deg=2.0", "optimizer.bounds.tip_arc_angle_deg=[1.99, 2.01]"
    optima = []
    for seed in (4, 3, 2, 1, 0):
        search = Search(
            load_config("cic_drawn", (*few, f"optimizer.seed={seed}", "optimizer.prove=true"))
        )
        found = search.run()
        bound = found.optimality.bound
        assert bound.proven
        optima.append(found.optimality.optima[0].objective)
    assert np.ptp(optima) < 1e-6
    assert bound.record()["assumption"] == bound.assumption
    assert "unseen" not in found.optimality.record()
    rng, inside = np.random.default_rng(0), found.problem.point([*found.optimized.design.values()])
    points = [*rng.random((12, 3)), *np.clip(inside + 0.05 * rng.normal(size=(12, 3)), 0, 1)]
    values = []
    for point in map(found.problem.project, points):
        assert found.problem.feasible(point)
        values.append(
            found.problem.objective(search.exact(found.problem.design(point), series=False))
        )
    assert bound.lower_bound <= min(values) < bound.lower_bound + 0.05
