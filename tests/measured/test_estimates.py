"""Tests of estimated scatter, centre and unit of a file's points, and of the messages about them.

The files are made from known rotors with known errors."""

import functools
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rootsopt.config import load
from rootsopt.errors import InputError
from rootsopt.measured.estimates import Estimates, estimates, scatter, unit_of_size
from rootsopt.measured.source import advice, outline_of
from tests.fuzz import outlines
from tests.measured.test_outline import write
from tests.standins import refusal

rotor = functools.partial(outlines.points, "cic", 240)


def scattered(points, size, seed=0):
    """Return points with normal scatter of standard deviation `size` (mm) in x and in y."""
    chance = np.random.default_rng(seed)
    return points + size * (chance.normal(size=(len(points), 2)) @ [1, 1j])


def read(path, **keys):
    more = "".join(f", outline_{key}: {value}" for key, value in keys.items())
    given = f"family: outline, lobes: 3, pitch_radius_mm: 33.0, outline_file: '{path}'{more}"
    config = load("cic_drawn", [f"profile={{{given}}}"]).profile
    return config, *outline_of(config)


@pytest.mark.parametrize("name", ["cic", "ee"])
@pytest.mark.parametrize("size", [0.0, 1e-3, 5e-3, 20e-3])
def test_scatter_and_centre_are_those_put_in(name, size):
    """Scatter is found to 15 %, the centre to four times the scatter over √n.

    The points are shifted and turned."""
    points = scattered(outlines.points(name, 240) * np.exp(0.4j), size) + (12 - 7j)
    found = estimates(points, 3)
    assert found.scatter == pytest.approx(size, rel=0.15, abs=1e-6)
    off = found.center - (12 - 7j)
    assert max(abs(off.real), abs(off.imag)) < 4 * size / np.sqrt(len(points)) + 1e-6
    assert found.off_center
    assert found.middle == pytest.approx(33, abs=5 * size + 1e-6)


@pytest.mark.parametrize("size", [5e-3, 20e-3])
def test_scatter_of_points_closer_than_they_scatter(size):
    """The points are a few micrometres apart, so that their order along the outline is lost."""
    t = np.linspace(0, 2 * np.pi, 60_000, endpoint=False)
    dense = (33 + 10 * np.cos(3 * t)) * np.exp(1j * t)
    assert scatter(scattered(dense, size))[0] == pytest.approx(size, rel=0.15)


@settings(max_examples=8, deadline=None)
@given(
    turn=st.floats(-3.1, 3.1),
    start=st.integers(0, 2891),
    backwards=st.booleans(),
    shift=st.complex_numbers(max_magnitude=100, allow_nan=False),
)
def test_estimates_do_not_depend_on_how_the_points_are_given(turn, start, backwards, shift):

    points = scattered(rotor(), 5e-3)
    moved = np.roll(points, start)[:: -1 if backwards else 1] * np.exp(1j * turn) + shift
    one, other = estimates(points, 3), estimates(moved, 3)
    assert other.scatter == pytest.approx(one.scatter, rel=1e-6)
    assert abs(other.center - (one.center * np.exp(1j * turn) + shift)) < 1e-7
    assert other.center_error == pytest.approx(one.center_error, rel=1e-6)
    assert other.middle == pytest.approx(one.middle, rel=1e-7)


def test_fitted_centre_replaces_the_origin(tmp_path, capsys):
    """With the fitted centre, the flanks of a shifted file are equal, and the centre is reported in
    mm."""
    path = write(tmp_path / "shifted.csv", rotor() + (0.1 - 0.05j))
    config, _, checks = read(path)
    assert checks.lobe_deviation_um > 100
    differ, text = advice(config, checks)
    assert "represents all flanks" in differ
    assert "(0.1, -0.05) mm" in text
    assert "`profile.outline_center` = fit" in text
    for place in ("fit", "[0.1, -0.05]"):
        _, profile, checks = read(path, center=place)
        assert max(checks.lobe_deviation_um, checks.axis_offset_um) < 1e-3
        assert checks.seen.center + checks.axis == pytest.approx(0.1 - 0.05j)
        assert float(profile.outer_radius) == pytest.approx(np.max(np.abs(rotor())) * 1e-3)
    assert advice(*read(path, center="fit")[::2])[0].startswith("outline: the axis is the fitted")
    far = write(tmp_path / "far.csv", rotor() + 60)
    assert "centre of symmetry is at (60, 0) mm" in refusal(read, far)
    for wrong in ("middle", "[1.0]", "[1, x]", "[1, 1e9]"):
        assert "must be fit, or x and y" in refusal(read, path, center=wrong)


