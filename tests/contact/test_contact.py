"""Tests of closest approach and its search, the IMPACT law and the timing gear (SI units)."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.contact import FlankPair, ImpactLaw
from rootsopt.dynamics.parts import TimingGear
from rootsopt.profiles import CIC, EE, FreeForm
from rootsopt.profiles.soundness import margins
from rootsopt.scene.families import profile_of
from tests.profiles.test_families import DEG, R, cic

PROFILES = {
    "paper": CIC(3, R, 36.43 * DEG, 9e-3, 4 * DEG),
    "short": CIC(3, R, 27.3 * DEG, 0.8e-3, 1.3 * DEG),
    "two lobes, no land": CIC(2, R, 0.75, 8e-3, 0.0),
    "epicycloid": EE(3, R),
}

closest = jax.jit(lambda pair, x, e: jax.vmap(pair)(x, e))
offsets = jax.jit(lambda pair, *at: jax.vmap(pair._mesh)(*at)[0])
paired = jax.jit(FlankPair.of)


def results(design, roll, relative):
    found = FlankPair.of(CIC(3, R, design[0], design[1], design[2]))(roll, relative)
    return jnp.stack([found.gap, found.lever1, found.lever2])


forward = jax.jit(jax.vmap(jax.jacfwd(results), (None, 0, 0)))
reverse = jax.jit(jax.vmap(jax.jacrev(results), (None, 0, 0)))
over_designs = jax.jit(jax.vmap(jax.vmap(results, (None, 0, 0)), (0, None, None)))


def test_involute_contact_in_closed_form():
    """Where involute meets involute, both levers are the base radius and the gap is r cos α · ε."""
    profile = cic(3, 0.62, 0.6, 0.06)
    base = R * np.cos(0.62)
    start, half = float(profile.involute_start), float(profile.half_pitch)
    designs = np.tile([0.62, profile.involute_length, 0.06], (6, 1))
    rolls = np.linspace(start + 0.02, 2 * half - start - 0.02, 41)
    for relative in (-0.02, -1e-3, -1e-6, 1e-3):
        gap, *levers = over_designs(designs, rolls, np.full(41, relative))[0].T
        np.testing.assert_allclose(gap, base * relative, rtol=0, atol=1e-16)
        np.testing.assert_allclose(levers, base, rtol=1e-12)


@pytest.mark.parametrize("involute", [8.0e-3, 6.0e-3])
def test_design_derivatives_of_gap_and_levers(involute):
    design = np.array([36.43 * DEG, involute, 4.0 * DEG])
    rolls = np.linspace(0.085, np.pi / 3 - 0.085, 41)
    relatives = -(10.0 ** np.random.default_rng(6).uniform(-5, -2, 41))
    steps = 1e-6 * np.diag(design)
    ends = over_designs(np.concatenate([design + steps, design - steps]), rolls, relatives)
    differences = np.moveaxis(np.asarray((ends[:3] - ends[3:]) / 2e-6), 0, -1)
    scaled = np.asarray(forward(design, rolls, relatives) * design)
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
    design = np.array([0.62, profile.involute_length, 0.06])
    for relative in (0.0, -2e-4):
        at = design, rolls, np.full(41, relative)
        assert np.all(np.isfinite([forward(*at), reverse(*at)]))


# The IMPACT law


# The force and its slopes in depth and rate.
forces = jax.jit(lambda law, *at: jax.vmap(jax.value_and_grad(lambda at: law(*at)))(at))


def rounded(x, width):
    """Return max(0, x), with its corner rounded over `width`, in NumPy."""
    share = np.clip(x / np.maximum(width, 1e-300), 0, 1)
    return np.maximum(x, 0) * share * (2 - share)


def written(law, depth, rate):
    """Return the force of the IMPACT law as it is written, in NumPy."""
    delta = rounded(depth, float(law.smoothing))
    x = np.minimum(delta / float(law.full_damping_depth), 1.0)
    elastic = float(law.stiffness) * delta ** float(law.exponent)
    total = elastic + float(law.damping) * (3 * x**2 - 2 * x**3) * rate
    return rounded(total, float(law.smoothing / law.full_damping_depth) * elastic)


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.2])
@pytest.mark.parametrize("smoothing", [0.0, 1e-6])
def test_law_in_closed_form(exponent, smoothing):
    """About the paper's law (8 N at 0.01 mm), around every seam, from fast release to fast impact.

    Force and slopes of a rounded law have no jump."""
    law = ImpactLaw(*map(jnp.asarray, (8.0 / 1e-5**exponent, exponent, 250.0, 1e-5, smoothing)))
    depths = np.concatenate([np.linspace(-2e-5, 4e-5, 121), np.geomspace(1e-9, 1e-4, 81)])
    fast = np.geomspace(1e-4, 10, 15)
    depths, rates = np.reshape(np.meshgrid(depths, np.append(-fast, [0.0, *fast])), (2, -1))
    found, slopes = forces(law, jnp.asarray(depths), jnp.asarray(rates))
    np.testing.assert_allclose(found, written(law, depths, rates), rtol=1e-10, atol=1e-12)
    for slope, way in zip(slopes, 1e-12 * np.eye(2) * [1, 1e4], strict=True):
        ends = [written(law, depths + s * way[0], rates + s * way[1]) for s in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * np.sum(way))
        if smoothing:
            np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-6 * np.max(expected))


# The timing gear


@jax.jit
def gear_torques(rounding, relatives, rates):
    gear = TimingGear(*map(jnp.asarray, (2.0e4, 1.7, 7.5e-4)), rounding)
    return jax.vmap(gear)(relatives, rates)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("rounding", [0.0, 3e-6])
def test_timing_gear_in_closed_form(rounding, side):
    """The torque is 0 inside the backlash, and stiffness · excess + damping · rate beyond the
    rounding.

    Across the rounding, the spring stores k w² / 2 and the damper takes c w ε̇, as at a sharp edge.
    Neither pushes in the wrong direction."""
    rates = np.linspace(-3, 3, 41)
    assert not np.any(gear_torques(rounding, 7.5e-4 * np.linspace(-1, 1, 41), rates))
    excess = rounding + np.geomspace(1e-8, 1e-2, 41)
    torque = gear_torques(rounding, side * (7.5e-4 + excess), rates)
    np.testing.assert_allclose(torque, side * 2e4 * excess + 1.7 * rates, rtol=1e-8, atol=1e-9)
    if rounding:
        nodes, weights = np.polynomial.legendre.leggauss(41)
        relative = side * (7.5e-4 + rounding * (nodes + 1) / 2)
        spring = side * np.asarray(gear_torques(rounding, relative, np.zeros(41)))
        damper = np.asarray(gear_torques(rounding, relative, np.full(41, 0.4))) - side * spring
        expected = 2e4 * rounding, 1.7 * 0.4 * 2
        np.testing.assert_allclose([weights @ spring, weights @ damper], expected, rtol=1e-9)
        assert np.all(np.diff(spring) > 0)
        assert np.all(damper >= 0)


# The search


@eqx.filter_jit
def _sampled(pair, normals, roll, relative):
    """Return the deepest of all common normals on nodes (m), their number, and the search's
    result."""

    def one(at):
        folded, _ = pair.folded(at[0])
        offset, gap, *_ = jax.vmap(lambda nu: pair._mesh(nu, folded, at[1]))(normals)
        falls = (offset[:-1] >= 0) & (offset[1:] < 0)
        return jnp.min(jnp.where(falls, gap[1:], jnp.inf)), jnp.sum(falls), pair(*at)

    return jax.lax.map(one, (roll, relative))


def on_nodes(pair, roll, relative):
    """Return this for 4001 even nodes on a pair's flank."""
    normals = jnp.linspace(pair.nodes.normal[0], pair.nodes.normal[-1], 4001)
    found = _sampled(pair, normals, jnp.asarray(roll), jnp.asarray(relative))
    return jax.tree.map(np.asarray, found)


