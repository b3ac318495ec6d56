"""Families beside CIC and EE: known numbers, limits, conjugacy, contact, use by name."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from rootsopt.config import FAMILY_KEYS, parse
from rootsopt.config.families import family_of
from rootsopt.contact.closest import FlankPair
from rootsopt.contact.nodes import pair_gap
from rootsopt.errors import InputError
from rootsopt.families import check, design_of, profile_of
from rootsopt.optimize.problem import sobol
from rootsopt.profiles import CIC, EE, arc, geometry
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
COUNT = 1401
"""Places on a flank, always as many, so that they are looked at by one program."""
every_family = pytest.mark.parametrize("family", DESIGNS)


def families_besides(*others):
    """Every family, the `others` (which share the code of the rest) in long runs only."""
    long = {family: pytest.param(family, marks=pytest.mark.long) for family in others}
    return pytest.mark.parametrize("family", [long.get(family, family) for family in DESIGNS])


def config_of(family, lobes=3, **changes):
    """The profile section of a config."""
    with open("configs/cic.yaml", encoding="utf-8") as file:
        rest = file.read().split("\nrotor:")[1]
    keys = {"family": family, "lobes": lobes, "pitch_radius_mm": 33.0, **DESIGNS[family]} | changes
    inside = ", ".join(f"{key}: {value}" for key, value in keys.items())
    return parse(f"profile: {{{inside}}}\nrotor:{rest}").profile


@functools.cache
def maker(family):
    """Design to profile."""
    return jax.jit(lambda design: profile_of(family, 3, jnp.asarray(R), design))


@functools.cache
def made(family):
    """The profile of the family's design."""
    return maker(family)(design_of(config_of(family)))


@jax.jit
def looked_at(profile, nu):
    """Everything the core says of normal angles, and slopes by them."""

    def along(nu):
        point = profile.addendum(nu)
        return profile.position(point), point.s

    (place, _), (speed, s_slope) = jax.jvp(along, (nu,), (jnp.ones_like(nu),))
    return {
        "addendum": place,
        "dedendum": profile.position(profile.dedendum(nu)),
        "speed": speed,
        "s_slope": s_slope,
        "lever": profile.lever(nu),
        "support": profile.support(nu),
        "rate": profile.roll_rate(nu),
        "length": profile.addendum_speed(nu),
        "inverse": profile.normal_at(profile.roll_angle(nu)),
    }


@functools.cache
def sampled(family):
    """Normal angles, always as many, with all joints, and what is there."""
    segments = [(float(s.start), float(s.stop)) for s in made(family).segments()]
    segments = [(start, stop) for start, stop in segments if stop > start]
    counts = [max(60, round(1200 * (stop - start) / segments[-1][1])) for start, stop in segments]
    counts[-1] += COUNT - 1 - sum(counts)
    inside = [(np.arange(n) + 1e-9) / n for n in counts]
    nu = [a + (b - a) * x for (a, b), x in zip(segments, inside, strict=True)]
    nu = np.append(np.concatenate(nu), segments[-1][1])
    found = looked_at(made(family), jnp.asarray(nu))
    return nu, {key: np.asarray(value) for key, value in found.items()}


@functools.cache
def outline_of(family):
    """Closed outline in mm, crowded where the flank turns."""
    _, found = sampled(family)
    flank = np.concatenate([found["addendum"], found["dedendum"][-2::-1]]) @ [1, 1j] * 1e3
    lobe = np.concatenate([flank[:-1], (np.conj(flank) * np.exp(2j * np.pi / 3))[:0:-1]])
    whole = np.concatenate([*(lobe * np.exp(2j * np.pi * k / 3) for k in range(3)), lobe[:1]])
    return np.stack([whole.real, whole.imag], axis=-1)


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


