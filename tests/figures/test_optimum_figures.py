"""Tests of figures of an optimum: departure, forces against the baseline, ends of the searches.

And of the room that the labels of all figures get."""

import itertools

import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.figures import runs
from rootsopt.figures.history import plot_prices, plot_residual, plot_starts
from rootsopt.figures.profiles import plot_departure, plot_forces_together
from rootsopt.figures.style import figure
from rootsopt.response.records import Series
from rootsopt.scene import outline_mm

CIC = load("configs/cic_drawn.yaml")


def drawn(ax, number):
    """Return the points (n, 2) of a line on an axis."""
    return np.asarray(ax.lines[number].get_xydata())


def test_departure_of_a_scaled_rotor_is_that_of_its_supporting_lines():
    """Scaling by 1.001 moves the tip by 45.1 µm outwards, and every point by 1/1000 of its
    support."""
    outline = outline_mm(CIC)
    _, axes = figure(6, 4)
    ax = plot_departure(axes[0, 0], outline, 1.001 * outline, 3, 33.0)
    along, away = drawn(ax, 1).T
    radius = np.hypot(*outline.T)
    assert away[0] == pytest.approx(radius.max(), rel=1e-3)
    assert away[-1] == pytest.approx(radius.min(), rel=1e-3)
    assert along[-1] > radius.max() - radius.min()
    assert "outwards" in ax.get_title()
    _, axes = figure(6, 4)
    same = plot_departure(axes[0, 0], outline, outline, 3, 33.0)
    np.testing.assert_allclose(drawn(same, 1)[:, 1], 0.0, atol=1e-6)


def test_forces_begin_at_the_same_rotation():
    """A force that depends only on the rotor's angle coincides, wherever its series begins."""
    turn = 2 * np.pi / 3

    def run(first):
        rotation = first + np.linspace(0, 2 * np.pi, 601)
        force = 1 + np.sin(3 * rotation)
        zero = np.zeros_like(force)
        return Series(rotation / 314, rotation, zero, zero, force, zero, zero)

    _, axes = figure(6, 4)
    ax = plot_forces_together(axes[0, 0], {"a": run(0.0), "b": run(5.0)}, turn)
    first, second = (drawn(ax, k) for k in (0, 1))
    assert ax.get_xlim() == pytest.approx((0, 120))
    there = np.interp(second[:, 0], *first.T)
    np.testing.assert_allclose(there, second[:, 1], atol=1e-3)


def test_every_price_has_a_bar_with_its_number():
    """Prices of limits with the same name have bars of their own, the dearest on top."""
    row = {"name": "peak force", "unit": "N", "relaxed_by": 1.0, "multiplier": -1.0}
    rows = [row | {"relaxed_objective_percent": gain} for gain in (-2.0, -0.003)]
    rows.append(row | {"relaxed_objective_percent": -5.0, "multiplier": 0.0})
    _, axes = figure(6, 4)
    ax = plot_prices(axes[0, 0], rows)
    assert [bar.get_width() for bar in ax.patches] == [0.003, 2.0]
    assert [text.get_text() for text in ax.texts] == ["0.003 %", "2 %"]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["peak force, +1 N"] * 2


def test_ends_of_searches_are_drawn_with_their_optima():
    starts = [
        {"start": 0, "objective": 0.8, "reason": "converged"},
        {"start": 1, "objective": 0.9, "reason": "evaluations"},
        {"start": 2, "objective": None, "reason": "unusable"},
    ]
    _, axes = figure(6, 4)
    ax = plot_starts(axes[0, 0], starts, [{"objective": 0.8, "found": 1}])
    assert [drawn(ax, k)[0, 1] for k in (0, 1, 2)] == [0.8, 0.8, 0.9]
    assert ax.lines[2].get_markerfacecolor() == "none"
    assert "found 1" in ax.get_legend().get_texts()[0].get_text()


def test_residuals_are_those_of_the_best_design_so_far():
    """Trials beside the optimum, infeasible ones and those without a motion are left out."""
    nan = float("nan")
    trials = [
        (0.9, True, 0.1),
        (nan, True, nan),
        (0.8, True, 1e-9),
        (0.7, False, 0.3),
        (0.85, True, 2),
    ]
    names = "objective", "feasible", "residual"
    rows = [
        {"start": 0, "iteration": k} | dict(zip(names, trial, strict=True))
        for k, trial in enumerate(trials)
    ]
    ax = plot_residual(figure(4, 4)[1][0, 0], rows, 1e-4)
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), [[0, 0.1], [2, 1e-9]])


def overlaps(figure):
    """Return what leaves a figure, and what covers something else, as pairs of names.

    Compared are its panels with their labels, its legends and its title."""
    figure.draw_without_rendering()
    boxes = {ax.get_label() or f"panel {k}": ax.get_tightbbox() for k, ax in enumerate(figure.axes)}
    boxes |= {f"legend {k}": legend.get_tightbbox() for k, legend in enumerate(figure.legends)}
    boxes |= {text.get_text(): text.get_tightbbox() for text in figure.texts}
    width, height = figure.bbox.size + 0.5
    left = [
        (name, "edge")
        for name, box in boxes.items()
        if box.x0 < -0.5 or box.y0 < -0.5 or box.x1 > width or box.y1 > height
    ]
    pairs = itertools.combinations(boxes.items(), 2)
    return left + [(a, b) for (a, one), (b, other) in pairs if one.overlaps(other)]


def histories(keys):
    """Return rows whose numbers have long tick labels."""
    shared = {"start": 1, "feasible": True, "residual": 1e-9}
    return [
        shared | {"evaluation": k, "iteration": k, "objective": 1 - 1e-5 * k}
        | {"best_objective": 1 - 1e-5 * k} | dict.fromkeys(keys, -123.45 + 0.12 * k)
        for k in range(9)
    ]  # fmt: skip


def test_long_labels_have_room():
    """Long names, small differences between large numbers, and many parameters all fit."""
    names = "lower bound of involute length (10 %)", "angular_play_min_mrad", "an arc's radius" * 9
    limits = [
        {"name": name, "unit": "mm", "relaxed_by": -0.1, "multiplier": -1.0,
         "relaxed_objective_percent": -1.0} for name in names
    ]  # fmt: skip
    starts = [{"start": k, "objective": 0.8, "reason": "converged"} for k in range(9)]
    made, axes = figure(14, 4.4, 1, 3, gridspec_kw={"width_ratios": [1, 1, 0.8]})
    plot_residual(axes[0, 0], histories(()), 1e-4)
    plot_prices(axes[0, 1], limits, converged=False)
    plot_starts(axes[0, 2], starts, [{"objective": 0.8, "found": 9}])
    made.suptitle("title")
    assert overlaps(made) == []
    keys = [f"radius_of_arc_{k}_mm" for k in range(5)]
    assert overlaps(runs._history(histories(keys), keys)) == []
