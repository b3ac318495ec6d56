"""Tests of closest approach, the IMPACT law and the timing gear (SI units)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments._common.polygons import pair_gap
from rootsopt.contact import FlankPair, ImpactLaw, ramp
from rootsopt.dynamics.parts import TimingGear
from rootsopt.profiles import CIC, EE

R = 0.033
DEG = np.pi / 180


def cic(lobes, alpha, fraction, tip):
    """Return a CIC profile with u given as a fraction of u_max."""
    longest = R * np.sin(alpha) * (np.pi / (2 * lobes) - tip)
    return CIC(lobes, R, alpha, fraction * longest, tip)


PROFILES = {
    "paper": CIC(3, R, 36.43 * DEG, 9.0e-3, 4.0 * DEG),
    "short involute": cic(3, 0.62, 0.6, 0.06),
    "no land": cic(3, 0.60, 0.85, 0.0),
    "two lobes": cic(2, 0.75, 0.8, 0.08),
    "five lobes": cic(5, 0.50, 0.8, 0.03),
    "ee two": EE(2, R),
    "ee three": EE(3, R),
    "ee four": EE(4, R),
}
few_profiles = pytest.mark.parametrize("profile", [PROFILES["paper"], PROFILES["ee three"]])


def over_poses(function, subject, rolls, relatives):
    """Return the results of a jitted function at poses, padded to one of two batch sizes.

    This saves compilations."""
    count = len(rolls)
    size = 640 if count <= 640 else 3840
    padded = (jnp.asarray(np.resize(a, size)) for a in (rolls, relatives))
    return jax.tree.map(lambda a: np.asarray(a)[:count], function(subject, *padded))


@eqx.filter_jit
def _approach(profile, rolls, relatives):
    return jax.vmap(FlankPair.of(profile))(rolls, relatives)


def approach(profile, rolls, relatives):
    """Return the closest approaches at many poses."""
    return over_poses(_approach, profile, rolls, relatives)


def poses(lobes, count, seed, deepest=-0.020):
    """Return random poses: the whole mesh, and both hand-overs seen from both sides."""
    rng = np.random.default_rng(seed)
    whole = np.pi / lobes
    rolls = np.concatenate(
        [
            rng.uniform(0, whole, count),
            rng.uniform(-0.02, 0.05, count // 2),
            whole + rng.uniform(-0.05, 0.02, count // 2),
        ]
    )
    return rolls, rng.uniform(deepest, 0.0, len(rolls))


# Closest approach against the node method


@few_profiles
def test_coast_flank_is_the_mirror_image(profile, graded_outline):
    """At ε > 0 the pair penetrates like the mirrored drive flank: x → -x, ε → -ε."""
    rolls, relatives = poses(profile.lobes, 8, 2, deepest=-0.012)
    gaps = np.asarray(approach(profile, rolls, relatives).gap)
    points = graded_outline(profile, 1000)
    deep = gaps < -1e-7
    nodes = [
        pair_gap(points, profile.lobes, 2 * R, x + e / 2, x - e / 2)
        for x, e in zip(rolls[deep], relatives[deep], strict=True)
    ]
    np.testing.assert_allclose(gaps[deep], nodes, rtol=0, atol=2e-8)


def test_involute_contact_in_closed_form():
    """Where involute meets involute, both levers are the base radius and the gap is r cos α · ε."""
    profile = PROFILES["short involute"]
    start, half = float(profile.involute_start), float(profile.half_pitch)
    rolls = np.linspace(start + 0.02, 2 * half - start - 0.02, 31)
    for relative in (-0.02, -1e-3, -1e-6, 1e-3):
        found = approach(profile, rolls, np.full(31, relative))
        base = R * np.cos(0.62)
        np.testing.assert_allclose(found.gap, base * relative, rtol=0, atol=1e-16)
        np.testing.assert_allclose([found.lever1, found.lever2], base, rtol=1e-12)


# Derivatives of the closest approach


def results(design, roll, relative):
    found = FlankPair.of(CIC(3, R, design[0], design[1], design[2]))(roll, relative)
    return jnp.stack([found.gap, found.lever1, found.lever2])


forward = jax.jit(jax.vmap(jax.jacfwd(results), (None, 0, 0)))
reverse = jax.jit(jax.vmap(jax.jacrev(results), (None, 0, 0)))
over_designs = jax.jit(jax.vmap(jax.vmap(results, (None, 0, 0)), (0, None, None)))


@pytest.mark.parametrize("involute", [8.0e-3, 6.0e-3])
def test_design_derivatives_of_gap_and_levers(involute):
    """Derivatives in (α, u, θ1) agree with central differences, and forward with reverse mode."""
    design = jnp.array([36.43 * DEG, involute, 4.0 * DEG])
    rolls = jnp.asarray(np.linspace(0.085, np.pi / 3 - 0.085, 41))
    relatives = jnp.asarray(-(10.0 ** np.random.default_rng(6).uniform(-5, -2, 41)))
    derivative = forward(design, rolls, relatives)
    steps = 1e-6 * jnp.diag(design)
    ends = over_designs(jnp.concatenate([design + steps, design - steps]), rolls, relatives)
    differences = np.moveaxis(np.asarray((ends[:3] - ends[3:]) / 2e-6), 0, -1)
    scaled = np.asarray(derivative * design)
    # Per relative change of a parameter, in units of r. Gap: rounding 1e-16 / 1e-6. Levers
    # inherit the search's own error in ν2, 1e-11 and less, divided by the step; where a
    # joint passes under a difference it sees a kink, which two poses may.
    np.testing.assert_allclose(scaled[:, 0], differences[:, 0], rtol=0, atol=1e-7 * R)
    wrong = np.abs(scaled[:, 1:] - differences[:, 1:]).max(axis=(1, 2)) > 1e-4 * R
    assert wrong.sum() <= 2
    assert np.abs(scaled[:, 0]).max() > 1e-4 * R
    backward = np.asarray(reverse(design, rolls, relatives) * design)
    np.testing.assert_allclose(backward, scaled, rtol=0, atol=1e-12 * R)


@pytest.mark.parametrize("fraction", [0.7, 1.0, 1.012])
def test_design_derivatives_are_finite_at_joints(fraction):
    """At joints, at the ends of contact and beside them, derivatives are numbers in both modes.

    The centre of the tip arc lies inside, on or outside the pitch circle."""
    profile = cic(3, 0.62, fraction, 0.06)
    half, start = profile.half_pitch, float(profile.involute_start)
    joints = np.array([0.0, 0.06, start, half, 2 * half - start, 2 * half - 0.06, 2 * half, -half])
    rolls = np.resize((joints[:, None] + [0.0, 1e-16, -1e-16, 1e-9, -1e-9]).ravel(), 41)
    design = jnp.array([0.62, profile.involute_length, 0.06])
    for relative in (0.0, -2e-4):
        at = design, jnp.asarray(rolls), jnp.full(41, relative)
        assert np.all(np.isfinite([forward(*at), reverse(*at)]))


# Rounded corners


@given(x=st.floats(-5, 5), width=st.floats(1e-3, 2))
def test_ramp_lies_under_the_corner_and_meets_it(x, width):
    """0 ≤ ramp ≤ max(0, x), with equality outside 0 < x < width."""
    value = float(ramp(jnp.asarray(x), jnp.asarray(width)))
    corner = max(0.0, x)
    assert 0 <= value <= corner + 1e-15
    if x <= 0 or x >= width:
        assert value == corner
    assert float(ramp(jnp.asarray(x), jnp.asarray(0.0))) == corner


# The IMPACT law


def impact_law(exponent=2.2, damping=250.0, depth=1e-5, smoothing=1e-7):
    """Return about the paper's Table 2 law (8 N at 0.01 mm) in SI units, with some parameters
    changed."""
    values = (8.0 / 1e-5**exponent, exponent, damping, depth, smoothing)
    return ImpactLaw(*(jnp.asarray(float(v)) for v in values))


@jax.jit
def forces(law, depths, rates):
    return jax.vmap(law)(depths, rates)


@jax.jit
def force_slopes(law, depths, rates):
    return jax.vmap(jax.grad(lambda d, v: law(d, v), (0, 1)))(depths, rates)


def plain_law(law, depth, rate):
    """Return the force of the solver's IMPACT law, in NumPy."""
    k, e, c, d = (
        float(v) for v in (law.stiffness, law.exponent, law.damping, law.full_damping_depth)
    )
    depth = np.maximum(np.asarray(depth), 0.0)
    x = np.minimum(depth / d, 1.0)
    total = k * depth**e + c * (3 * x**2 - 2 * x**3) * np.asarray(rate)
    return np.where(depth > 0, np.maximum(total, 0.0), 0.0)