@pytest.mark.parametrize(("unit", "size"), [("inch", 25.4), ("m", 1e3), ("um", 1e-3)])
def test_units_are_offered_and_not_taken(tmp_path, unit, size):
    path = write(tmp_path / "points.csv", rotor() / size)
    assert f"`profile.outline_unit` = {unit}" in refusal(read, path)
    _, profile, checks = read(path, unit=unit)
    assert float(profile.outer_radius) == pytest.approx(np.max(np.abs(rotor())) * 1e-3, rel=1e-8)
    assert checks.lobe_deviation_um < 1e-2
    assert unit_of_size(33 / size, 33.0) == unit


def test_unit_of_a_drawing_can_be_replaced(tmp_path):
    """A drawing in inches that states millimetres is read in inches.

    Scatter and centre of its polyline are estimated."""
    points, path = scattered(rotor() + 0.2, 5e-3) / 25.4, tmp_path / "points.dxf"
    corners = np.stack([points.real, points.imag], axis=1)
    path.write_bytes(outlines.drawing(lambda x: x.modelspace().add_lwpolyline(corners, close=True)))
    assert "`profile.outline_unit` = inch" in refusal(read, path)
    _, _, checks = read(path, unit="inch", center="fit", smoothing_mm=0.005)
    assert checks.record()["scatter_um"] == pytest.approx(5, rel=0.15)
    assert checks.record()["center_x_mm"] == pytest.approx(0.2, abs=4 * 5e-3 / np.sqrt(len(points)))


def test_a_wrong_pitch_radius_is_told_from_a_wrong_unit(tmp_path):
    path = write(tmp_path / "points.csv", rotor() * 1.5)
    assert "outer and root radius is 49.5 mm" in refusal(read, path)


def test_refused_points_are_said_to_be_scattered(tmp_path):
    """The message states the scatter, without smoothing and with too little.

    The advised smoothing is accepted in the end."""
    path = write(tmp_path / "points.csv", scattered(rotor(), 20e-3, seed=2))
    for keys in ({}, {"smoothing_mm": 2e-3}, {"smoothing_mm": 20e-3}):
        with pytest.raises(InputError) as refused:
            read(path, **keys)
        (said,) = re.findall(r"points are scattered by about ([0-9.]+) um", str(refused.value))
        assert float(said) == pytest.approx(20, rel=0.15)
    assert "raise `profile.outline_smoothing_mm` from 0.02 to" in str(refused.value)
    config, _, checks = read(path, smoothing_mm=25e-3)
    assert checks.record()["scatter_um"] == pytest.approx(20, rel=0.15)
    assert not any("scattered" in text for text in advice(config, checks))


def test_points_closer_than_they_scatter_are_to_be_thinned(tmp_path):
    count = len(rotor())
    t = np.linspace(0, count, 30_000, endpoint=False)
    dense = scattered(np.interp(t, np.arange(count), rotor(), period=count), 5e-3)
    path = write(tmp_path / "points.csv", dense)
    assert "um apart: keep one in 3" in refusal(read, path, smoothing_mm=0.005)
    path = write(tmp_path / "thin.csv", dense[::3])
    assert read(path, smoothing_mm=0.006)[2].record()["scatter_um"] == pytest.approx(5, rel=0.15)


@pytest.mark.parametrize("lobes", [2, 6])
@pytest.mark.parametrize("count", [40, 150])
def test_no_scatter_is_invented_for_exact_points(lobes, count):
    """However few the points are, scatter is 0 or unknown, and then the rest is stated."""
    found = estimates(outlines.epicycloid(lobes, 33.0, count), lobes)
    assert not found.rough(0.0)
    stated = r"too few .*\(between them, the curve is known to about [\d.]+ um"
    assert found.scatter < 1e-4 or (np.isnan(found.scatter) and re.search(stated, found.few))


@pytest.mark.parametrize("lobes", [2, 4])
@pytest.mark.parametrize(
    ("count", "size"), [(200, 20), (300, 5), (300, 20), (500, 1), (1000, 1), (1000, 5), (3000, 20)]
)
def test_scatter_of_few_points_is_found(lobes, count, size):
    exact = outlines.epicycloid(lobes, 33.0, count)
    found = [scatter(scattered(exact, 1e-3 * size, seed))[0] for seed in range(5)]
    assert np.mean(found) == pytest.approx(1e-3 * size, rel=0.15)


def test_a_smoothing_is_offered_only_if_it_reads():
    """The least value from which on all greater ones that are tried read the outline."""
    for scatter_mm, least, offered in ((1e-6, 3e-4, "0.0005"), (5e-3, 6e-3, "0.0063")):
        seen = Estimates(scatter_mm, 0j, 0.0, 33.0, 0.0, lambda s, least=least: s >= least)
        assert f"= {offered}, with which it is read" in seen.remedy(0.0)
    assert Estimates(1e-6, 0j, 0.0, 33.0).remedy(0.0).endswith("correct the outline")
