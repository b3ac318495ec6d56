"""Play against polygons that are pushed into each other, and closed forms."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.path import Path

from experiments._common.polygons import pair_gap
from rootsopt.measured.conjugacy import conjugacy
from rootsopt.profiles import CIC, EE, place_pair
from rootsopt.pump.gap import Allowances, mesh_gap, play
from tests.conformance.families import LOBES, R, made, outline_of
from tests.measured.test_outline import closed, cut, points_of, profile_of

C = 5e-5


played = jax.jit(play)


@functools.cache
def of(family, error=0.0):
    return played(made(family), C, 2 * R + error, radial=0.0)


def test_ee_and_involute():
    """At the pitch crossing of EE the lever is r; on an involute it is r cos α, and stays so."""
    assert float(of("ee").gear_backlash) == pytest.approx(2 * C, rel=1e-4)
    assert np.min(of("ee").total) > 2 * C / R
    found = of("cic")
    angle = C / (R * np.cos(np.radians(36.43)))
    assert float(found.gear_backlash) == pytest.approx(2 * R * angle, rel=1e-6)
    # Rotor 1's drive flank touches on the involute where 0 ≤ -φ1 - π/2N, as far as it reaches.
    near = np.abs(np.asarray(found.phi) - 2 * np.pi / LOBES + np.pi / 6) < 0.2
    assert np.sum(near) > 5
    np.testing.assert_allclose(np.asarray(found.behind)[near], -angle, rtol=1e-5)


@pytest.mark.parametrize(
    "family",
    [
        "cic",
        *(
            pytest.param(one, marks=pytest.mark.long)
            for one in ("ee", "five_arcs", "ellipse", "extended_cycloid")
        ),
    ],
)
def test_polygons_touch_where_the_play_ends(family):
    """The rotors' polygons, with nominal flanks, overlap there by the clearance; half the way they
    do by less."""
    found, outline = of(family), outline_of(family) / 1e3
    for k in (3, 41, 70):
        phi, behind, ahead = (float(x[k]) for x in (found.phi, found.behind, found.ahead))
        for end in (behind, ahead):
            gap = pair_gap(outline, LOBES, 2 * R, phi, phi + end)
            assert gap == pytest.approx(-C, rel=2e-3)
            assert pair_gap(outline, LOBES, 2 * R, phi, phi + end / 2) > -0.99 * C


@pytest.mark.parametrize("error", [pytest.param(0.0, marks=pytest.mark.long), 3e-5])
def test_rotors_intersect_beyond_their_play(error):
    """Points of one polygon lie inside of the other just beyond the play, and none just within;
    also at another centre distance, where the flanks are not conjugate."""
    found = of("cic", error)
    polygon = closed(cut(outline_of("cic")[:-1:4] @ [1e-3, 1e-3j], C / 2))
    for k, end in itertools.product((5, 44, 83), (found.behind, found.ahead)):
        for share, expected in ((0.97, False), (1.03, True)):
            turned = float(found.phi[k] + share * end[k])
            pair = place_pair(polygon, LOBES, 2 * R + error, float(found.phi[k]), turned)
            assert intersect(*pair, 2 * R) == expected


def intersect(first, second, distance):
    """Whether a vertex of one of two polygons lies inside of the other."""
    near = [z[abs(z[:, 0] - distance / 2) < 0.45 * distance / 2] for z in (first, second)]
    return any(Path(a).contains_points(b).any() for a, b in ((first, near[1]), (second, near[0])))


def test_overlap_is_negative():
    """A centre distance that is too small: tips overlap by all of it, flanks by less."""
    found = of("cic", -2e-4)
    assert float(found.overlap) == pytest.approx(2e-4 - C, rel=2e-2)
    lever = R * np.cos(np.radians(36.43))
    assert -1.05 < float(found.gear_backlash) / (2 * R * 1.5e-4 / lever) < -0.5
    assert float(of("cic").overlap) == 0


def at_clearances(profile, clearances):
    """Return backlash, overlap (µm) and least play (mrad) at several clearances (µm)."""
    found = [played(profile, 1e-6 * c, 2 * R, radial=0.0) for c in clearances]
    rows = [(1e6 * x.gear_backlash, 1e6 * x.overlap, 1e3 * jnp.min(x.total)) for x in found]
    return np.array(rows, float).T


@pytest.mark.long
@pytest.mark.parametrize("family", ["ee", "cic"])
def test_play_is_continuous_in_the_overlap(family):
    """Points with 2 µm of scatter: from overlap to clearance, the backlash changes by twice the
    clearance over the cosine of the least pressure angle, and the overlap is that of the gap."""
    profile = {"ee": EE(LOBES, R), "cic": CIC(LOBES, R, np.deg2rad(36.43), 8.5e-3, 0.07)}[family]
    points = points_of(profile, 240)
    points = points + 2e-3 * np.random.default_rng(0).normal(size=(len(points), 2)) @ [1, 1j]
    scattered = profile_of(points, 2e-3)[0]
    clearance = np.array([-5.0, -0.5, 0.0, 0.5, 5.0])
    backlash, overlap, play = at_clearances(scattered, clearance)
    least = 1e6 * conjugacy(scattered).least
    assert -4 < least < -0.5
    assert overlap == pytest.approx(np.maximum(0, -least - clearance), abs=0.2)
    slope = np.diff(backlash) / np.diff(clearance)
    steepest = 2 / (1 if family == "ee" else np.cos(np.radians(36.43)))
    assert np.all((slope > 0.4 * steepest) & (slope < 1.3 * steepest))
    assert -2.5 * steepest < backlash[2] < 0
    assert np.all(np.abs(np.diff(play)) < 5)


def test_smaller_rotors_have_the_play_of_their_gap():
    """A radius that is smaller everywhere: the gap of the flanks, over the lever r cos ψ."""
    profile, nothing = made("cic"), jnp.zeros(())
    found = played(profile, 0.0, 2 * R, radial=C)
    gap = jax.jit(mesh_gap)(profile, Allowances(nothing, nothing, jnp.asarray(C)))
    lever = R * np.cos(profile.addendum(profile.normal_at(gap.roll)).psi)
    expected = 2 * R * np.min(np.asarray(gap.least) / lever)
    assert float(found.gear_backlash) == pytest.approx(expected, rel=2e-2)
    assert expected > C


def test_play_is_smooth_in_the_design():
    """Over moves as short as the sampled points are apart, slopes are those of differences."""

    @jax.jit
    def ends(angle):
        def at(angle):
            poses = jnp.asarray([0.1, 0.35, 0.8])
            found = play(CIC(LOBES, R, angle, 8.5e-3, 0.07), jnp.asarray(C), phi=poses)
            return jnp.stack([found.behind, found.ahead])

        return jax.jvp(at, (angle,), (jnp.ones(()),))

    angles = np.deg2rad(36.4) + 2e-6 * np.arange(12)
    values, slopes = (np.array(x) for x in zip(*map(ends, angles), strict=True))
    differences = (values[2:] - values[:-2]) / 4e-6
    np.testing.assert_allclose(differences, slopes[1:-1], atol=1e-4 * np.max(np.abs(slopes)))
