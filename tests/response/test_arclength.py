"""Tests of following a curve through folds and corners, on curves with a closed form."""

import dataclasses
import itertools

import numpy as np
import pytest

from rootsopt.response.continuation.arclength import (
    End,
    Spot,
    StepSizes,
    StoppedError,
    follow_curve,
)


def curve_of(residual, jacobian):
    """Return the curve of one equation in (x, parameter), corrected by Newton's method."""

    def corrected(guess, across, near):
        place = guess
        for _ in range(20):
            matrix = np.array([jacobian(*place), across])
            miss = np.array([residual(*place), across @ (place - guess)])
            if np.max(np.abs(miss)) < 1e-12:
                tangent = np.linalg.svd(matrix[:1])[2][-1]
                return Spot(place, tangent, np.sign(np.linalg.det([matrix[0], tangent])), None)
            if abs(np.linalg.det(matrix)) < 1e-12:
                break
            place = place - np.linalg.solve(matrix, miss)
        raise StoppedError(End.STEP_TOO_SMALL)

    return corrected


CIRCLE = curve_of(lambda x, p: x**2 + p**2 - 1, lambda x, p: [2 * x, 2 * p])
CUBIC = curve_of(lambda x, p: p - x + x**3, lambda x, p: [3 * x**2 - 1, 1.0])
FOLD = {"FOLD": lambda spot: float(spot.tangent[-1])}


def start_of(curve, x, p, way=1.0):
    return curve(np.array([x, p]), np.array([0.0, 1.0]), None).along(np.array([0.0, way]))


def test_circle_is_closed_with_a_fold_on_either_side():
    """Every point lies on the circle, the folds are at ±1, and the curve ends at its start."""
    path = follow_curve(CIRCLE, start_of(CIRCLE, 1.0, 0.0), StepSizes(-2, 2, 0.02, 1e-6, 0.1), FOLD)
    assert path.end is End.CLOSED
    x, p = np.transpose([spot.place for spot in path.spots])
    np.testing.assert_allclose(np.hypot(x, p), 1, atol=1e-10)
    assert np.unwrap(np.arctan2(p, x))[-1] == pytest.approx(2 * np.pi, abs=0.2)
    assert [name for _, name, _ in path.crossings] == ["FOLD", "FOLD"]
    np.testing.assert_allclose(
        [spot.place for _, _, spot in path.crossings], [[0, 1], [0, -1]], atol=1e-8
    )


def test_cubic_passes_both_folds_to_the_end_of_the_range():
    """λ = x - x³ has folds at x = ±1/√3."""
    path = follow_curve(CUBIC, start_of(CUBIC, -1.4, 1.3, -1), StepSizes(-1.5, 1.5), FOLD)
    assert (path.end, path.spots[-1].place[-1]) == (End.RANGE_END, -1.5)
    top = 1 / np.sqrt(3)
    np.testing.assert_allclose(
        [spot.place for _, _, spot in path.crossings],
        [[-top, -top + top**3], [top, top - top**3]],
        atol=1e-8,
    )
    assert all(spot.tangent @ after.tangent > 0.9 for spot, after in itertools.pairwise(path.spots))
    assert len({spot.orientation for spot in path.spots}) == 1
    for index, _, spot in path.crossings:
        assert path.spots[index].place[0] <= spot.place[0] <= path.spots[index + 1].place[0]


def test_steps_grow_to_the_maximum_on_a_straight_stretch():
    line = curve_of(lambda x, p: x - p, lambda x, p: [1.0, -1.0])
    path = follow_curve(line, start_of(line, 0.0, 0.0), StepSizes(-1, 1, 1e-3, 1e-6, 0.05), {})
    strides = [np.linalg.norm(b.place - a.place) for a, b in itertools.pairwise(path.spots)]
    np.testing.assert_allclose(strides[:3], [1e-3, 1.5e-3, 2.25e-3], rtol=1e-9)
    assert max(strides) == pytest.approx(0.05)


def test_ends_are_named():
    """A curve ends after too many points, where it stops, and if its start leaves the range at
    once."""
    few = follow_curve(CIRCLE, start_of(CIRCLE, 1.0, 0.0), StepSizes(-2, 2, points=7), {})
    assert (few.end, len(few.spots)) == (End.MAX_POINTS, 7)

    def until(guess, across, near):
        spot = CIRCLE(guess, across, near)
        if spot.place[-1] > 0.5:
            raise StoppedError(End.TOO_DEEP)
        return spot

    for least in (1e-6, 1e-3):
        path = follow_curve(until, start_of(CIRCLE, 1.0, 0.0), StepSizes(-2, 2, least=least), {})
        assert (path.end, path.crossings) == (End.TOO_DEEP, [])
        assert path.spots[-1].place[-1] == pytest.approx(0.5, abs=2 * least)
    outward = follow_curve(CIRCLE, start_of(CIRCLE, 1.0, 0.0), StepSizes(-1, 0), {})
    assert (outward.end, len(outward.spots)) == (End.RANGE_END, 1)


def test_a_corner_is_passed():
    """λ = -|x| turns by a right angle; the curve is found again beyond the corner, which is
    recorded."""
    roof = curve_of(lambda x, p: p + abs(x), lambda x, p: [np.sign(x), 1.0])
    path = follow_curve(roof, start_of(roof, -1.0, -1.0), StepSizes(-2, 1), FOLD)
    assert (path.end, path.spots[-1].place) == (End.RANGE_END, pytest.approx([2.0, -2.0]))
    assert [name for _, name, _ in path.crossings] == ["CORNER", "FOLD"]
    assert path.crossings[1][2].place == pytest.approx([0, 0], abs=1e-3)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [({"low": 3.0}, "low"), ({"least": 0.1}, "least"), ({"points": 0}, "points")],
)
def test_steps_are_checked(wrong, word):
    with pytest.raises(ValueError, match=word):
        dataclasses.replace(StepSizes(0.0, 1.0), **wrong)
