"""Profiles agree with closed forms, the paper's equations and numerical differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate

from rootsopt.profiles import CIC, EE, flank, geometry, outline

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


def inner_normals(profile, count=15, margin=0.02):
    """Return normal angles strictly inside the smooth segments.

    They keep clear of joints and pitch point."""
    pieces = [
        np.linspace(a + margin * (b - a), b - margin * (b - a), count)
        for a, b in ((float(s.start), float(s.stop)) for s in profile.segments())
        if b > a
    ]
    return np.concatenate(pieces)


# Area


def mean_square_distance(lobes, alpha, u, tip):
    """Return ⟨s²⟩ over the roll angle of a CIC.

    It comes from plane geometry and adaptive quadrature."""
    half = np.pi / (2 * lobes)
    beta_u = half - u / (R * np.sin(alpha))
    normal = np.exp(1j * (beta_u + np.pi / 2 - alpha))
    end = R * np.exp(1j * beta_u) + u / np.tan(alpha) * normal
    ray = np.exp(1j * tip)
    # The arc's centre end - ρ·normal lies on the ray.
    rho = (end * np.conj(ray)).imag / (normal * np.conj(ray)).imag
    center = end - rho * normal

    def on_arc(beta):
        return (rho - abs(R * np.exp(1j * beta) - center)) ** 2

    def on_involute(beta):
        return (R * np.cos(alpha) * (half - beta)) ** 2

    land = tip * (abs(center) + rho - R) ** 2
    arc = integrate.quad(on_arc, tip, beta_u, epsabs=0, epsrel=1e-12, limit=400)[0]
    involute = integrate.quad(on_involute, beta_u, half, epsabs=0, epsrel=1e-12)[0]
    return (land + arc + involute) / half


@given(
    lobes=st.integers(2, 6),
    alpha=st.floats(0.5, 0.85),
    fraction=st.floats(0.2, 1.0),
    tip_share=st.floats(0.0, 0.4),
)
def test_area_of_cic_is_that_of_the_mean_square_contact_distance(lobes, alpha, fraction, tip_share):
    """Area = π (r² + ⟨s²⟩) for every CIC with monotone roll angle."""
    tip = tip_share * np.pi / (2 * lobes)
    profile = cic(lobes, alpha, fraction, tip)
    mean = mean_square_distance(lobes, alpha, float(profile.involute_length), tip)
    # Gauss-Legendre of an analytic integrand: rounding, times some 100 operations.
    np.testing.assert_allclose(measure(profile).area, np.pi * (R**2 + mean), rtol=1e-11)


@pytest.mark.parametrize("lobes", range(2, 7))
def test_area_of_ee_is_that_of_the_mean_square_contact_distance(lobes):
    """Area = π (r² + ⟨s²⟩) with s = (r/N) sin(N(π/2N - β))."""
    half = np.pi / (2 * lobes)
    square = integrate.quad(lambda b: (R / lobes * np.sin(lobes * (half - b))) ** 2, 0, half)[0]
    area = measure(EE(lobes, R)).area
    np.testing.assert_allclose(area, np.pi * (R**2 + square / half), rtol=1e-12)


@every_profile
def test_area_and_inertia_are_those_of_a_fine_polygon(profile):
    """Green's theorem on the roll-angle form agrees with shoelace sums of the outline."""
    x, y = np.asarray(outline(profile, 1500)).T
    cross = x[:-1] * y[1:] - x[1:] * y[:-1]
    second = sum(q[:-1] ** 2 + q[:-1] * q[1:] + q[1:] ** 2 for q in (x, y))
    shape = measure(profile)
    # Chord against arc: (h / radius)² / 12 with h about 0.02 mm on radii of 5 mm and more.
    np.testing.assert_allclose(shape.area, cross.sum() / 2, rtol=1e-6)
    np.testing.assert_allclose(shape.polar_area_moment, (cross * second).sum() / 12, rtol=1e-6)


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


def test_involute_of_the_paper_ends_short_of_the_tip():
    """Eq. 2 ends at radius 41.42 mm and polar angle 17.39°: a connecting arc is needed."""
    profile = paper()
    x, y = np.asarray(profile.position(profile.addendum(profile.arc_end + jnp.zeros(1))))[0]
    assert np.hypot(x, y) * 1e3 == pytest.approx(41.42, abs=5e-3)
    assert np.arctan2(y, x) / DEG == pytest.approx(17.39, abs=5e-3)


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