def test_margins_are_the_least_between_the_places_too():
    """Undercut and star margin of an arc are least inside a segment: in 400 places they are seen
    up to 1e-5 too great, with the parabola through three of them right to 3e-7."""
    sampled = []
    for center in (0.89, 0.9, 0.92):
        profile, fine, coarse = arc(3, 1.0, center), [], []
        for segment in profile.segments():
            share = np.linspace(1e-9, 1 - 1e-9, 1 + 399 * 200)
            nu = float(segment.start) + float(segment.stop - segment.start) * share
            point, _, dedendum = profile.speeds(jnp.asarray(nu))
            sliding = np.sin(point.psi)
            both = np.stack([dedendum, np.minimum(sliding + point.s, sliding - point.s)])
            fine.append(np.min(both, axis=1))
            coarse.append(np.min(both[:, ::200], axis=1))
        least = np.min(fine, axis=0)
        sampled.append(np.min(coarse, axis=0) - least)
        found = margins(profile)
        np.testing.assert_allclose([found.undercut, found.star], least, rtol=0, atol=3e-7)
    assert np.all(np.max(sampled, axis=0) > 2e-6)


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


@pytest.mark.parametrize(
    ("base", "wanted"),
    [(0.353554, 0.27769), (0.353554, 0.343), (0.39, 0.3075), (0.39, 0.352), (0.424264, 0.35587)],
)
def test_patented_rotors_are_sound(base, wanted):
    """US 7,320,579 with distance L: for base radii from L / 2√2 to 0.3 √2 L some length of the
    involute gives arcs of the radii claimed, 0.27768 L to 0.35587 L, and rotors that mesh."""
    r, distance = 33.0, 66.0
    angle = np.degrees(np.arccos(base * distance / r))
    longest = r * np.sin(angle * DEG) * np.pi / 4

    def made(length):
        design = jnp.asarray([angle, length])
        return profile_of("arc_involute", 2, jnp.asarray(r * 1e-3), design)

    def beyond(length):
        return float(made(length).arc_radius) / (distance * 1e-3) - wanted

    length = brentq(beyond, longest / 2, longest)
    keys = {"pressure_angle_deg": angle, "involute_length_mm": length}
    check(config_of("arc_involute", lobes=2, **keys))
    assert float(made(length).base_radius) == pytest.approx(base * distance * 1e-3, rel=1e-12)
    assert min(float(margin) for margin in margins(made(length))) > -1e-9


def test_families_that_become_another():
    """Two arcs of one radius and an ellipse of equal semi-axes are the single arc; a circle of
    r / 2N, whole arches without a land and a ratio of 1 are EE."""
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
    """P(θ), its tangents by differences, against the core's form of it."""
    profile = maker("extended_cycloid")(jnp.asarray([ratio]))

    def drawn(theta):
        u = 1 - 6 * theta / np.pi
        away = 1 + (ratio - 1) * u**3 * (10 - 15 * u + 6 * u**2)
        return R * np.exp(1j * theta) * (7 / 6 + away / 6 * np.exp(6j * theta))

    theta = np.linspace(0, np.pi / 6, COUNT + 2)[1:-1]
    normal = (drawn(theta + 1e-6) - drawn(theta - 1e-6)) / 1j
    nu = jnp.asarray(np.angle(normal))
    place = np.asarray(looked_at(profile, nu)["addendum"]) @ [1, 1j]
    np.testing.assert_allclose(place, drawn(theta), rtol=0, atol=1e-9 * R)


def test_edge_describes_an_extended_epicycloid():
    """The mate of an edge lies at its radius from what its centre draws on the partner, and is
    carried over: the contact moves backwards along it."""
    profile = made("arcs_epicycloid")
    nu, found = sampled("arcs_epicycloid")
    edge = np.flatnonzero((nu > profile.joints[1]) & (nu < profile.joints[2]))[::40]
    mate = found["dedendum"][edge]
    center, theta = np.hypot(*profile.center[1]), float(profile.joints[1])
    # The rotor rolls on the partner's pitch circle; a space of the partner lies at π/3.
    turn = np.linspace(-0.5, 0.5, 20001)
    path = 2 * R * np.exp(1j * turn) - center * np.exp(1j * (2 * turn - theta))
    path = np.conj(path) * np.exp(1j * np.pi / 3)
    distance = np.abs(path[:, None] - np.asarray(mate) @ [1, 1j])
    np.testing.assert_allclose(np.min(distance, axis=0), 1e-3, rtol=0, atol=1e-9)
    assert len(edge) == 5
    assert np.all(found["rate"][edge] < 0)
    assert float(margins(profile).rolling) < 0 < float(margins(profile).undercut)


