"""Tests of the exactness of the search, and of batches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.contact.closest import FlankPair
from rootsopt.profiles import CIC, EE, FreeForm
from rootsopt.profiles.soundness import margins
from rootsopt.scene.families import profile_of

R = 0.033
DEG = np.pi / 180
PAPER = CIC(3, R, 36.43 * DEG, 9e-3, 4 * DEG)
SHORT = CIC(3, R, 27.3 * DEG, 0.8e-3, 1.3 * DEG)
PROFILES = {
    "paper": PAPER,
    "short": SHORT,
    "five lobes": CIC(5, R, 36 * DEG, 3e-3, 1 * DEG),
    "epicycloid": EE(3, R),
}

closest = eqx.filter_jit(lambda pair, x, e: jax.vmap(pair)(x, e))
paired = eqx.filter_jit(FlankPair.of)
every_profile = pytest.mark.parametrize("name", PROFILES)


def poses(count, half, seed=0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(0, half, count)), jnp.asarray(rng.uniform(-0.02, 0.02, count))


# The search


@every_profile
@pytest.mark.parametrize("error_mm", [-0.3, 0.3])
def test_root_is_found_to_twelve_digits(name, error_mm):
    """T vanishes to 1e-12 of the pitch radius over ±20 mrad and ±0.3 mm of centre distance.

    This holds wherever T crosses zero smoothly. The two normals are parallel by construction."""
    profile = PROFILES[name]
    pair = paired(profile, jnp.asarray(2 * R + error_mm * 1e-3))
    x, relative = poses(4000, float(profile.half_pitch))
    found = closest(pair, x, relative)
    mesh = jax.jit(jax.vmap(pair._mesh))
    offset = np.abs(mesh(found.normal2, x, relative)[0]) / R
    touching = np.asarray(found.found)
    assert np.mean(touching) > 0.6
    assert np.quantile(offset[touching], 0.995) < 1e-12
    # At a kink inside the bracket, the error of the gap is T² divided by the curvature.
    assert np.max(offset[touching]) < 1e-6


WAVY = (1.0, 0.9463, 0.666, 0.8701, 1.0, 0.7063, 0.503, 0.5937, 0.7152, 0.847, 0.9257, 0.2332)
"""Coefficients of a free form whose gap has two minima of nearly equal depth, and a third one."""


@eqx.filter_jit
def _sampled(pair, roll, relative):
    """Return the deepest of all common normals on 4000 nodes (m), their number, and the search's
    result."""
    normal = jnp.linspace(pair.nodes.normal[0], pair.nodes.normal[-1], 4001)

    def one(at):
        folded, _ = pair.folded(at[0])
        offset, gap, *_ = jax.vmap(lambda nu: pair._mesh(nu, folded, at[1]))(normal)
        falls = (offset[:-1] >= 0) & (offset[1:] < 0)
        return jnp.min(jnp.where(falls, gap[1:], jnp.inf)), jnp.sum(falls), pair(*at)

    return jax.lax.map(one, (roll, relative))


@pytest.mark.parametrize("seed", range(2))
def test_deepest_of_several_minima_is_found_on_a_wavy_flank(seed):
    """The search finds the deepest of several minima, and the rank tells which one it is.

    Newton's method from perfect rolling ends at either minimum. Intervals of nodes lead to the
    first or the last one."""
    rng = np.random.default_rng(seed)
    moved = np.clip(np.array(WAVY) + rng.uniform(-0.2, 0.2, len(WAVY)) * (seed > 0), -1, 1)
    pair = paired(FreeForm(3, R, 1.2658 * DEG, moved))
    roll = jnp.asarray(np.append(rng.uniform(-0.1, 0.4, 200), np.linspace(0.1, 0.11, 100)))
    relative = jnp.asarray(-np.append(10 ** rng.uniform(-4, -2.4, 200), np.full(100, 1.7437e-3)))
    deepest, count, found = jax.tree.map(np.asarray, _sampled(pair, roll, relative))
    touching = found.found & (deepest < -1e-7) & (deepest > -1e-3)
    assert touching.sum() > 100
    np.testing.assert_allclose(found.gap[touching], deepest[touching], rtol=0, atol=5e-8)
    if seed == 0:
        assert np.sum(count[-100:] > 1) > 50
        # The contact jumps once, from the first minimum to the second.
        assert np.abs(np.diff(found.normal2[-100:])).max() > 0.15
        assert np.sum(np.diff(found.rank[-100:]) != 0) >= 1


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
    profile = profile_of(family, 3, jnp.asarray(R), jnp.asarray(design))
    assert all(float(value) >= -1e-9 for value in margins(profile))
    rng = np.random.default_rng(0)
    turn = np.append(rng.uniform(2e-3, 5e-3, 100), 10 ** rng.uniform(-5, -2.4, 200))
    joint = float(profile.roll_angle(profile.segments()[-2].stop))
    beside = joint + rng.uniform(-8, 8, 100) * turn[-100:]
    roll = np.concatenate([rng.uniform(0.1, 0.3, 100), rng.uniform(-0.05, 0.5, 100), beside])
    sampled = _sampled(paired(profile), jnp.asarray(roll), jnp.asarray(-turn))
    deepest, count, found = jax.tree.map(np.asarray, sampled)
    touching = found.found & (deepest < -1e-7) & (deepest > -1e-3)
    assert np.sum(touching & (count > 1)) > 5
    np.testing.assert_allclose(found.gap[touching], deepest[touching], rtol=0, atol=5e-8)


@pytest.mark.parametrize("name", ["paper", "short", "epicycloid"])
def test_second_derivatives_are_those_of_the_gap(name):
    """The Hessian of the gap in pose and centre distance equals differences of the first
    derivative."""
    profile = PROFILES[name]

    def gap(at):
        return FlankPair.of(profile, at[2])(at[0], at[1]).gap

    slope, bend = jax.jit(jax.grad(gap)), jax.jit(jax.hessian(gap))
    for roll in (0.3, 0.4, 0.62, 0.8):
        at = jnp.array([roll, -3e-4, 2 * R])
        step = np.array([1e-6, 1e-6, 1e-9])
        found = np.asarray(bend(at))
        differences = np.stack(
            [
                (slope(at.at[i].add(h)) - slope(at.at[i].add(-h))) / (2 * h)
                for i, h in enumerate(step)
            ]
        )
        scale = np.array([R, R, 1.0])
        size = np.max(np.abs(found * R / np.outer(scale, scale)))
        np.testing.assert_allclose(
            found * R / np.outer(scale, scale),
            differences * R / np.outer(scale, scale),
            atol=1e-5 * size,
        )
