"""Tests of local search and certificate on problems with known optimum and multipliers."""

import numpy as np
import pytest

from rootsopt.optimize.local import Group, Linearization, Models, certify
from rootsopt.optimize.sqp import Stops, descend


def group(values, slopes):
    """Return a group of branches of one kind, distinguished by evenly spaced phases."""
    return Group(
        np.array([[0.0, place / len(values)] for place in range(len(values))]),
        np.asarray(values, float),
        np.asarray(slopes, float),
    )


def smooth(x):
    """Return the problem (x - 0.9)² + 2 (y - 0.8)² with x + y ≤ 1."""
    bend, away = np.array([1.0, 2.0]), x - np.array([0.9, 0.8])
    slack, normals = np.array([1 - x.sum()]), -np.ones((1, 2))
    return Linearization(bend @ away**2, 2 * bend * away, (), slack, normals)


def corner(x, lift=0.0):
    """Return the greater of two paraboloids, the first lifted; its minimum has a corner."""
    bends = np.array([[1.0, 1.0], [1.0, 2.0]])
    away = x - np.array([[0.2, 0.3], [0.8, 0.5]])
    values = np.sum(bends * away**2, axis=1) + np.array([lift, 0.0])
    return Linearization(
        0.0, np.zeros(2), (group(values, 2 * bends * away),), np.zeros(0), np.zeros((0, 2))
    )


def test_multiplier_of_a_constraint_is_the_price_of_its_limit():
    """By hand, x - 0.9 = -μ/2, y - 0.8 = -μ/4 and x + y = 1, so μ = 14/15."""
    found = descend(smooth, np.array([0.1, 0.1]))
    assert found.reason == "converged"
    assert found.certificate.multipliers == pytest.approx([14 / 15], abs=1e-6)
    np.testing.assert_allclose(found.point, [0.9 - 7 / 15, 0.8 - 7 / 30], atol=1e-6)


@pytest.mark.parametrize("start", [[0.1, 0.9], [0.9, 0.1], [0.5, 0.5], [0.0, 0.0]])
def test_converges_to_a_corner_of_the_objective(start):
    """Both branches are equal at the corner, and their shares make the gradient zero."""
    found = descend(corner, np.array(start))
    assert found.reason == "converged"
    assert found.evaluations < 20
    (values,) = (g.values for g in found.local.groups)
    assert values[0] == pytest.approx(values[1], abs=1e-9)
    (shares,) = found.certificate.shares
    assert min(shares) > 0.1
    x, y = np.meshgrid(*[np.linspace(0, 1, 801)] * 2)
    first, second = (x - 0.2) ** 2 + (y - 0.3) ** 2, (x - 0.8) ** 2 + 2 * (y - 0.5) ** 2
    assert found.local.objective <= np.min(np.maximum(first, second)) + 1e-9
    # A share is the slope of the optimum when its branch is lifted.
    up, down = (
        descend(lambda x, s=s: corner(x, s), np.array(start)).local.objective for s in (1e-4, -1e-4)
    )
    assert (up - down) / 2e-4 == pytest.approx(shares[0], abs=1e-3)


def test_a_stationary_point_that_is_worse_is_not_the_result():
    """Beyond x = 0.33 lies a shelf at 3, where the gradient vanishes, but the start was better."""
    seen = []

    def look(x):
        value, slope = (3.0, 0.0) if x[0] > 0.33 else (-100 * (x[0] - 0.3), -100.0)
        seen.append(value)
        return Linearization(value, np.array([slope, 0.0]), (), np.zeros(0), np.zeros((0, 2)))

    assert descend(look, np.array([0.3, 0.5])).local.objective == min(seen) < 0
    assert 3.0 in seen


def test_reasons_of_an_early_end():
    start = np.array([0.1, 0.9])
    few = descend(corner, start, Stops(evaluations=2))
    assert (few.reason, few.evaluations) == ("evaluations", 2)
    assert descend(corner, start, Stops(asked=lambda: True)).reason == "interrupted"
    found = descend(lambda x: smooth(x)._replace(slope=-smooth(x).slope), start)
    assert found.reason != "converged"


def test_steps_that_fail_do_not_count_as_convergence():
    """The objective falls by 0.1 per unit box, but every step fails, as if by a wrong gradient.

    The trust region shrinks until its own decrease is negligible. The decrease in the whole
    neighbourhood is not."""

    def look(x):
        value = 1 + (10 * abs(x[0] - 0.5) if x[0] != 0.5 else 0)
        return Linearization(value, np.array([-0.1, 0.0]), (), np.zeros(0), np.zeros((0, 2)))

    found = descend(look, np.array([0.5, 0.5]))
    assert found.reason == "no_progress"
    assert found.promised > 1e-3


