"""CIC agrees with the paper's equations, areas of every family with polygons of its own outline.

Known numbers are in `test_families.py`; normals, speeds and the law of gearing of all families in
the conformance suite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.geometry import study
from rootsopt.config import FAMILY_KEYS
from rootsopt.profiles import CIC, EE, geometry, outline

R = 0.033
DEG = np.pi / 180
measure = jax.jit(geometry)


def cic(lobes, alpha, fraction, tip):
    """Return a CIC profile with u given as a fraction of u_max."""
    return CIC(lobes, R, alpha, fraction * R * np.sin(alpha) * (np.pi / (2 * lobes) - tip), tip)


PAPER = CIC(3, R, 36.43 * DEG, 9.0e-3, 4.0 * DEG)
every_cic = pytest.mark.parametrize(
    "profile",
    [PAPER, cic(3, 0.6, 0.8, 0.0), cic(3, 0.62, 1.0, 0.05), cic(5, 0.45, 0.9, 0.02)],
    ids=["paper", "no land", "longest involute", "five lobes"],
)


@jax.jit
def both_flanks(profile, nu):
    """Return positions on the addendum and on the dedendum at the normal angles `nu`."""
    return profile.position(profile.addendum(nu)), profile.position(profile.dedendum(nu))


# Numbers from literature and closed forms


@pytest.mark.parametrize("lobes", [2, 3, 4])
def test_undercut_margin_changes_sign_at_the_canonical_pressure_angle(lobes):
    """Undercut starts at tan α = π/2N: margin zero there, r (sin α - cos α π/2N) around it."""
    canonical = np.arctan(np.pi / (2 * lobes))
    for change in (-0.01, 0.0, 0.01):
        alpha = canonical + change
        margin = float(measure(cic(lobes, alpha, 1.0, 0.0)).undercut_margin)
        # The margin is the involute's end value, seen from 1e-9 of the segment inside.
        closed_form = R * (np.sin(alpha) - np.cos(alpha) * np.pi / (2 * lobes))
        assert margin == pytest.approx(closed_form, abs=1e-8 * R)
        assert np.sign(round(margin / R, 7)) == np.sign(change)


def test_printed_design_of_the_paper():
    """Table 1's α, u, θ1 give r_a 45.103 mm, efficiency 0.4345 and u 1.2 % past u_max."""
    shape = measure(PAPER)
    assert float(shape.outer_radius) * 1e3 == pytest.approx(45.103, abs=5e-4)
    assert float(shape.area_efficiency) == pytest.approx(0.4345, abs=5e-5)
    assert float(PAPER.longest_involute) * 1e3 == pytest.approx(8.893, abs=5e-4)
    assert float(shape.outer_radius + shape.root_radius) == pytest.approx(2 * R, rel=1e-14)
    assert float(shape.seal_width) == pytest.approx(float(shape.outer_radius) * 8 * DEG)
    assert float(shape.undercut_margin) > 0


# The paper's equations


@every_cic
def test_involute_is_equation_2(profile):
    """-u ≤ ℓ ≤ u of the paper's Eq. 2: addendum and dedendum points coincide with it."""
    alpha, u = float(profile.pressure_angle), float(profile.involute_length)
    length = np.linspace(0, 1, 41)[:-1] * u
    beta = float(profile.half_pitch) - length / (R * np.sin(alpha))
    positions = both_flanks(profile, jnp.asarray(beta + np.pi / 2 - alpha))
    for ell, computed in zip((length, -length), positions, strict=True):
        beta = np.pi / (2 * profile.lobes) - ell / (R * np.sin(alpha))
        across = ell * np.cos(alpha) / np.tan(alpha)
        x = (R + ell * np.cos(alpha)) * np.cos(beta) - across * np.sin(beta)
        y = ell * np.cos(beta - alpha) / np.tan(alpha) + R * np.sin(beta)
        np.testing.assert_allclose(computed, np.stack([x, y], -1), rtol=0, atol=1e-14)


