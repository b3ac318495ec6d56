"""Tests of resemblance: the distance is correct, and no optimiser finds a nearer member."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import KDTree

from rootsopt.commands.table import profile as command
from rootsopt.commands.work import profile as work
from rootsopt.profiles import CIC, EE, arc, ellipse, five_arcs, outline, project
from rootsopt.profiles.geometry import departure, departures, feet
from rootsopt.scene import resemblance
from rootsopt.scene.families import profile_of
from rootsopt.scene.resemblance import free_likeness, likeness

R, DEG = 0.033, np.pi / 180
PROFILES = {
    "cic": CIC(3, R, 36.43 * DEG, 8.5e-3, 4 * DEG),
    "ee": EE(3, R),
    "arc": jax.jit(arc, static_argnums=0)(3, R, 0.0297),
    "ellipse": jax.jit(ellipse, static_argnums=0)(3, R, 0.027, 0.018),
    "five arcs": jax.jit(five_arcs, static_argnums=0)(3, R, 0.045, 3 * DEG, 0.013, 60 * DEG),
}


def polygon(profile, points=1500):
    """Return the closed outline (m) with a vertex about every 20 µm."""
    return np.asarray(outline(profile, points))


def hausdorff(one, other):
    """Return the Hausdorff distance (m) of closed polygons from their vertices alone.

    No code is shared with the package. If the other polygon has steps `h`, the distance of a vertex
    is too great by at most h² / 8d, where d is the distance."""
    return max(KDTree(one).query(other)[0].max(), KDTree(other).query(one)[0].max())


def denser(points):
    """Return a closed polygon with twelve vertices in place of each one, on the same edges."""
    places = np.arange(12 * len(points) - 11) / 12
    return np.stack([np.interp(places, np.arange(len(points)), x) for x in points.T], axis=1)


@pytest.mark.parametrize("pair", [("cic", "ee"), ("cic", "arc"), ("ellipse", "five arcs")])
def test_departure_is_the_hausdorff_distance_of_the_closed_outlines(pair):
    one, other = (PROFILES[name] for name in pair)
    points, others = polygon(one), polygon(other)
    assert departure(one, other) == pytest.approx(hausdorff(points, others), abs=0.2e-6)
    assert departure(other, one) == pytest.approx(departure(one, other), rel=1e-12)
    found = departures(one, other)
    assert 0 < found.rms < found.greatest
    # The root mean square, over evenly spaced vertices of the whole outline.
    arc_length = np.append(0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    places = np.linspace(0, arc_length[-1], 40_000)
    even = np.stack([np.interp(places, arc_length, x) for x in points.T], axis=1)
    away = KDTree(others).query(even)[0]
    assert found.rms == pytest.approx(np.sqrt(np.mean(away**2)), rel=2e-3)


def test_smooth_feet_see_the_curve_and_not_its_chords():
    """Distances are those from the curve, for points inside and outside a circle of few vertices.

    Signs and directions are correct too. The error is at most an eighth of the squared turn of a
    segment, times the distance."""
    angle = np.linspace(0, 1, 12)
    line = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    at = np.linspace(0.2, 0.8, 30)
    for radius in (1.02, 0.98):
        points = radius * np.stack([np.cos(at), np.sin(at)], axis=1)
        found = feet(points, line, smooth=True)
        assert found.away == pytest.approx(np.full(30, radius - 1), abs=2.5e-5)
        assert np.sum(found.toward * points, axis=1) == pytest.approx(np.full(30, radius), rel=2e-3)
        assert np.max(np.abs(np.abs(feet(points, line).away) - 0.02)) > 5e-4


def test_members_of_a_family_are_found_again():
    found = likeness(PROFILES["cic"], "cic")
    assert list(found.design.values()) == pytest.approx([36.43, 8.5, 4.0], rel=1e-3)
    assert found.departure < 0.1e-6
    assert found.record()["departure_um"] == found.departure * 1e6


@pytest.mark.long
def test_no_optimiser_finds_a_nearer_member():
    """Nelder and Mead's search, from the found member and beside it, finds no nearer one.

    It uses the independent distance."""
    target = denser(polygon(PROFILES["ellipse"], 300))
    found = likeness(PROFILES["ellipse"], "cic")
    best = np.array([*found.design.values()])

    def away(design):
        shape = outline(profile_of("cic", 3, jnp.asarray(R), jnp.asarray(design)), 300)
        return hausdorff(denser(np.asarray(shape)), target) if design[1] > 0.1 else 1.0

    assert away(best) == pytest.approx(found.departure, rel=0.01)
    rivals = [
        minimize(away, best * scale, method="Nelder-Mead", options={"maxfev": 40}).fun
        for scale in (1.0, np.array([1.1, 0.8, 0.9]))
    ]
    assert found.departure < min(rivals) * 1.002


def test_free_form_comes_closer(monkeypatch):
    """A free form of twelve coefficients comes within 0.1 µm of a projection, also from a
    neighbour."""
    monkeypatch.setattr(resemblance, "_PROGRAMS", 12)
    target = project(PROFILES["arc"], 12)
    found = free_likeness(target, likeness(target, "arc"))
    assert found.departure < 0.1e-6
    assert (found.family, len(found.design)) == ("free_form", 13)


def test_profile_command_names_the_family(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(resemblance, "classical", lambda: ("arc",))
    monkeypatch.setattr(work, "free_likeness", lambda profile, *near: None)
    where = ["-o", str(tmp_path / "out"), "--no-figures", "--export", "none"]
    assert command.main(["configs/cic_drawn.yaml", *where, "--resembles"]) == 0
    (row,) = json.loads((tmp_path / "out" / "result.json").read_text())["resembles"]
    assert row["family"] == "arc"
    assert 300 < row["departure_um"] < 450
    assert "Nearest profiles of the families" in capsys.readouterr().out