def between(x):
    """Return a problem with x ≥ 0.8 and x ≤ 0.2: one limit is violated by 0.3 at least."""
    slack, normals = np.array([x[0] - 0.8, 0.2 - x[0]]), np.array([[1.0, 0], [-1.0, 0]])
    return Linearization(x[1], np.array([0.0, 1.0]), (), slack, normals)


def beside(kind, gap):
    """Return a linear problem and a point at a distance `gap` from the limit that stops it.

    The objective falls by 2 per unit of the way to the limit. `branch`: the other branch of a
    maximum; each rises by 4 where the other falls."""
    free = Linearization(0.0, np.array([2.0, 0.0]), (), np.zeros(0), np.zeros((0, 2)))
    falls, far = np.array([[-1.0, 0.0]]), group([-0.5], [[-1.0, 0.0]])
    both = group([1.0, 1.0 - 4 * gap], [[2.0, 0], [-2.0, 0]])
    place, changes = {
        "lower bound": (gap, {}),
        "upper bound": (1 - gap, {"slope": -free.slope}),
        "constraint": (0.4, {"slack": np.array([gap]), "normals": -falls}),
        "cap": (0.4, {"caps": (group([-gap], falls), far)}),
        "branch": (0.4, {"slope": np.zeros(2), "groups": (both,)}),
    }[kind]
    return free._replace(**changes), np.array([place, 0.5])