@every_cic
def test_land_is_equation_1_and_its_mate_the_circle_that_touches_it(profile):
    """Tip land: radius r_a over 0 … θ1 (Eq. 1); its conjugate: radius 2 r - r_a."""
    tip = float(profile.tip_arc_angle)
    theta = np.linspace(0, tip, 9)
    outer = float(measure(profile).outer_radius)
    sides = (theta, outer), (np.pi / profile.lobes - theta, 2 * R - outer)
    for (angle, radius), found in zip(sides, both_flanks(profile, theta), strict=True):
        expected = radius * np.stack([np.cos(angle), np.sin(angle)], -1)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    bend = profile.speeds(jnp.asarray(theta))[2] / (2 * profile.roll_rate(jnp.asarray(theta)) - 1)
    np.testing.assert_allclose(bend[theta < tip], 2 * R - outer, rtol=1e-12)


# The outline


@pytest.mark.parametrize("profile", [PAPER, cic(2, 0.75, 0.8, 0.08), EE(3, R)])
def test_outline_is_closed_counter_clockwise_and_starts_at_a_tip(profile):
    """Contract of the outline: closed, counter-clockwise, the first vertex the tip on +x."""
    points = np.asarray(outline(profile, 150))
    np.testing.assert_array_equal(points[0], points[-1])
    assert points[0] == pytest.approx([float(measure(profile).outer_radius), 0], abs=1e-15)
    polar = np.unwrap(np.angle(points @ [1, 1j]))
    assert polar[-1] - polar[0] == pytest.approx(2 * np.pi)
    assert np.min(np.hypot(*np.diff(points, axis=0).T)) > 1e-6 * R


# The inverse of the roll angle


def test_involute_is_preferred_where_the_roll_angle_turns_back():
    """For u > u_max, ψ = α from the start of the involute, which lies before the end of the arc."""
    start, tip = float(PAPER.involute_start), float(PAPER.tip_arc_angle)
    assert start < tip
    beta, land = jnp.linspace(start, tip, 21), jnp.linspace(0, start - 1e-9, 21)
    psi = beta + np.pi / 2 - PAPER.normal_at(beta)
    np.testing.assert_allclose(psi, PAPER.pressure_angle, atol=1e-12)
    np.testing.assert_array_equal(PAPER.normal_at(land), land)


# Areas

ERROR = 1e-11
"""Relative error allowed; the study in experiments/geometry finds 1e-13."""
HARD = {
    # The normals of the arc all but touch the pitch circle, at its end or inside of it.
    "cic": (5, [[36.43, 6.0, 4.0], [9.90309962, 4.61058857e-06, 0.00440706401]]),
    "ee": (4, [[]]),
    "arc": (5, [[30.0], [31.9750552], [32.99]]),
    "arcs_epicycloid": (5, [[32.2328279, 4.52872269, 1.31231773]]),
    "arc_involute": (5, [[30.0, 4.0], [9.57156265, 2.03155703e-06], [86.07009, 4.82898416]]),
    "four_arcs": (5, [[32.7457584, 9.9455844, 26.4908313]]),
    "five_arcs": (5, [[38.6977037, 3.82052582, 10.6338733, 36.9061107]]),
    "circle_epicycloid": (5, [[10.5861275, 89.9968733]]),
    "hypo_epicycloid": (5, [[3.0], [17.9924375]]),
    # The pressure angle is steep.
    "extended_cycloid": (5, [[1.0], [0.3835], [0.238601779]]),
    "ellipse": (5, [[9.46007216, 27.8267607]]),
    "free_form": (3, [[4.0, 0.8, 0.7, 0.75], [5.04175591, 0.98336944, 0.83837998, -0.4203177]]),
}
"""Number of lobes and designs (config units) of each family."""


@pytest.mark.parametrize("family", HARD)
def test_area_and_moment_are_those_of_the_outline(family):
    lobes, designs = HARD[family]
    designs = np.array(designs).reshape(len(designs), -1)
    area, moment, reference = np.asarray(study.compared(family, lobes, designs)).T
    assert np.max(reference) < ERROR / 10
    assert np.max(area) < ERROR
    assert np.max(moment) < ERROR


def test_every_family_is_looked_at():
    assert set(HARD) == {*FAMILY_KEYS} - {"outline"}
