"""Profile families pass the conformance suite, have known numbers, and refuse bad designs.

CIC agrees with the paper's equations; areas of every family with polygons of its own outline."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from experiments.geometry import study
from rootsopt.config.families import families, family_of
from rootsopt.errors import InputError
from rootsopt.profiles import CIC, EE, arc, outline
from rootsopt.profiles.soundness import soundness
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.families import check, margins_of, profile_of
from tests.conformance import families as suite
from tests.conformance.families import (
    COUNT,
    LOBES,
    R,
    config_of,
    looked_at,
    made,
    maker,
    measure,
    sampled,
)

DEG = np.pi / 180


def cic(lobes, alpha, fraction, tip):
    """Return a CIC profile with u given as a fraction of u_max."""
    return CIC(lobes, R, alpha, fraction * R * np.sin(alpha) * (np.pi / (2 * lobes) - tip), tip)


FAMILIES = [name for name, family in families().items() if family.maker is not None]
# Families with which a check that compiles slowly runs in long runs only: others share their code.
_LONG = {
    suite.search_finds_the_closest_approach: (
        *("arc", "four_arcs", "five_arcs", "arc_involute", "hypo_epicycloid", "ellipse", "ee"),
        *("arcs_epicycloid", "circle_epicycloid"),
    ),
    suite.slopes_of_geometry_are_those_of_differences: (
        *("arc", "five_arcs", "ellipse", "cic", "arcs_epicycloid", "arc_involute"),
        *("circle_epicycloid", "four_arcs"),
    ),
    suite.what_margins_call_sound_is_one_curve: (
        *("arc_involute", "ee", "four_arcs", "ellipse", "hypo_epicycloid", "circle_epicycloid"),
    ),
}
# Families without a check that another test makes, or that finds nothing more in their code.
_ELSEWHERE = {
    # The ellipse has the same curve, EE such a cusp.
    (suite.search_finds_the_closest_approach, "extended_cycloid"),
    # Five arcs have the same arcs, with joints between them.
    (suite.what_margins_call_sound_is_one_curve, "arc"),
    # They are compared with finer polygons below.
    *((suite.area_and_moment_are_those_of_the_outline, family) for family in FAMILIES),
}
CASES = [
    pytest.param(
        family,
        one,
        marks=[pytest.mark.long] if family in _LONG.get(one, ()) else [],
        id=f"{family}-{one.__name__}",
    )
    for family in FAMILIES
    for one in suite.CHECKS
    if (one, family) not in _ELSEWHERE
]


@pytest.mark.parametrize(("family", "holds"), CASES)
def test_conforms(family, holds):
    holds(family)


# Known numbers


@pytest.mark.parametrize(
    ("kind", "numbers", "tip_radius", "efficiency", "within"),
    [
        # In closed form: r (1 + 1/N), and 1 - A/(π r_a²).
        (EE, (2, R), 1 + 1 / 2, 0.5, 1e-12),
        (EE, (3, R), 1 + 1 / 3, 0.40625, 1e-12),
        (EE, (4, R), 1 + 1 / 4, 0.34, 1e-12),
        # Textbook CIC: tan α = π/2N, the longest involute, no land.
        (cic, (2, np.arctan(np.pi / 4), 1.0, 0.0), 1.61767, 0.56926, 5.1e-6),
        (cic, (3, np.arctan(np.pi / 6), 1.0, 0.0), 1.46386, 0.49987, 5.1e-6),
        (cic, (4, np.arctan(np.pi / 8), 1.0, 0.0), 1.36552, 0.43982, 5.1e-6),
        (arc, (2, R, 0.8 * R), 1.51318, 0.51382, 5e-6),
        (arc, (3, R, 0.9 * R), 1.40115, 0.45679, 5e-6),
    ],
)
def test_known_tip_radii_and_area_efficiencies(kind, numbers, tip_radius, efficiency, within):
    shape = measure(kind(*numbers))
    assert float(shape.outer_radius) / R == pytest.approx(tip_radius, abs=within)
    assert float(shape.root_radius) / R == pytest.approx(2 - tip_radius, abs=within)
    assert float(shape.area_efficiency) == pytest.approx(efficiency, abs=within)
    assert float(shape.seal_width) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("lobes", "center", "efficiency"),
    [(2, 0.92882, 0.58116), (3, 0.96693, 0.50355), (4, 0.98111, 0.43971)],
)
def test_largest_single_arc_without_undercut(lobes, center, efficiency):
    def undercut(b):
        return float(_margins_of("arc", lobes, jnp.asarray([1e3 * R * b])).undercut)

    limit = brentq(undercut, 0.8, 0.999, xtol=1e-9)
    assert limit == pytest.approx(center, abs=5e-6)
    found = measure(arc(lobes, R, limit * R))
    # The efficiency of the source is that at its own rounded centre.
    assert float(found.area_efficiency) == pytest.approx(efficiency, abs=1e-5)


@pytest.mark.parametrize("center", [0.89, 0.9, 0.92])
def test_margins_are_the_least_between_the_places_too(center):
    """Undercut and star margin of an arc are least inside a segment.

    With 400 samples they are up to 1e-5 pitch radii too great; the parabola through three samples
    is right to 3e-7."""
    found = _margins_of("arc", 3, jnp.asarray([1e3 * R * center]))
    nu = arc(3, R, center * R).pitch_normal * jnp.linspace(1e-9, 1 - 1e-9, 1 + 399 * 200)
    expected = _least(arc(3, R, center * R), nu)
    np.testing.assert_allclose([found.undercut, found.star], expected, rtol=0, atol=3e-7 * R)


@jax.jit
def _least(profile, nu):
    point, _, dedendum = profile.speeds(nu)
    return jnp.min(dedendum), jnp.min(R * jnp.sin(point.psi) - jnp.abs(point.s))


def test_ranges_of_the_arc_and_involute_patent():
    """The ranges of the arc and involute profile are those of US 7,320,579, claim 1.

    With centre distance L and two lobes, the base radius is above L / 2√2 and the arc above √2 π L
    / 16, where the involute is longest, at 45°. The arc is below (27 - 5√2) L / 56, where there is
    no involute and the tip lies at 3 L / 4. Here, L = 1."""
    longest = 0.5 * np.sin(np.pi / 4) * np.pi / 4
    least = profile_of("arc_involute", 2, jnp.asarray(0.5), jnp.asarray([45.0, longest * 1e3]))
    assert isinstance(least, CIC)
    assert float(least.base_radius) == pytest.approx(1 / (2 * np.sqrt(2)), rel=1e-12)
    assert float(least.arc_radius) == pytest.approx(np.sqrt(2) / 16 * np.pi, rel=1e-12)

    def tip(b):
        return float(measure(arc(2, 0.5, b)).outer_radius) - 0.75

    radius = float(arc(2, 0.5, brentq(tip, 0.3, 0.45, xtol=1e-12)).radius[0])
    assert radius == pytest.approx((27 - 5 * np.sqrt(2)) / 56, rel=1e-9)


def test_families_that_become_another():
    """Families with special parameters equal a simpler family.

    Two arcs of one radius and an ellipse of equal semi-axes are the single arc. A circle of r / 2N,
    whole arches without a land and a ratio of 1 are EE."""
    single, ee = maker("arc")(jnp.asarray([29.7])), EE(3, R)
    radius = float(single.radius[0]) * 1e3
    nu = np.linspace(0.01, 1.4, COUNT)
    for family, design, same in (
        ("four_arcs", [29.7, radius, 40.0], single),
        ("ellipse", [29.7, radius], single),
        ("circle_epicycloid", [5.5, 0.01], ee),
        ("hypo_epicycloid", [0.0], ee),
        ("extended_cycloid", [1.0], ee),
    ):
        other = maker(family)(jnp.asarray(design))
        one, two = (looked_at(p, jnp.asarray(nu)) for p in (same, other))
        for key in ("addendum", "dedendum", "lever"):
            np.testing.assert_allclose(two[key], one[key], rtol=0, atol=1e-10 * R, err_msg=family)


@pytest.mark.parametrize("ratio", [0.7, 1.3])
def test_extended_cycloid_is_the_curve_drawn(ratio):
    """P(θ), with tangents by differences, agrees with the core's form of the curve."""
    profile = maker("extended_cycloid")(jnp.asarray([ratio]))

    def drawn(theta):
        u = 1 - 6 * theta / np.pi
        away = 1 + (ratio - 1) * u**3 * (10 - 15 * u + 6 * u**2)
        return R * np.exp(1j * theta) * (7 / 6 + away / 6 * np.exp(6j * theta))

    theta = np.linspace(0, np.pi / 6, COUNT + 2)[1:-1]
    nu = jnp.asarray(np.angle((drawn(theta + 1e-6) - drawn(theta - 1e-6)) / 1j))
    place = np.asarray(looked_at(profile, nu)["addendum"]) @ [1, 1j]
    np.testing.assert_allclose(place, drawn(theta), rtol=0, atol=1e-9 * R)


