"""CIC and EE agree with closed forms and the paper's equations.

Areas against polygons are in `test_areas.py`; normals, speeds and the law of gearing of all
families in the conformance suite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.profiles import CIC, EE, geometry, outline

R = 0.033
DEG = np.pi / 180
measure = jax.jit(geometry)


def cic(lobes, alpha, fraction, tip):
    """Return a CIC profile with u given as a fraction of u_max."""
    longest = R * np.sin(alpha) * (np.pi / (2 * lobes) - tip)
    return CIC(lobes, R, alpha, fraction * longest, tip)


def paper():
    return CIC(3, R, 36.43 * DEG, 9.0e-3, 4.0 * DEG)


def profiles():
    """Return sound profiles of both families: land and none, u below and at u_max, 2 to 5 lobes."""
    return {
        "paper": paper(),
        "short involute": cic(3, 0.62, 0.6, 0.06),
        "no land": cic(3, 0.6, 0.8, 0.0),
        "longest involute": cic(3, 0.62, 1.0, 0.05),
        "two lobes": cic(2, 0.75, 0.8, 0.08),
        "five lobes": cic(5, 0.45, 0.9, 0.02),
        "ee two": EE(2, R),
        "ee three": EE(3, R),
        "ee five": EE(5, R),
    }


every_profile = pytest.mark.parametrize("profile", profiles().values(), ids=profiles().keys())
cic_profiles = {name: p for name, p in profiles().items() if isinstance(p, CIC)}
every_cic = pytest.mark.parametrize("profile", cic_profiles.values(), ids=cic_profiles.keys())


@jax.jit
def both_flanks(profile, nu):
    """Return addendum and dedendum positions, and their normals' polar angles.

    All are at the normal angles `nu`."""
    addendum, dedendum = profile.addendum(nu), profile.dedendum(nu)
    normals = [point.beta + jnp.pi / 2 - point.psi for point in (addendum, dedendum)]
    centers = [point.beta for point in (addendum, dedendum)]
    return [profile.position(addendum), profile.position(dedendum)], normals, centers


# Numbers from literature and closed forms


@pytest.mark.parametrize(("lobes", "efficiency"), [(2, 0.5), (3, 0.40625), (4, 0.34)])
def test_ee_has_its_known_tip_radius_and_area_efficiency(lobes, efficiency):
    """EE: r_a = r (1 + 1/N), r_i = r (1 - 1/N), 1 - A/(π r_a²) in closed form."""
    shape = measure(EE(lobes, R))
    np.testing.assert_allclose(shape.outer_radius, R * (1 + 1 / lobes), rtol=1e-14)
    np.testing.assert_allclose(shape.root_radius, R * (1 - 1 / lobes), rtol=1e-14)
    np.testing.assert_allclose(shape.area_efficiency, efficiency, rtol=1e-12)
    assert float(shape.seal_width) == 0


@pytest.mark.parametrize(
    ("lobes", "tip_radius", "efficiency"),
    [(2, 1.61767, 0.56926), (3, 1.46386, 0.49987), (4, 1.36552, 0.43982)],
)
def test_canonical_cic_has_its_known_tip_radius_and_area_efficiency(lobes, tip_radius, efficiency):
    """Textbook CIC (θ1 = 0, u = u_max, tan α = π/2N): known to the digits given."""
    shape = measure(cic(lobes, np.arctan(np.pi / (2 * lobes)), 1.0, 0.0))
    np.testing.assert_allclose(shape.outer_radius / R, tip_radius, atol=5.1e-6)
    np.testing.assert_allclose(shape.area_efficiency, efficiency, atol=5.1e-6)


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
    shape = measure(paper())
    assert float(shape.outer_radius) * 1e3 == pytest.approx(45.103, abs=5e-4)
    assert float(shape.area_efficiency) == pytest.approx(0.4345, abs=5e-5)
    assert float(paper().longest_involute) * 1e3 == pytest.approx(8.893, abs=5e-4)
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
    nu = jnp.asarray(beta + np.pi / 2 - alpha)
    positions, _, _ = both_flanks(profile, nu)
    for ell, computed in ((length, positions[0]), (-length, positions[1])):
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
    positions, _, _ = both_flanks(profile, jnp.asarray(theta))
    polar = np.stack([np.cos(theta), np.sin(theta)], -1)
    np.testing.assert_allclose(positions[0], outer * polar, rtol=0, atol=1e-14)
    turned = np.pi / profile.lobes - theta
    polar = np.stack([np.cos(turned), np.sin(turned)], -1)
    np.testing.assert_allclose(positions[1], (2 * R - outer) * polar, rtol=0, atol=1e-14)
    turning = 2 * profile.roll_rate(jnp.asarray(theta)) - 1
    bend = profile.speeds(jnp.asarray(theta))[2] / turning
    np.testing.assert_allclose(bend[theta < tip], 2 * R - outer, rtol=1e-12)


# The outline


@every_profile
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
    profile = paper()
    start, tip = float(profile.involute_start), float(profile.tip_arc_angle)
    assert start < tip
    beta = jnp.linspace(start, tip, 21)
    psi = beta + np.pi / 2 - profile.normal_at(beta)
    np.testing.assert_allclose(psi, profile.pressure_angle, atol=1e-12)
    land = jnp.linspace(0, start - 1e-9, 21)
    np.testing.assert_array_equal(profile.normal_at(land), land)