def impacts():
    """Return depths around every seam, and rates from fast release to fast impact."""
    depths = np.concatenate([np.linspace(-2e-5, 4e-5, 121), np.geomspace(1e-9, 1e-4, 81)])
    rates = np.concatenate([-np.geomspace(1e-4, 10, 15), [0.0], np.geomspace(1e-4, 10, 15)])
    return (jnp.asarray(a.ravel()) for a in np.meshgrid(depths, rates))


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.2])
def test_unsmoothed_law_in_closed_form(exponent):
    """With smoothing 0, the force is max(0, K δ^e + C step(δ/d) dδ/dt)."""
    law = impact_law(exponent=exponent, smoothing=0.0)
    depths, rates = impacts()
    np.testing.assert_allclose(
        forces(law, depths, rates), plain_law(law, depths, rates), rtol=1e-10, atol=1e-12
    )


def test_smoothing_leaves_the_law_alone_outside_its_zones():
    """The force equals that of the plain law where δ ≥ h and the force exceeds h/d · K δ^e."""
    law = impact_law(smoothing=5e-7)
    depths, rates = (np.asarray(a) for a in impacts())
    plain = plain_law(law, depths, rates)
    elastic = float(law.stiffness) * np.maximum(depths, 0) ** float(law.exponent)
    outside = (depths <= 0) | ((depths >= 5e-7) & (plain >= 0.05 * elastic))
    assert 0.3 < outside.mean() < 0.99
    smooth = np.asarray(forces(law, depths, rates))
    np.testing.assert_allclose(smooth[outside], plain[outside], rtol=1e-10)
    assert np.all(smooth[~outside] >= 0)
    assert np.any(smooth[~outside] != plain[~outside])