@pytest.mark.parametrize("kind", ["lower bound", "upper bound", "constraint", "cap", "branch"])
def test_residual_counts_what_a_step_onto_the_limit_would_gain(kind):
    """A multiplier makes the gradient vanish beside a limit, too: only on it is the optimum.

    For linear functions, multiplier times distance is what is left to gain."""
    near, on, away = (certify(*beside(kind, gap)).residual for gap in (2e-5, 0.0, 0.1))
    assert near == pytest.approx(4e-5, rel=1e-3)
    assert on < 1e-10
    # A limit that is far away stops nothing: the whole gradient is left.
    assert away == pytest.approx(2, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_models_of_quadratic_functions_are_exact(seed):
    """The functions of six variables are one smooth part, three branches, and two constraints. The
    models are exact in whatever order the branches are listed at each point."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(6, 6, 6)) * np.sqrt(0.5)
    hessians = roots @ np.swapaxes(roots, 1, 2)
    hessians[-2:] *= -1
    centers, slopes = rng.uniform(0.3, 0.7, (2, 6, 6))
    lift = np.array([0.0, 0.0, 0.0, 0.0, 1.2, 1.2])

    def look(x, order=(0, 1, 2)):
        away = x - centers
        bent = np.einsum("kij,kj->ki", hessians, away)
        values = np.einsum("ki,ki->k", slopes + bent / 2, away) + lift
        rows, order = slopes + bent, np.array(order)
        tags = np.stack([np.zeros(3), 0.1 + 0.3 * order], axis=1)
        maxima = Group(tags, values[1 + order], rows[1 + order])
        return Linearization(values[0], rows[0], (maxima,), values[4:], rows[4:])

    rng = np.random.default_rng(seed)
    point = rng.uniform(0.2, 0.8, 6)
    models = Models(point, look(point))
    models.measure(lambda x: look(x, rng.permutation(3)))
    np.testing.assert_allclose(models.hessians, hessians, atol=1e-8)
    step = rng.uniform(-0.1, 0.1, 6)
    expected = look(point + step)
    value, slope = models.values(step)
    np.testing.assert_allclose(value[1:4], expected.groups[0].values, atol=1e-9)
    np.testing.assert_allclose(slope[4:], expected.normals, atol=1e-8)


def valley(x):
    """Return a curved valley (Rosenbrock) whose floor falls by 3e-4 per unit box, with a curved
    limit of the geometry across it."""
    u, v = 2 * x[0] - 1, 2 * x[1] - 1
    value = 1 + 3 * (v - u**2) ** 2 + 3e-4 * (1 - u) ** 2
    slope = 2 * np.array([-12 * u * (v - u**2) - 6e-4 * (1 - u), 6 * (v - u**2)])
    return Linearization(value, slope, (), np.array([1.2 - x[0] ** 2 - x[1] ** 2]), -2 * x[None])


def stiff(x):
    """Return a steep function: 1e-9 above its minimum, the slope is still 1e-3 per unit box."""
    away = 20 * (x - 0.4)
    value, slope = 1 + np.sum(np.cosh(away) - 1), 20 * np.sinh(away)
    return Linearization(value, slope, (), np.zeros(0), np.zeros((0, 2)))


def saddle(x):
    """Return a function whose gradient vanishes at (0.5, 0.5), a saddle."""
    bend = np.array([1, -0.1])
    away = x - 0.5
    return Linearization(1 + bend @ away**2, 2 * bend * away, (), np.zeros(0), np.zeros((0, 2)))


def waves(seed):
    """Return a function with corners between waves, and curved limits of the geometry."""
    rng = np.random.default_rng(seed)
    turns, shifts = rng.normal(size=(4, 4)) * 3, rng.uniform(0, 6, 4)
    hessians, centre = rng.uniform(0.5, 2, (2, 4)), rng.uniform(0.2, 0.8, (2, 4))

    def look(x):
        phase = turns @ x + shifts
        values, slopes = 1 + 0.2 * np.sin(phase), 0.2 * np.cos(phase)[:, None] * turns
        away = x - centre
        slack, normals = 0.02 - np.sum(hessians * away**4, axis=1), -4 * hessians * away**3
        return Linearization(0.0, np.zeros(4), (group(values, slopes),), slack, normals)

    return look


@pytest.mark.parametrize(
    ("look", "start"),
    [(valley, [0.9, 0.1]), (stiff, [0.9, 0.1]), (stiff, [0.41, 0.37]),
     (saddle, [0.9, 0.5]), (saddle, [0.5, 0.5]),
     *((waves(seed), [0.4, 0.5, 0.6, 0.5]) for seed in range(2))],
)  # fmt: skip
@pytest.mark.parametrize("known", [False, True])
def test_a_converged_search_has_the_value(look, start, known):
    """No point nearby is lower by more than 1e-5, and the first-order conditions hold.

    These alone say little: in a flat valley and at a saddle, the residual is small far from the
    minimum."""
    limits = (lambda x: (look(x).slack, look(x).normals)) if known else None
    found = descend(look, np.array(start), Stops(evaluations=150), limits)
    assert found.reason == "converged"
    assert found.promised <= 3e-6
    assert found.certificate.residual <= 1e-4
    assert found.local.violation <= 1e-6
    # Random feasible points, from near to far.
    rng = np.random.default_rng(1)
    scales = 0.05 * 10 ** rng.uniform(-4, 0, (1000, 1))
    points = np.clip(found.point + scales * rng.uniform(-1, 1, (1000, len(start))), 0, 1)
    near = [one.objective for one in map(look, points) if one.violation <= 0]
    assert found.local.objective <= min(near) + 1e-5


def test_constraints_of_the_geometry_are_met_exactly():
    """All steps stay feasible along a curved edge, which models of the constraint leave.

    Only the designs beside the optimum that measure the Hessians may violate it."""
    seen, truth = [], waves(1)

    def look(x):
        seen.append(truth(x))
        return seen[-1]

    found = descend(look, np.array([0.4, 0.5, 0.6, 0.5]), None, lambda x: truth(x)[3:5])
    assert found.reason == "converged"
    assert max(found.certificate.multipliers) > 0
    assert sum(one.violation > 1e-9 for one in seen) <= 4


def walled(x, limit=0.35, lift=0.0):
    """(x - 0.9)² + (y - 0.8)², where two branches must be at most `limit`, scaled by it."""
    away = x - np.array([0.9, 0.8])
    values = np.array([x[0] ** 2 + x[1] + lift, x[0] + x[1] ** 2 + lift])
    cap = group(values / limit - 1, np.array([[2 * x[0], 1.0], [1.0, 2 * x[1]]]) / limit)
    return Linearization(away @ away, 2 * away, (), np.zeros(0), np.zeros((0, 2)), (cap,))


@pytest.mark.parametrize("start", [[0.1, 0.1], [0.9, 0.8], [0.0, 1.0]])
def test_walls_are_limits_of_maxima(start):
    """The optimum lies on the corner of the cap, that of a grid by formulas, and the multiplier is
    the price of the limit, found by solving again."""
    found = descend(walled, np.array(start))
    assert found.reason == "converged"
    assert found.evaluations < 40
    (cap,), (held,) = found.local.caps, found.certificate.caps
    np.testing.assert_allclose(cap.values, 0, atol=1e-7)
    assert min(held) > 0.01
    x, y = np.meshgrid(*[np.linspace(0, 1, 1201)] * 2)
    inside = np.maximum(x**2 + y, x + y**2) <= 0.35
    grid = np.min(np.where(inside, (x - 0.9) ** 2 + (y - 0.8) ** 2, np.inf))
    assert grid - 3e-3 <= found.local.objective <= grid + 1e-9
    up, down = (
        descend(lambda x, s=s: walled(x, 0.35 + s), np.array(start)).local.objective
        for s in (1e-4, -1e-4)
    )
    assert (down - up) / 2e-4 == pytest.approx(np.sum(held) / 0.35, rel=1e-3)


@pytest.mark.parametrize(
    ("look", "start", "least"),
    [(between, [0.1, 0.9], 0.3), (lambda x: walled(x, lift=1.0), [0.5, 0.5], 1 / 0.35 - 1)],
)
def test_limits_that_cannot_be_met_are_infeasible(look, start, least):
    found = descend(look, np.array(start))
    assert found.reason == "infeasible"
    assert found.evaluations < 200
    assert found.local.violation == pytest.approx(least, rel=1e-2)
    assert not found.certificate.holds(1e9, 1e-6)