@every_cic
def test_tip_arc_is_one_circle_tangent_to_land_and_involute(profile):
    """The connecting arc keeps its distance ρ from one centre on the ray θ1, |C| = c."""
    nu = jnp.linspace(profile.tip_arc_angle, profile.arc_end, 33)
    center = profile.arc_center_radius * np.exp(1j * float(profile.tip_arc_angle))
    points = np.asarray(both_flanks(profile, nu)[0][0]) @ [1, 1j]
    normals = (points - center) / float(profile.arc_radius)
    np.testing.assert_allclose(normals, np.exp(1j * np.asarray(nu)), rtol=0, atol=1e-12)


# The law of gearing, normals and curvature, by numerical differentiation


def differentiated(profile, nu, step=1e-4):
    """Return positions (m) of both flanks with first and second differences over ν, as complex."""
    around = [both_flanks(profile, jnp.asarray(nu + k * step))[0] for k in (-1, 0, 1)]
    for before, here, after in zip(*around, strict=True):
        before, here, after = (np.asarray(p) @ [1, 1j] for p in (before, here, after))
        yield here, (after - before) / (2 * step), (after - 2 * here + before) / step**2


@every_profile
def test_normal_angle_is_the_direction_of_the_outline_normal(profile):
    """ν is the polar angle of the outward normal, on the dedendum π/N - 2β + ν."""
    nu = inner_normals(profile)
    _, normals, centers = both_flanks(profile, jnp.asarray(nu))
    np.testing.assert_allclose(normals[0], nu, atol=1e-14)
    np.testing.assert_allclose(normals[1], np.pi / profile.lobes - 2 * centers[0] + nu, atol=1e-14)
    # Counter-clockwise the addendum runs with ν, the dedendum against it.
    for sense, normal, (_, slope, _) in zip(
        (1, -1), normals, differentiated(profile, nu), strict=True
    ):
        outward = sense * slope / 1j
        # Central differences: step² = 1e-8 times curve derivatives of order 1 to 100.
        angle = np.angle(outward * np.exp(-1j * np.asarray(normal)))
        np.testing.assert_allclose(angle, 0, atol=2e-6)


@every_profile
def test_normals_pass_through_the_pitch_point(profile):
    """Law of gearing: the normal at a flank point meets the pitch circle at β."""
    nu = inner_normals(profile)
    _, _, centers = both_flanks(profile, jnp.asarray(nu))
    for beta, (point, slope, _) in zip(centers, differentiated(profile, nu), strict=True):
        tangent = slope / abs(slope)
        miss = ((point - R * np.exp(1j * np.asarray(beta))) * np.conj(tangent)).real
        # Direction error of the differences (2e-6, above) times a distance below r.
        np.testing.assert_allclose(miss, 0, atol=2e-6 * R)


@every_profile
def test_speeds_and_curvature_radii_are_those_of_the_curve(profile):
    """addendum_speed and dedendum_curvature_radius (signed), against finite differences."""
    nu = inner_normals(profile, margin=0.05)
    speeds = [profile.addendum_speed(jnp.asarray(nu)), profile.dedendum_speed(jnp.asarray(nu))]
    bends = [1 / speeds[0], 1 / profile.dedendum_curvature_radius(jnp.asarray(nu))]
    for sense, speed, bend, (_, slope, second) in zip(
        (1, -1), speeds, bends, differentiated(profile, nu), strict=True
    ):
        curvature = sense * (np.conj(slope) * second).imag / abs(slope) ** 3
        # step² times curve derivatives, and for the second difference 1e-16 / step².
        np.testing.assert_allclose(speed, abs(slope), rtol=1e-5)
        np.testing.assert_allclose(bend, curvature, rtol=1e-5, atol=1e-4 / R)


@every_cic
def test_outline_of_cic_has_no_corners(profile):
    """C¹: the greatest turn between neighbouring chords falls with the node spacing."""

    def greatest_turn(points):
        edges = np.diff(np.asarray(outline(profile, points)) @ [1, 1j])
        return np.max(abs(np.angle(np.roll(edges, -1) / edges)))

    # A corner of angle κ would hold the turn at κ; without one it falls fourfold.
    assert greatest_turn(1600) < 0.3 * greatest_turn(400)
    assert greatest_turn(1600) < 0.01


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


@every_profile
def test_outline_has_the_symmetry_of_its_lobes(profile):
    """N-fold rotation and reflection in the x axis map the vertices onto each other."""
    points = np.asarray(outline(profile, 150))[:-1] @ [1, 1j]
    per_lobe, rest = divmod(len(points), profile.lobes)
    assert rest == 0
    turned = points * np.exp(2j * np.pi / profile.lobes)
    np.testing.assert_allclose(turned, np.roll(points, -per_lobe), rtol=0, atol=1e-15)
    mirrored = np.roll(np.conj(points)[::-1], 1)
    np.testing.assert_allclose(mirrored, points, rtol=0, atol=1e-15)