def test_five_arcs_have_their_land():
    """Tangents and the pitch crossing are looked at with those of every family."""
    shape = measure(made("five_arcs"))
    assert float(shape.outer_radius) == pytest.approx(0.045, rel=1e-12)
    assert float(shape.seal_width) == pytest.approx(2 * 3 * DEG * 0.045)


# What every family must hold


@every_family
def test_curve_is_the_one_its_normals_say(family):
    """Normals, levers, arc lengths and the inverse of the roll angle, by differentiation of the
    outline; the law of gearing ds/dβ = -r cos ψ."""
    nu, found = sampled(family)
    normal = np.stack([np.cos(nu), np.sin(nu)], axis=-1)
    tangent = np.stack([-np.sin(nu), np.cos(nu)], axis=-1)
    np.testing.assert_allclose(found["speed"], found["length"][:, None] * tangent, atol=1e-9)
    place = found["addendum"]
    np.testing.assert_allclose(np.sum(place * normal, axis=1), found["support"], atol=1e-13)
    np.testing.assert_allclose(np.sum(place * tangent, axis=1), -found["lever"], atol=1e-13)
    np.testing.assert_allclose(found["s_slope"], -found["lever"] * found["rate"], atol=1e-9)
    assert place[0, 1] == pytest.approx(0, abs=1e-11)
    crossing = R * np.array([np.cos(np.pi / 6), 0.5])
    np.testing.assert_allclose(place[-1], crossing, atol=1e-15)
    # Neighbours are next to each other: no joint is torn.
    steps = np.hypot(*np.diff(place, axis=0).T)
    assert np.max(steps) < 2e-3 * R
    # Where one normal only has the roll angle.
    apart = nu > (made(family).joints[2] if family == "arcs_epicycloid" else 0.0)
    np.testing.assert_allclose(found["inverse"][apart], nu[apart], atol=1e-9)


@every_family
def test_what_margins_call_sound_is_one_curve(family):
    """Wherever in its bounds a member is sound, support function and lever go on without a jump,
    and the law of gearing holds: h′ = -lever."""
    inherent, parameters = family_of(family).inherent, family_of(family).parameters
    low, high = np.array([one.usually(1e3 * R, 3) for one in parameters]).T
    sample = low + (high - low) * sobol(128, 1, len(low))

    def looked(design):
        profile = profile_of(family, 3, jnp.asarray(R), design)
        nu = profile.pitch_normal * jnp.linspace(0.0, 1.0, COUNT)
        found = margins(profile)._asdict()
        least = [value for key, value in found.items() if key not in inherent]
        curved = jnp.max(profile.addendum_speed(nu))
        return jnp.min(jnp.stack(least)), curved, nu[1], profile.support(nu), profile.lever(nu)

    designs = jnp.asarray(np.concatenate([[list(DESIGNS[family].values())], sample]))
    found = jax.jit(lambda designs: jax.lax.map(looked, designs))(designs)
    least, curved, step, support, lever = map(np.asarray, found)
    # All but straight flanks: there the lever may change at any rate.
    sound = (least >= -1e-9) & (curved < 3 * R)
    assert np.sum(sound) >= 2
    step, support, lever = step[sound, None], support[sound], lever[sound]
    # By the distance of a centre of curvature from the axis.
    assert np.max(np.abs(np.diff(lever)) / step) < 4 * R
    fall = (lever[:, 1:] + lever[:, :-1]) / 2 * step
    assert np.max(np.abs(np.diff(support) + fall)) < 2e-6 * R


@every_family
def test_area_is_that_of_the_outline(family):
    points = outline_of(family) @ [1, 1j]
    area = np.sum((np.conj(points[:-1]) * points[1:]).imag) / 2
    assert float(measure(made(family)).area) * 1e6 == pytest.approx(area, rel=2e-6)


