"""Tests of figures of an optimum: departure, forces against the baseline, room for labels."""

import itertools

import numpy as np
import pytest
from PIL import Image

from rootsopt.config import load
from rootsopt.response.result import Series
from rootsopt.scene import outline_mm
from rootsopt.view.figures import runs
from rootsopt.view.figures.designs import plot_departure, plot_forces_together
from rootsopt.view.figures.style import figure
from rootsopt.view.files import ResultFolder

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
    assert away[[0, -1]] == pytest.approx([radius.max(), radius.min()], rel=1e-3)
    assert along[-1] > np.ptp(radius)
    assert "outwards" in ax.get_title()
    _, axes = figure(6, 4)
    same = plot_departure(axes[0, 0], outline, outline, 3, 33.0)
    np.testing.assert_allclose(drawn(same, 1)[:, 1], 0.0, atol=1e-6)


def test_forces_begin_at_the_same_rotation():
    """A force that depends only on the rotor's angle coincides, wherever its series begins."""

    def run(first):
        rotation = first + np.linspace(0, 2 * np.pi, 601)
        force, zero = 1 + np.sin(3 * rotation), 0 * rotation
        return Series(rotation / 314, rotation, zero, zero, force, zero, zero)

    _, axes = figure(6, 4)
    ax = plot_forces_together(axes[0, 0], {"a": run(0.0), "b": run(5.0)}, 2 * np.pi / 3)
    first, second = (drawn(ax, k) for k in (0, 1))
    assert ax.get_xlim() == pytest.approx((0, 120))
    np.testing.assert_allclose(np.interp(second[:, 0], *first.T), second[:, 1], atol=1e-3)


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


def test_long_labels_have_room(tmp_path):
    """Small differences between large numbers, and many parameters fit; a picture is large.

    Screening, trials without a result and infeasible ones are part of the history."""
    keys = [f"radius_of_arc_{k}_mm" for k in range(5)]
    rows = [
        {"start": k // 4 - 1, "feasible": k != 6, "residual": 1e-9, "evaluation": k, "iteration": k}
        | {"objective": 1 - 1e-5 * k if k != 5 else np.nan, "best_objective": 1 - 1e-5 * k}
        | dict.fromkeys(keys, -123.45 + 0.12 * k)
        for k in range(12)
    ]
    made = runs._history(rows, keys)
    assert overlaps(made) == []
    file = ResultFolder(tmp_path).write_figure("figures/history.png", made)
    assert file.stat().st_size > 20_000
    with Image.open(file) as picture:
        assert picture.format == "PNG"
        assert min(picture.width - 1400, picture.height - 700) >= 0
