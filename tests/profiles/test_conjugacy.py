"""A pair of rotors rolled through a mesh period touches everywhere and overlaps nowhere.

Measured with the node method, which sees two closed outlines and knows nothing of roll
angles. Lengths in mm here, as the promise (|gap| below a nanometre) is.
"""

import numpy as np
import pytest

from experiments._common.polygons import pair_gap, signed_distance
from rootsopt.profiles import CIC, EE

R = 33.0
CENTER_DISTANCE = 2 * R
NANOMETRE = 1e-6
# Error of the node method on these outlines, falling with the fourth power of the node
# spacing on smooth arcs and the second at curvature jumps: below 2e-7 mm (measured with
# 300 to 3000 points per flank half: 7e-6, 1.2e-7, 2e-8, 3e-8).
POINTS = 1000


def cic(lobes, alpha, fraction, tip):
    """Return a CIC profile with u given as a fraction of u_max."""
    longest = R * np.sin(alpha) * (np.pi / (2 * lobes) - tip)
    return CIC(lobes, R * 1e-3, alpha, fraction * longest * 1e-3, tip)


PROFILES = {
    "paper": CIC(3, R * 1e-3, np.deg2rad(36.43), 9.0e-3, np.deg2rad(4.0)),
    "short involute": cic(3, 0.62, 0.6, 0.06),
    "no land": cic(3, 0.60, 0.85, 0.0),
    "two lobes": cic(2, 0.75, 0.8, 0.08),
    "five lobes": cic(5, 0.45, 0.9, 0.02),
    "ee two": EE(2, R * 1e-3),
    "ee three": EE(3, R * 1e-3),
    "ee five": EE(5, R * 1e-3),
}
every_pair = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES.keys())


def rolling_gaps(points, lobes, angles, center_distance=CENTER_DISTANCE):
    """Return the least signed distance (mm) of the pair, rolled without relative rotation."""
    return np.array([pair_gap(points, lobes, center_distance, phi, phi) for phi in angles])


def mesh_period(lobes, count=37):
    """Return angles over one mesh period, off the symmetric poses, and the pitch point's own."""
    period = 2 * np.pi / lobes
    pitch = np.pi / (2 * lobes) + np.array([-1e-3, -1e-4, 0.0, 1e-4, 1e-3])
    return np.concatenate([0.0123 + period * np.arange(count) / count, pitch])


@every_pair
def test_rolling_pair_touches_and_does_not_overlap(profile, graded_outline):
    """|gap| < 1 nm through a whole mesh period: no penetration and no lost contact."""
    points = graded_outline(profile, POINTS) * 1e3
    gaps = rolling_gaps(points, profile.lobes, mesh_period(profile.lobes))
    assert np.all(gaps > -NANOMETRE), "the rotors overlap"
    assert np.all(gaps < NANOMETRE), "the rotors have lost contact"


# The measure detects defects


INVOLUTE_PHASE = np.deg2rad(-30.0) + np.array([-0.05, 0.02, 0.06])


def test_measure_sees_a_profile_too_large_by_a_millionth(graded_outline):
    """Outlines scaled by 1 + κ overlap by κ E sin ψ (= 4e-5 mm for κ = 1e-6)."""
    profile = PROFILES["paper"]
    points = graded_outline(profile, POINTS) * 1e3
    for growth in (1e-6, -1e-6):
        gaps = rolling_gaps((1 + growth) * points, 3, INVOLUTE_PHASE)
        expected = -growth * CENTER_DISTANCE * np.sin(float(profile.pressure_angle))
        np.testing.assert_allclose(gaps, expected, rtol=0, atol=NANOMETRE / 3)
        assert np.all(np.abs(gaps) > 10 * NANOMETRE)


def test_measure_sees_a_profile_that_is_not_conjugate(graded_outline):
    """A node of rotor 1's flank raised by 1e-5 mm is found when it comes into mesh."""
    points = graded_outline(PROFILES["paper"], POINTS) * 1e3
    radius = np.hypot(*points.T)
    # A smooth bump around radius 38 mm, on the involute of every flank.
    bump = 1e-5 * np.exp(-(((radius - 38.0) / 0.3) ** 2))
    edge = np.gradient(points @ [1, 1j])
    normal = edge / (1j * np.abs(edge))
    bumped = points + bump[:, None] * np.stack([normal.real, normal.imag], -1)
    gaps = rolling_gaps(bumped, 3, mesh_period(3, 73))
    assert np.min(gaps) < -5 * NANOMETRE


# The node method itself


def circle(count, radius=10.0):
    turn = 2 * np.pi * np.arange(count + 1) / count
    return radius * np.stack([np.cos(turn), np.sin(turn)], -1)


def test_signed_distance_to_a_circle():
    """The distance is positive outside and negative inside; errors fall as h² and h⁴.

    Straight segments err as h², cubics as h⁴."""
    angles = np.linspace(0.01, 6.2, 101)
    rays = np.stack([np.cos(angles), np.sin(angles)], -1)
    for offset in (-0.02, 0.03):
        nodes = (10.0 + offset) * rays
        for refine, order in ((False, 2), (True, 4)):
            errors = [
                np.max(np.abs(signed_distance(nodes, circle(n), refine) - offset))
                for n in (100, 200)
            ]
            assert errors[1] > 1e-14
            # Sampling of the error between nodes is not quite the same in both.
            assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)
