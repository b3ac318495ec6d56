"""Families beside CIC and EE: known numbers, limits, conjugacy, contact, use by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from rootsopt.config import FAMILY_KEYS, parse
from rootsopt.contact.closest import FlankPair
from rootsopt.contact.nodes import pair_gap
from rootsopt.errors import InputError
from rootsopt.families import check, design_of, profile_of
from rootsopt.profiles import CIC, arc, ellipse, five_arcs, four_arcs, geometry
from rootsopt.profiles.validity import margins

R = 0.033
DEG = np.pi / 180
measure = jax.jit(geometry)
DESIGNS = {
    "arc": {"arc_center_mm": 29.7},
    "arc_involute": {"pressure_angle_deg": 36.0, "involute_length_mm": 6.0},
    "four_arcs": {"arc_center_mm": 30.0, "tip_arc_radius_mm": 13.0, "tip_arc_turn_deg": 40.0},
    "five_arcs": {
        "outer_radius_mm": 45.0,
        "tip_arc_angle_deg": 3.0,
        "tip_arc_radius_mm": 13.0,
        "tip_arc_turn_deg": 60.0,
    },
    "arcs_epicycloid": {"arc_center_mm": 27.0, "tip_arc_angle_deg": 8.0, "edge_radius_mm": 1.0},
    "circle_epicycloid": {"rolling_radius_mm": 7.0, "tip_arc_turn_deg": 30.0},
    "hypo_epicycloid": {"tip_arc_angle_deg": 4.0},
    "extended_cycloid": {"trochoid_ratio": 1.3},
    "ellipse": {"ellipse_center_mm": 27.0, "ellipse_height_mm": 18.0},
}
every_family = pytest.mark.parametrize("family", DESIGNS)


def config_of(family, lobes=3, **changes):
    """The profile section of a config."""
    with open("configs/cic.yaml", encoding="utf-8") as file:
        rest = file.read().split("\nrotor:")[1]
    keys = {"family": family, "lobes": lobes, "pitch_radius_mm": 33.0, **DESIGNS[family]} | changes
    inside = ", ".join(f"{key}: {value}" for key, value in keys.items())
    return parse(f"profile: {{{inside}}}\nrotor:{rest}").profile


def profile_like(family, **changes):
    config = config_of(family, **changes)
    return profile_of(family, config.lobes, jnp.asarray(R), design_of(config))


# Known numbers


@pytest.mark.parametrize(
    ("lobes", "center", "tip_radius", "efficiency"),
    [(2, 0.8, 1.51318, 0.51382), (3, 0.9, 1.40115, 0.45679)],
)
def test_single_arc(lobes, center, tip_radius, efficiency):
    found = measure(arc(lobes, 1.0, center))
    assert float(found.outer_radius) == pytest.approx(tip_radius, abs=5e-6)
    assert float(found.area_efficiency) == pytest.approx(efficiency, abs=5e-6)


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
    """US 7,320,579, claim 1, with centre distance L and two lobes: base radius above L / 2√2 and
    arc above √2 π L / 16, where the involute is the longest at 45°; arc below (27 - 5√2) L / 56,
    where it has none and the tip lies at 3 L / 4."""
    distance = 1.0
    r = distance / 2
    longest = r * np.sin(np.pi / 4) * np.pi / 4
    least = profile_of("arc_involute", 2, jnp.asarray(r), jnp.asarray([45.0, longest * 1e3]))
    assert isinstance(least, CIC)
    assert float(least.base_radius) == pytest.approx(distance / (2 * np.sqrt(2)), rel=1e-12)
    assert float(least.arc_radius) == pytest.approx(np.sqrt(2) / 16 * np.pi * distance, rel=1e-12)
    assert float(least.arc_radius) == pytest.approx(0.27768, abs=5e-6)

    def tip(b):
        return float(measure(arc(2, r, b)).outer_radius) - 0.75 * distance

    radius = float(arc(2, r, brentq(tip, 0.3, 0.45, xtol=1e-12)).radius[0])
    assert radius == pytest.approx((27 - 5 * np.sqrt(2)) / 56 * distance, rel=1e-9)
    assert radius == pytest.approx(0.35587, abs=5e-6)


def test_families_that_become_the_single_arc():
    """Two arcs of one radius, and an ellipse of equal semi-axes."""
    single = arc(3, R, 0.9 * R)
    radius = float(single.radius[0])
    for other in (four_arcs(3, R, 0.9 * R, radius, 0.7), ellipse(3, R, 0.9 * R, radius)):
        for one, same in zip(
            jax.tree.leaves(measure(single)), jax.tree.leaves(measure(other)), strict=True
        ):
            assert float(same) == pytest.approx(float(one), rel=1e-9)


def test_five_arcs_are_tangent_and_pass_the_pitch_crossing():
    profile = five_arcs(3, R, 0.045, 3 * DEG, 0.013, 60 * DEG)
    for joint in profile.joints[1:-1]:
        sides = [profile.position(profile.addendum(joint + d)) for d in (-1e-9, 1e-9)]
        np.testing.assert_allclose(*sides, rtol=0, atol=1e-10)
    assert float(profile.contact_distance(profile.pitch_normal)) == pytest.approx(0, abs=1e-15)
    assert float(profile.roll_angle(profile.pitch_normal)) == pytest.approx(np.pi / 6, rel=1e-12)
    assert float(measure(profile).seal_width) == pytest.approx(2 * 3 * DEG * 0.045)


# What every family must hold


@every_family
def test_curve_is_the_one_its_normals_say(family):
    """Normals, levers, arc lengths and the inverse of the roll angle, by differentiation of the
    outline; the law of gearing ds/dβ = -r cos ψ."""
    profile = profile_like(family)
    for segment in profile.segments():
        start, stop = float(segment.start), float(segment.stop)
        nu = jnp.linspace(start + 0.01, stop - 0.01, 9) if stop > start + 0.1 else jnp.zeros(0)
        for at in nu:
            place, speed = jax.jvp(
                lambda x: profile.position(profile.addendum(x)), (at,), (jnp.ones_like(at),)
            )
            tangent = np.array([-np.sin(at), np.cos(at)])
            np.testing.assert_allclose(
                speed, float(profile.addendum_speed(at)) * tangent, atol=1e-9
            )
            assert float(np.dot(place, tangent)) == pytest.approx(
                -float(profile.lever(at)), abs=1e-12
            )
            rate = float(profile.roll_rate(at))
            slope = jax.jvp(profile.contact_distance, (at,), (jnp.ones_like(at),))[1]
            assert float(slope) == pytest.approx(-float(profile.lever(at)) * rate, abs=1e-9)
        if not segment.land and nu.size:
            np.testing.assert_allclose(profile.normal_at(profile.roll_angle(nu)), nu, atol=1e-9)


@every_family
def test_area_is_that_of_the_outline(family, graded_outline):
    profile = profile_like(family)
    points = graded_outline(profile, 4000) @ [1, 1j]
    area = np.sum((np.conj(points[:-1]) * points[1:]).imag) / 2
    assert float(measure(profile).area) == pytest.approx(area, rel=1e-6)


@every_family
def test_rolling_pair_touches_and_does_not_overlap(family, graded_outline):
    """|gap| < 1 nm through a mesh period, by node search."""
    profile = profile_like(family)
    points = graded_outline(profile, 1000) * 1e3
    for phi in 0.0123 + 2 * np.pi / 3 * np.arange(13) / 13:
        assert abs(pair_gap(points, 3, 66.0, phi, phi)) < 1e-6


@jax.jit
def searched(pair, roll, relative):
    def one(roll, relative):
        attempts, best = pair._search(roll, relative)
        return attempts == 1, best, pair._search(roll, relative, attempt=1)[1]

    return jax.vmap(one)(roll, relative)


@every_family
def test_search_finds_the_closest_approach(family):
    """What Newton's method calls certain is what the nodes find."""
    profile = profile_like(family)
    rng = np.random.default_rng(3)
    half = float(profile.half_pitch)
    roll = jnp.asarray(rng.uniform(-half, half, 3000))
    relative = jnp.asarray(-(10 ** rng.uniform(-7, np.log10(5e-3), 3000)))
    certain, best, nodes = jax.tree.map(np.asarray, searched(FlankPair.of(profile), roll, relative))
    assert np.mean(certain) > 0.5
    both = certain & best.found & nodes.found
    assert np.max(np.abs(best.gap - nodes.gap), where=both, initial=0.0) < 1e-13
    assert not np.any(nodes.found & (nodes.gap < 0) & certain & ~best.found)


