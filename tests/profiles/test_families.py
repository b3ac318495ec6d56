"""Profile families pass the conformance suite, have known numbers, and refuse bad designs."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from rootsopt.config.families import families, family_of
from rootsopt.errors import InputError
from rootsopt.profiles import CIC, EE, arc
from rootsopt.profiles.soundness import margins, soundness
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.families import check, profile_of
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


def longest(lobes, alpha):
    """Return the CIC profile without a land whose involute is longest, of radius 1."""
    return CIC(lobes, 1.0, alpha, np.sin(alpha) * np.pi / (2 * lobes), 0.0)


FAMILIES = [name for name, family in families().items() if family.maker is not None]
_ALIKE = {
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
"""Families left out of a check that compiles slowly, because others share their code.

They are checked in long runs."""


def case(family, one):
    marks = [pytest.mark.long] if family in _ALIKE.get(one, ()) else []
    return pytest.param(family, one, marks=marks, id=f"{family}-{one.__name__}")


@pytest.mark.parametrize(
    ("family", "holds"), itertools.starmap(case, itertools.product(FAMILIES, suite.CHECKS))
)
def test_conforms(family, holds):
    """Every family that the package registers passes the suite."""
    holds(family)


# Known numbers


@pytest.mark.parametrize(
    ("kind", "numbers", "tip_radius", "efficiency", "within"),
    [
        # In closed form: r (1 + 1/N), and 1 - A/(π r_a²).
        (EE, (2, 1.0), 1 + 1 / 2, 0.5, 1e-12),
        (EE, (3, 1.0), 1 + 1 / 3, 0.40625, 1e-12),
        (EE, (4, 1.0), 1 + 1 / 4, 0.34, 1e-12),
        # Textbook CIC: tan α = π/2N, the longest involute, no land.
        (longest, (2, np.arctan(np.pi / 4)), 1.61767, 0.56926, 5.1e-6),
        (longest, (3, np.arctan(np.pi / 6)), 1.46386, 0.49987, 5.1e-6),
        (longest, (4, np.arctan(np.pi / 8)), 1.36552, 0.43982, 5.1e-6),
        (arc, (2, 1.0, 0.8), 1.51318, 0.51382, 5e-6),
        (arc, (3, 1.0, 0.9), 1.40115, 0.45679, 5e-6),
    ],
)
def test_known_tip_radii_and_area_efficiencies(kind, numbers, tip_radius, efficiency, within):
    shape = measure(kind(*numbers))
    assert float(shape.outer_radius) == pytest.approx(tip_radius, abs=within)
    assert float(shape.root_radius) == pytest.approx(2 - tip_radius, abs=within)
    assert float(shape.area_efficiency) == pytest.approx(efficiency, abs=within)
    assert float(shape.seal_width) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("lobes", "center", "efficiency"),
    [(2, 0.92882, 0.58116), (3, 0.96693, 0.50355), (4, 0.98111, 0.43971)],
)
def test_largest_single_arc_without_undercut(lobes, center, efficiency):
    def undercut(b):
        return float(margins(arc(lobes, 1.0, b)).undercut)

    limit = brentq(undercut, 0.8, 0.999, xtol=1e-9)
    assert limit == pytest.approx(center, abs=5e-6)
    found = measure(arc(lobes, 1.0, limit))
    # The efficiency of the source is that at its own rounded centre.
    assert float(found.area_efficiency) == pytest.approx(efficiency, abs=1e-5)


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
    assert float(margins(made("arcs_epicycloid")).rolling) < 0


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
def _margins_of(family, design):
    profile = profile_of(family, LOBES, jnp.asarray(R), design)
    return soundness(profile, jnp.asarray(0.0), family_of(family).inherent)


@pytest.mark.parametrize("family", ["cic", "arcs_epicycloid"])
def test_margins_find_what_closed_forms_refuse(family):
    """Traced margins find every design that the limits in closed form refuse.

    Designs within a millionth of a limit are left out: the two checks differ in their rounding."""
    row = family_of(family)
    low, high = np.array([one.usually(1e3 * R, LOBES) for one in row.parameters]).T
    # Most involutes of the usual range are too long.
    scale = np.array([0.4 if key == "involute_length_mm" else 1.0 for key in row.keys])

    @given(st.lists(st.floats(-0.3, 1.5), min_size=len(low), max_size=len(low)))
    def agree(shares):
        design = low + (high - low) * np.array(shares) * scale
        found = _margins_of(family, design)
        if any(0 < abs(float(value)) < 1e-6 for value in (*found[1:3], *found[6:])):
            return
        if bool(found.sound):
            row.check(config_of(family).with_design(design.tolist()))

    agree()