@every_family
def test_rolling_pair_touches_and_does_not_overlap(family):
    """|gap| < 1 nm through a mesh period, by node search."""
    gaps = [
        pair_gap(outline_of(family), 3, 66.0, phi, phi)
        for phi in 0.0123 + 2 * np.pi / 3 * np.arange(9) / 9
    ]
    assert np.max(np.abs(gaps)) < 1e-6


@jax.jit
def searched(profile, roll, relative):
    pair = FlankPair.of(profile)

    def one(pose):
        attempts, best = pair._search(*pose)
        return attempts == 1, best, pair._search(*pose, attempt=1)[1]

    return jax.lax.map(one, (roll, relative))


@families_besides("arc", "four_arcs", "five_arcs", "arc_involute", "hypo_epicycloid", "ellipse")
def test_search_finds_the_closest_approach(family):
    """What Newton's method calls certain is what the nodes find, and the nodes of outlines."""
    profile = made(family)
    rng = np.random.default_rng(3)
    half = float(profile.half_pitch)
    roll = rng.uniform(-half, half, 2000)
    relative = -(10 ** rng.uniform(-7, np.log10(5e-3), 2000))
    # Right before the middle of the mesh, and where the flank's contact begins.
    begins = float(profile.roll_angle(profile.segments()[-1].start))
    roll[:6] = [0.999 * half, 0.8 * half, 0.5 * half, begins + 1e-2, begins - 1e-3, begins - 1e-2]
    relative[:6] = -1e-3
    found = searched(profile, jnp.asarray(roll), jnp.asarray(relative))
    certain, best, nodes = jax.tree.map(np.asarray, found)
    assert np.mean(certain) > 0.5
    both = certain & best.found & nodes.found
    assert np.max(np.abs(best.gap - nodes.gap), where=both, initial=0.0) < 1e-13
    assert not np.any(nodes.found & (nodes.gap < 0) & certain & ~best.found)
    for x, turn, gap in zip(roll[:6], relative[:6], best.gap[:6], strict=True):
        seen = pair_gap(outline_of(family), 3, 66.0, -x - turn / 2, -x + turn / 2)
        assert min(gap * 1e3, seen) == pytest.approx(seen, abs=2e-6)


@families_besides("arc", "five_arcs", "ellipse")
def test_design_derivatives_of_geometry(family):
    """By each design parameter, against central differences."""

    @jax.jit
    def look(design, way):
        def shape(design):
            found = geometry(profile_of(family, 3, jnp.asarray(R), design))
            return jnp.stack([found.area, found.outer_radius, found.polar_area_moment])

        return jax.jvp(shape, (design,), (way,))

    design = design_of(config_of(family))
    for way in jnp.diag(design):
        value, slope = look(design, way)
        up, down = (look(design + step * way, way)[0] for step in (1e-5, -1e-5))
        difference = (up - down) / 2e-5
        np.testing.assert_allclose(slope / value, difference / value, rtol=0, atol=1e-8)


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
        ("arcs_epicycloid", {"arc_center_mm": 33.0, "edge_radius_mm": 5.0}, "undercut|miss"),
        ("arcs_epicycloid", {"edge_radius_mm": 0.05}, "`profile.edge_radius_mm` must be at least"),
        ("circle_epicycloid", {"tip_arc_turn_deg": 15.0}, "mesh at once"),
        ("circle_epicycloid", {"rolling_radius_mm": 20.0, "tip_arc_turn_deg": 70.0}, "folds back"),
        ("hypo_epicycloid", {"tip_arc_angle_deg": 31.0}, "`profile.tip_arc_angle_deg` = 31"),
        ("extended_cycloid", {"trochoid_ratio": 1.5}, "folds back"),
        ("ellipse", {"ellipse_height_mm": 1.0}, "miss the pitch crossing"),
    ],
)
def test_unsound_profiles_are_refused(family, changes, fault):
    config = config_of(family, **changes)
    with pytest.raises(InputError, match=fault):
        check(config)