def test_no_root_is_lost_on_a_node():
    """A root of T on a search node is also found in compiled programs.

    A single lost grid point put a peak of 2000 N into the force of this design, whose u is near its
    minimum."""
    deepest = -0.00859830772827668
    first = -2 * np.sqrt(-deepest) - 0.02
    roll = first + (np.pi / 6 - first) / 124 * jnp.arange(128)
    relative = deepest - deepest / 20 * jnp.arange(24)

    @jax.jit
    def table(angle, length, tip):
        profile = CIC(3, jnp.asarray(0.033), angle * np.pi / 180, length * 1e-3, tip * np.pi / 180)
        pair = FlankPair.of(profile)
        return jax.vmap(lambda x: jax.vmap(lambda e: pair(x, e))(relative))(roll)

    contact = table(27.305899038181646, 0.7591908244251282, 1.267598407749901)
    flank = np.asarray(roll) > 0.2
    assert np.all(np.asarray(contact.found)[flank])
    assert np.max(np.asarray(contact.gap)[flank][:, relative <= 0]) < 1e-12


@pytest.mark.parametrize(("lobes", "tip"), [(2, 0.5), (2, 3.28), (3, 4.0)])
def test_contact_beside_a_land_is_not_lost_between_nodes(lobes, tip):
    """The search finds contacts that a dense grid of normals finds.

    At the start of contact, the flank segment that can touch is far shorter than the distance
    between nodes. If the contact were missed, it would start at a depth of 1 µm, and the gradient
    of the mean force would be wrong by 3e-3."""
    profile = cic(lobes, 0.67, 0.5, tip * DEG)
    pair = paired(profile)
    low, high = float(profile.segments()[0].stop), float(pair.nodes.normal[-1])
    beyond = np.concatenate([[0.0], np.geomspace(1e-5, 0.2, 4000), [0.3, 0.5, 1.0]])
    poses = np.meshgrid(low + np.linspace(-0.08, 0.03, 45), [-4e-3, -1e-3, -1e-4])
    roll, relative = (jnp.asarray(x.ravel()) for x in poses)
    sampled = _sampled(pair, jnp.asarray(low + (high - low) * beyond), roll, relative)
    least, _, found = jax.tree.map(np.asarray, sampled)
    seen = np.abs(least) < 1e-5
    assert 10 < np.sum(seen) < len(roll)
    assert found.found[seen].all()
    assert found.gap[seen] == pytest.approx(least[seen], abs=1e-9)


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("error_mm", [-0.3, 0.3])
def test_root_is_found_to_twelve_digits(name, error_mm):
    """T vanishes to 1e-12 of the pitch radius over ±20 mrad and ±0.3 mm of centre distance.

    This holds wherever T crosses zero smoothly. The two normals are parallel by construction."""
    profile, rng = PROFILES[name], np.random.default_rng(0)
    pair = paired(profile, 2 * R + error_mm * 1e-3)
    pose = rng.uniform(0, float(profile.half_pitch), 4000), rng.uniform(-0.02, 0.02, 4000)
    found = closest(pair, *pose)
    offset = np.abs(offsets(pair, found.normal2, *pose)) / R
    touching = np.asarray(found.found)
    assert np.mean(touching) > 0.6
    assert np.quantile(offset[touching], 0.995) < 1e-12
    # At a kink inside the bracket, the error of the gap is T² divided by the curvature.
    assert np.max(offset[touching]) < 1e-6