@every_family
def test_design_derivatives_of_geometry(family):
    """By each design parameter, against central differences."""
    config = config_of(family)

    def shape(design):
        found = geometry(profile_of(family, 3, jnp.asarray(R), design))
        return jnp.stack([found.area, found.outer_radius, found.polar_area_moment])

    design = design_of(config)
    jacobian = np.asarray(jax.jit(jax.jacfwd(shape))(design))
    values = jax.jit(shape)
    for k in range(design.size):
        step = 1e-5 * float(design[k])
        up, down = (np.asarray(values(design.at[k].add(s))) for s in (step, -step))
        size = np.abs(np.asarray(values(design)))
        difference = (up - down) / (2 * step)
        np.testing.assert_allclose(
            jacobian[:, k] * float(design[k]) / size,
            difference * float(design[k]) / size,
            atol=1e-8,
        )


# Use by name


@every_family
def test_config_wants_the_keys_of_the_family(family):
    check(config_of(family))
    for key in FAMILY_KEYS[family]:
        with pytest.raises(InputError, match=rf"profile\.{key}"):
            config_of(family, **{key: "null"})
    with pytest.raises(InputError, match=r"profile\..* does not belong to family"):
        config_of(family, **{"ellipse_center_mm" if family != "ellipse" else "arc_center_mm": 20.0})


@pytest.mark.parametrize(
    ("family", "changes", "fault"),
    [
        ("arc", {"arc_center_mm": 32.5}, "undercut"),
        ("arc", {"arc_center_mm": 34.0}, "miss the pitch circle|mesh at once|undercut"),
        ("four_arcs", {"tip_arc_turn_deg": 120.0}, "end before|convex"),
        ("five_arcs", {"outer_radius_mm": 60.0}, "undercut|convex|miss|at once"),
        ("five_arcs", {"tip_arc_angle_deg": 20.0, "tip_arc_turn_deg": 10.0}, "end before"),
        ("ellipse", {"ellipse_height_mm": 1.0}, "cross|end before|convex|undercut|miss"),
    ],
)
def test_unsound_profiles_are_refused(family, changes, fault):
    config = config_of(family, **changes)
    with pytest.raises(InputError, match=fault):
        check(config)