@every_profile
def test_flank_runs_from_tip_to_root(profile):
    """One flank goes from r_a at polar angle 0 over the pitch circle to r_i at π/N."""
    points = np.asarray(flank(profile, 100)) @ [1, 1j]
    shape = measure(profile)
    assert abs(points[0]) == pytest.approx(float(shape.outer_radius), rel=1e-12)
    assert np.angle(points[0]) == pytest.approx(0, abs=1e-12)
    assert abs(points[-1]) == pytest.approx(float(shape.root_radius), rel=1e-12)
    assert np.angle(points[-1]) == pytest.approx(np.pi / profile.lobes, abs=1e-12)
    pitch = R * np.exp(1j * np.pi / (2 * profile.lobes))
    assert np.min(abs(points - pitch)) < 1e-12


# Design derivatives


def quantities(lobes, design):
    shape = geometry(CIC(lobes, R, design[0], design[1], design[2]))
    return jnp.stack([shape.area_efficiency, shape.polar_area_moment, shape.undercut_margin])


forward = jax.jit(jax.jacfwd(quantities, argnums=1), static_argnums=0)
reverse = jax.jit(
    jax.vmap(jax.grad(lambda n, d, i: quantities(n, d)[i], 1), (None, None, 0)), static_argnums=0
)
many = jax.jit(jax.vmap(quantities, (None, 0)), static_argnums=0)


@pytest.mark.parametrize(
    ("lobes", "design"),
    [
        (3, (36.43 * DEG, 8.0e-3, 4.0 * DEG)),
        (3, (36.43 * DEG, 9.0e-3, 4.0 * DEG)),
        (2, (0.75, 12.0e-3, 0.08)),
    ],
)
def test_design_derivatives_of_geometry(lobes, design):
    """Gradients of efficiency, inertia and undercut margin agree with central differences,
    and forward with reverse mode."""
    design = jnp.asarray(design)
    steps = 1e-5 * jnp.diag(design)
    ends = many(lobes, jnp.concatenate([design + steps, design - steps]))
    differences = ((ends[:3] - ends[3:]) / (2e-5 * design)[:, None]).T
    gradients = reverse(lobes, design, jnp.arange(3))
    # Differences: truncation 1e-10, rounding 1e-16 / 1e-5, with some reserve; a component
    # that vanishes is compared with the largest of its row.
    scale = np.max(np.abs(gradients * design), axis=1, keepdims=True)
    assert np.all(np.abs((gradients - differences) * design) < 1e-7 * scale)
    np.testing.assert_allclose(
        forward(lobes, design) * design, gradients * design, rtol=1e-10, atol=1e-12 * scale.min()
    )


def test_geometry_maps_over_designs():
    """geometry() gives the same under vmap as one design at a time."""
    alpha = jnp.array([0.6, 0.65, 0.7])
    tip = jnp.array([0.02, 0.05, 0.0])

    def shape(alpha, tip):
        return geometry(CIC(3, R, alpha, 8e-3, tip))

    mapped = jax.jit(jax.vmap(shape))(alpha, tip)
    for i in range(3):
        single = measure(CIC(3, R, alpha[i], 8e-3, tip[i]))
        for many, one in zip(jax.tree.leaves(mapped), jax.tree.leaves(single), strict=True):
            np.testing.assert_allclose(many[i], one, rtol=1e-12)


# The inverse of the roll angle


@pytest.mark.parametrize("name", [n for n in profiles() if n not in ("paper", "longest involute")])
def test_normal_at_inverts_the_roll_angle(name):
    """ν(β(ν)) = ν from the tip to the pitch point."""
    profile = profiles()[name]
    nu = jnp.linspace(0, float(profile.pitch_normal), 301)
    np.testing.assert_allclose(profile.normal_at(profile.roll_angle(nu)), nu, atol=1e-12)


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


def test_arc_shrinks_to_an_instant_as_its_center_nears_the_pitch_circle():
    """As c → r, the arc's normals mesh within a roll angle that tends to zero."""
    for short in (1e-3, 1e-6, 1e-9):
        profile = cic(3, 0.62, 1 - short, 0.06)
        start, stop = float(profile.tip_arc_angle), float(profile.involute_start)
        beta = start + (stop - start) * jnp.linspace(0, 1, 11)
        normal = profile.normal_at(beta)
        assert np.all(np.diff(normal) > 0)
        # β has an absolute rounding of 1e-17, here shared out over the arc.
        tolerance = 1e-12 + 1e-15 / short
        np.testing.assert_allclose(profile.roll_angle(normal), beta, atol=1e-13)
        np.testing.assert_allclose(normal[-1], profile.arc_end, atol=tolerance)