def test_five_arcs_have_their_land():
    """The suite checks tangents and the pitch crossing."""
    shape = measure(made("five_arcs"))
    assert float(shape.outer_radius) == pytest.approx(0.045, rel=1e-12)
    assert float(shape.seal_width) == pytest.approx(2 * 3 * DEG * 0.045)


def test_contact_moves_backwards_along_the_mate_of_an_edge():
    nu, found = sampled("arcs_epicycloid")
    joints = made("arcs_epicycloid").joints
    assert np.all(found["rate"][(nu > joints[1]) & (nu < joints[2])] < 0)
    assert margins_of(config_of("arcs_epicycloid"))["rolling"] < 0


# Use by name


@pytest.mark.parametrize(
    ("family", "changes", "fault"),
    [
        ("arc", {"arc_center_mm": 32.5}, "undercut"),
        ("arc", {"arc_center_mm": 34.0}, "miss the pitch circle|mesh at once|undercut"),
        ("four_arcs", {"tip_arc_turn_deg": 120.0}, "end before|convex"),
        ("five_arcs", {"outer_radius_mm": 60.0}, "undercut|convex|miss|at once"),
        ("five_arcs", {"tip_arc_angle_deg": 20.0, "tip_arc_turn_deg": 10.0}, "end before"),
        ("arcs_epicycloid", {"arc_center_mm": 33.0, "edge_radius_mm": 5.0}, "undercut|miss"),
        ("arcs_epicycloid", {"edge_radius_mm": 0.05}, "`profile.edge_radius_mm` must be at least"),
        ("circle_epicycloid", {"tip_arc_turn_deg": 15.0}, "mesh at once"),
        ("circle_epicycloid", {"rolling_radius_mm": 20.0, "tip_arc_turn_deg": 70.0}, "folds back"),
        ("hypo_epicycloid", {"tip_arc_angle_deg": 31.0}, "`profile.tip_arc_angle_deg` = 31"),
        ("extended_cycloid", {"trochoid_ratio": 1.5}, "folds back"),
        ("ellipse", {"ellipse_height_mm": 1.0}, "miss the pitch crossing"),
        (
            "free_form",
            {"tip_arc_angle_deg": 2.0, "coefficients": (1, 1, 1, 1, 1, 1, -1)},
            "convex",
        ),
        ("free_form", {"tip_arc_angle_deg": 2.0, "coefficients": (0.8,) * 7}, "sound"),
        # Its contact turns back, and its gap has several minima.
        (
            "ellipse",
            {"ellipse_center_mm": 30.55, "ellipse_height_mm": 18.9},
            "move the centre, or change the height",
        ),
    ],
)
def test_unsound_profiles_are_refused(family, changes, fault):
    with pytest.raises(InputError, match=fault):
        check(config_of(family, **changes))


