"""What a file says about its rotor is found from its points alone."""

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.measured.conjugacy import conjugacy
from rootsopt.measured.source import read_rotor
from rootsopt.profiles import CIC, outline
from tests.standins import refusal

# Fewer roll angles at which the gap is measured, as `setattr` takes them.
POSES = "rootsopt.measured.conjugacy._POSES", 91
LENGTHS = {"mm": 1.0, "inch": 25.4, "um": 1e-3, "m": 1e3}


def cycloids(lobes, radius, count=300):
    """Return points (mm) of EE by its textbook formula: an epicycloid and a hypocycloid in turn."""
    small, turn = radius / (2 * lobes), np.linspace(0, np.pi / lobes, count, endpoint=False)
    out, back = radius + small, radius - small
    lobe = out * np.exp(1j * turn) - small * np.exp(1j * turn * out / small)
    valley = back * np.exp(1j * turn) + small * np.exp(-1j * turn * back / small)
    pair = np.concatenate([lobe, valley * np.exp(1j * np.pi / lobes)])
    return (np.exp(2j * np.pi * np.arange(lobes)[:, None] / lobes) * pair).ravel()


def cut(points, by):
    """Return points of an outline that is `by` mm smaller along its normals."""
    along = np.roll(points, -1) - np.roll(points, 1)
    return points + 1j * along / np.abs(along) * by


def cut_cic(inset):
    """Return points (mm) of a CIC rotor of pitch radius 33 mm, smaller by `inset` (mm)."""
    values = (0.033, np.radians(36.43), 0.0085, np.radians(4.0))
    points = np.asarray(outline(CIC(3, *map(jnp.asarray, values)), 300))[:-1] @ [1e3, 1e3j]
    return cut(points, inset)


def write(path, points):
    np.savetxt(path, np.stack([points.real, points.imag], axis=1), fmt="%.10g", delimiter=",")
    return path


def found_in(folder, points, given=None):
    return read_rotor(
        write(folder / "rotor.csv", points), given or {}, lambda what, default: default
    )


ROTORS = {
    "EE of 2 lobes in um, clockwise, off centre": (
        cycloids(2, 40.0)[::-1] * np.exp(0.3j) + 7 - 2j, "um", 2, 80.0, 0.0, 7 - 2j),
    "EE of 4 lobes in m": (cycloids(4, 55.0), "m", 4, 110.0, 0.0, 0j),
    "CIC cut by 0.1 mm in inch, turned": (
        cut_cic(0.1) * np.exp(1j) + 20j, "inch", 3, 66.0, 0.1, 20j),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] * ("CIC" not in n)) for n in ROTORS]
)
def test_unit_axis_lobes_distance_and_inset_are_found(name, tmp_path, monkeypatch):
    monkeypatch.setattr(*POSES)
    points, unit, lobes, distance, inset, axis = ROTORS[name]
    rotor = found_in(tmp_path, points / LENGTHS[unit])
    assert rotor.lobes == lobes
    assert rotor.radius == pytest.approx(distance / 2, abs=2e-3)
    assert conjugacy(rotor.outline).inset * 1e3 == pytest.approx(inset, abs=1e-3)
    assert abs(rotor.checks.axis - axis) < 1e-3
    assert f"unit {unit}" in rotor.facts[0]


@pytest.mark.long
def test_scattered_and_dense_points_are_thinned_and_smoothed(tmp_path):
    noise = np.random.default_rng(0).normal(0, 0.004, (2, 20_000)).T @ [1, 1j]
    whole = cut_cic(0.1)
    place = np.arange(20_000) / 20_000 * len(whole)
    points = np.interp(place, np.arange(len(whole)), whole, period=len(whole))
    rotor = found_in(tmp_path, points + noise)
    assert rotor.radius == pytest.approx(33, abs=5e-3)
    assert conjugacy(rotor.outline).inset * 1e3 == pytest.approx(0.1, abs=5e-3)
    assert any("points is used" in fact for fact in rotor.facts)


REFUSED = {
    "a circle": (50 * np.exp(2j * np.pi * np.arange(400) / 400), {}, "no such symmetry"),
    "another distance": (cycloids(3, 33.0), {"pitch_radius_mm": 41.0}, "`--centre-distance-mm`"),
    "lobes that do not mesh": (
        np.exp(2j * np.pi * np.arange(900) / 900)
        * (40 + 12 * np.cos(6 * np.pi * np.arange(900) / 900)), {}, "rolls on another"),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] * ("lobes" in n)) for n in REFUSED]
)
def test_what_is_no_rotor_is_refused(name, tmp_path):
    points, given, message = REFUSED[name]
    assert message in refusal(found_in, tmp_path, points, given)