WAVY = (1.0, 0.9463, 0.666, 0.8701, 1.0, 0.7063, 0.503, 0.5937, 0.7152, 0.847, 0.9257, 0.2332)
"""Coefficients of a free form whose gap has two minima of nearly equal depth, and a third one."""


@pytest.mark.parametrize("seed", range(2))
def test_deepest_of_several_minima_is_found_on_a_wavy_flank(seed):
    """The search finds the deepest of several minima, and the rank tells which one it is.

    Newton's method from perfect rolling ends at either minimum. Intervals of nodes lead to the
    first or the last one."""
    rng = np.random.default_rng(seed)
    moved = np.clip(np.array(WAVY) + rng.uniform(-0.2, 0.2, len(WAVY)) * (seed > 0), -1, 1)
    roll = np.append(rng.uniform(-0.1, 0.4, 200), np.linspace(0.1, 0.11, 100))
    relative = -np.append(10 ** rng.uniform(-4, -2.4, 200), np.full(100, 1.7437e-3))
    pair = paired(FreeForm(3, R, 1.2658 * DEG, moved))
    deepest, count, found = on_nodes(pair, roll, relative)
    touching = found.found & (deepest < -1e-7) & (deepest > -1e-3)
    assert touching.sum() > 100
    np.testing.assert_allclose(found.gap[touching], deepest[touching], rtol=0, atol=5e-8)
    if seed == 0:
        assert np.sum(count[-100:] > 1) > 50
        # The contact jumps once, from the first minimum to the second.
        assert np.abs(np.diff(found.normal2[-100:])).max() > 0.15
        assert np.sum(np.diff(found.rank[-100:]) != 0) >= 1