@CachedFunction
def _margins_of(family, lobes, design):
    profile = profile_of(family, lobes, jnp.asarray(R), design)
    return soundness(profile, jnp.asarray(0.0), family_of(family).inherent)


@pytest.mark.parametrize("family", ["cic", "arcs_epicycloid"])
def test_margins_find_what_closed_forms_refuse(family):
    """Traced margins find every design that the limits in closed form refuse.

    Designs within a millionth of a limit are left out: the two checks differ in their rounding."""
    row, example = family_of(family), config_of(family)
    low, high = np.array([one.usually(1e3 * R, LOBES) for one in row.parameters]).T
    # Most involutes of the usual range are too long.
    scale = np.array([0.4 if key == "involute_length_mm" else 1.0 for key in row.keys])

    @given(st.lists(st.floats(-0.3, 1.5), min_size=len(low), max_size=len(low)))
    def agree(shares):
        design = low + (high - low) * np.array(shares) * scale
        found = _margins_of(family, LOBES, design)
        near = any(0 < abs(float(value)) < 1e-6 for value in (*found[1:3], *found[6:]))
        if found.sound and not near:
            row.check(example.with_design(design.tolist()))

    agree()


# The paper's pair


PAPER = CIC(3, R, 36.43 * DEG, 9.0e-3, 4.0 * DEG)
every_cic = pytest.mark.parametrize(
    "profile",
    [PAPER, cic(3, 0.6, 0.8, 0.0), cic(3, 0.62, 1.0, 0.05), cic(5, 0.45, 0.9, 0.02)],
    ids=["paper", "no land", "longest involute", "five lobes"],
)