def seams(law, rate):
    """Return the depths at which the law changes its formula, for one rate."""
    h, d = float(law.smoothing), float(law.full_damping_depth)
    places = [0.0, h, d]
    depth = np.linspace(1.5 * h, 30 * d, 300001)
    elastic = float(law.stiffness) * depth ** float(law.exponent)
    x = np.minimum(depth / d, 1.0)
    total = elastic + float(law.damping) * (3 * x**2 - 2 * x**3) * rate
    for level in (total, total - h / d * elastic):
        crossing = np.flatnonzero(np.diff(np.sign(level)))
        places.extend(depth[crossing])
    return places


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.2])
@pytest.mark.parametrize("rate", [-0.5, -0.1, 0.0, 0.5])
def test_law_is_continuously_differentiable(exponent, rate):
    """Force and slopes over depth and rate do not jump at any seam of the law."""
    law = impact_law(exponent=exponent, smoothing=1e-6)
    places = seams(law, rate)
    assert rate >= 0 or len(places) >= 5
    # Cross each seam with shrinking steps: a jump stays, the change of a C¹ law shrinks.
    changes = []
    for reach in (1e-8, 1e-10):
        offsets = reach * np.linspace(-1, 1, 41)
        depths = jnp.asarray((np.array(places)[:, None] + offsets).ravel())
        slopes = force_slopes(law, depths, jnp.full_like(depths, rate))
        table = [np.asarray(s).reshape(len(places), -1) for s in slopes]
        changes.append(max(np.ptp(s, axis=1).max() / np.abs(s).max() for s in table))
    assert changes[1] < 0.02
    assert changes[1] < 0.3 * changes[0] + 1e-9


# The timing gear


def timing_gear(rounding=3e-6):
    values = (2.0e4, 1.7, 7.5e-4, rounding)
    return TimingGear(*(jnp.asarray(v) for v in values))


@jax.jit
def gear_torques(gear, relatives, rates):
    return jax.vmap(gear)(jnp.asarray(relatives), jnp.asarray(rates))