@functools.partial(jax.jit, static_argnums=0)
def made(family, design):
    """Return a profile, its margins, and the roll angle at its last joint."""
    profile = profile_of(family, 3, jnp.asarray(R), design)
    return profile, margins(profile), profile.roll_angle(profile.segments()[-2].stop)


@pytest.mark.parametrize(
    ("family", "design"),
    [
        ("four_arcs", (23.964, 20.659, 34.22)),
        ("five_arcs", (45.19, 1.9156, 15.912, 84.69)),
        pytest.param("five_arcs", (42.343, 10.22, 22.498, 12.356), marks=pytest.mark.long),
    ],
)
def test_deeper_minimum_away_from_rolling_is_found(family, design):
    """On a sound profile whose gap has two minima, the search finds the deeper one.

    Newton's method from perfect rolling converges to the other one. For less relative rotation than
    `Profile.single_turn`, it need not be suspected, unless the contact is beside a joint."""
    profile, sound, joint = made(family, jnp.asarray(design))
    assert all(float(value) >= -1e-9 for value in sound)
    rng = np.random.default_rng(0)
    turn = np.append(rng.uniform(2e-3, 5e-3, 100), 10 ** rng.uniform(-5, -2.4, 200))
    beside = float(joint) + rng.uniform(-8, 8, 100) * turn[-100:]
    roll = np.concatenate([rng.uniform(0.1, 0.3, 100), rng.uniform(-0.05, 0.5, 100), beside])
    deepest, count, found = on_nodes(paired(profile), roll, -turn)
    touching = found.found & (deepest < -1e-7) & (deepest > -1e-3)
    assert np.sum(touching & (count > 1)) > 5
    np.testing.assert_allclose(found.gap[touching], deepest[touching], rtol=0, atol=5e-8)


def test_deepest_of_three_minima_is_found_at_a_small_centre_distance():
    """The gap has a minimum on the land, on the involute and beside the pitch crossing. Intervals
    of nodes lead to the first or the last one, and the involute's may be the deepest."""
    two_sided = jax.jit(functools.partial(FlankPair.of, two_sided=True))
    pair = two_sided(PROFILES["paper"], 2 * R - 5e-5)
    rng = np.random.default_rng(0)
    roll, turn = rng.uniform(0.06, 0.07, 300), rng.uniform(1.4e-3, 1.7e-3, 300)
    deepest, count, found = on_nodes(pair, roll, -turn)
    assert np.sum(count > 2) > 20
    np.testing.assert_allclose(found.gap, deepest, rtol=0, atol=5e-8)


@jax.grad
def gap_slope(at, profile):
    return FlankPair.of(profile, at[2])(at[0], at[1]).gap


slope, bend = jax.jit(gap_slope), jax.jit(jax.jacfwd(gap_slope))


@pytest.mark.parametrize("name", ["paper", "short", "epicycloid"])
def test_second_derivatives_are_those_of_the_gap(name):
    profile, step, scale = PROFILES[name], np.array([1e-6, 1e-6, 1e-9]), np.array([R, R, 1.0])
    for roll in (0.3, 0.4, 0.62, 0.8):
        at = jnp.array([roll, -3e-4, 2 * R])
        found = np.asarray(bend(at, profile)) * R / np.outer(scale, scale)
        ends = [[slope(at + s * way, profile) for way in np.diag(step)] for s in (1, -1)]
        differences = np.subtract(*ends) / (2 * step[:, None]) * R / np.outer(scale, scale)
        np.testing.assert_allclose(found, differences, atol=1e-5 * np.max(np.abs(found)))