@jax.jit
def both_flanks(profile, nu):
    """Return positions on addendum and dedendum at the normal angles `nu`, and the dedendum's
    radius of curvature."""
    bend = profile.speeds(nu)[2] / (2 * profile.roll_rate(nu) - 1)
    return profile.position(profile.addendum(nu)), profile.position(profile.dedendum(nu)), bend


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
    assert float(shape.seal_width) == pytest.approx(float(shape.outer_radius) * 8 * DEG)
    assert float(shape.undercut_margin) > 0


# The paper's equations


@every_cic
def test_involute_is_equation_2(profile):
    """-u ≤ ℓ ≤ u of the paper's Eq. 2: addendum and dedendum points coincide with it."""
    alpha, u = float(profile.pressure_angle), float(profile.involute_length)
    length = np.linspace(0, 1, 41)[:-1] * u
    beta = float(profile.half_pitch) - length / (R * np.sin(alpha))
    positions = both_flanks(profile, jnp.asarray(beta + np.pi / 2 - alpha))[:2]
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
    theta = np.linspace(0, tip, 40)
    *places, bend = both_flanks(profile, jnp.asarray(theta))
    outer = float(measure(profile).outer_radius)
    sides = (theta, outer), (np.pi / profile.lobes - theta, 2 * R - outer)
    for (angle, radius), found in zip(sides, places, strict=True):
        expected = radius * np.stack([np.cos(angle), np.sin(angle)], -1)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(bend[theta < tip], 2 * R - outer, rtol=1e-12)


# The outline


@pytest.mark.parametrize("profile", [PAPER, EE(3, R)])
def test_outline_is_closed_counter_clockwise_and_starts_at_a_tip(profile):
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
"""Number of lobes and designs (config units) of each family; one that is missing fails."""


@pytest.mark.parametrize("family", [one for one in families() if one != "outline"])
def test_area_and_moment_are_those_of_the_outline(family):
    lobes, designs = HARD[family]
    designs = np.array(designs).reshape(len(designs), -1)
    area, moment, reference = np.asarray(study.compared(family, lobes, designs)).T
    assert np.max(reference) < ERROR / 10
    assert np.max(area) < ERROR
    assert np.max(moment) < ERROR