@pytest.mark.parametrize("rounding", [0.0, 3e-6])
def test_timing_gear_in_closed_form(rounding):
    """The torque is 0 inside the backlash, and stiffness · excess + damping · rate beyond the
    rounding."""
    gear = timing_gear(rounding)
    rates = np.linspace(-3, 3, 41)
    inside = gear_torques(gear, 7.5e-4 * np.linspace(-1, 1, 41), rates)
    np.testing.assert_array_equal(inside, 0)
    excess = rounding + np.geomspace(1e-8, 1e-2, 41)
    for side in (1, -1):
        torque = gear_torques(gear, side * (7.5e-4 + excess), rates)
        np.testing.assert_allclose(torque, side * 2e4 * excess + 1.7 * rates, rtol=1e-8, atol=1e-9)


def test_rounded_edges_of_the_gear_keep_their_integrals():
    """Across the rounding, the spring stores k w² / 2 and the damper takes c w ε̇, as at a sharp
    edge.

    Neither pushes in the wrong direction."""
    gear, width = timing_gear(), 3e-6
    nodes, weights = np.polynomial.legendre.leggauss(8)
    excess = width * (nodes + 1) / 2
    weights = weights * width / 2
    for side in (1, -1):
        relative = side * (7.5e-4 + excess)
        spring = side * np.asarray(gear_torques(gear, relative, np.zeros(8)))
        damper = np.asarray(gear_torques(gear, relative, np.full(8, 0.4))) - side * spring
        assert np.sum(weights * spring) == pytest.approx(2e4 * width**2 / 2, rel=1e-9)
        assert np.sum(weights * damper) == pytest.approx(1.7 * 0.4 * width, rel=1e-9)
        assert np.all(np.diff(spring) > 0)
        assert np.all(damper >= 0)


def test_no_root_is_lost_on_a_node():
    """A root of T on a search node is also found in compiled programs.

    A single lost grid point put a peak of 2000 N into the force of this design, whose u is near its
    minimum."""
    deepest = -0.00859830772827668
    first = -2 * np.sqrt(-deepest) - 0.02
    step = (np.pi / 6 - first) / 124
    roll = first + step * jnp.arange(128)
    relative = deepest - deepest / 20 * jnp.arange(24)
    flank = np.asarray(roll) > 0.2
    design = jnp.asarray([27.305899038181646, 0.7591908244251282, 1.267598407749901])

    @jax.jit
    def table(design):
        angle, length, tip = design
        profile = CIC(3, jnp.asarray(0.033), angle * np.pi / 180, length * 1e-3, tip * np.pi / 180)
        pair = FlankPair.of(profile)
        return jax.vmap(lambda x: jax.vmap(lambda e: pair(x, e))(relative))(roll)

    contact = table(design)
    assert np.all(np.asarray(contact.found)[flank])
    assert np.max(np.asarray(contact.gap)[flank][:, relative <= 0]) < 1e-12


@pytest.mark.parametrize(("lobes", "tip"), [(2, 0.5), (2, 3.28), (3, 4.0)])
def test_contact_beside_a_land_is_not_lost_between_nodes(lobes, tip):
    """The search finds contacts that a dense grid of normals finds.

    At the start of contact, the flank segment that can touch is far shorter than the distance
    between nodes. If the contact were missed, it would start at a depth of 1 µm, and the gradient
    of the mean force would be wrong by 3e-3."""
    profile = cic(lobes, 0.67, 0.5, tip * DEG)
    pair = FlankPair.of(profile)
    low, high = float(profile.segments()[0].stop), float(pair.nodes.normal[-1])
    beyond = np.concatenate([[0.0], np.geomspace(1e-5, 0.2, 4000), [0.3, 0.5, 1.0]])
    normals = low + (high - low) * beyond

    def dense(pose):
        folded, _ = pair.folded(pose[0])
        offset, gap = jax.vmap(lambda normal: pair._mesh(normal, folded, pose[1])[:2])(normals)
        falls = (offset[:-1] >= 0) & (offset[1:] < 0)
        return pair(*pose), jnp.min(jnp.where(falls, gap[:-1], jnp.inf))

    rolls, relatives = np.linspace(-0.08, 0.03, 45), np.array([-4e-3, -1e-3, -1e-4])
    poses = np.array([(low + roll, relative) for relative in relatives for roll in rolls])
    found, least = jax.jit(lambda poses: jax.lax.map(dense, poses))(poses)
    seen = np.abs(least) < 1e-5
    assert 10 < np.sum(seen) < len(poses)
    assert np.asarray(found.found)[seen].all()
    assert np.asarray(found.gap)[seen] == pytest.approx(np.asarray(least)[seen], abs=1e-9)
