"""Contact from a known root agrees with the search, and its margins with the flags."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import rootsopt
from rootsopt.contact.closest import FlankPair
from rootsopt.contact.search import NearContact, SearchContact
from rootsopt.dynamics.collocation.events import kinds
from rootsopt.profiles import CIC, arc, four_arcs
from rootsopt.response.evaluation import Evaluator
from tests.dynamics.collocation.test_known import ARCS

paired = eqx.filter_jit(FlankPair.of)
SCENES = {
    "cic_drawn": ("cic_drawn", []),
    "ee": ("ee", []),
    "gas and friction": (
        "cic_drawn",
        [
            "scene.load={pressure_difference_Pa: 2.0e4}",
            "contact.friction={static: 0.2, kinetic: 0.1, stiction_speed_mm_s: 100, "
            "friction_speed_mm_s: 1000}",
        ],
    ),
    "pump": ("pump", []),
    "four arcs": ("cic_drawn", ARCS),
}


def _pair(name):
    config = rootsopt.load_config(f"configs/{SCENES[name][0]}.yaml", SCENES[name][1])
    return Evaluator.of(config).pair(config.design)


def _states(pair, count):
    draw = np.random.default_rng(3)
    tau = draw.uniform(0, 1, count)
    states = 0.3 * draw.normal(size=(count, pair.states))
    states[:, 0] = draw.uniform(-1.5, 0.5, count)
    states[:, 1] *= 20
    return jnp.asarray(tau), jnp.asarray(states)


def _near(pair, normals):
    roots = jnp.stack([normals, normals], axis=-1)
    return eqx.tree_at(lambda p: p.contact, pair, NearContact(pair.contact.pair, roots))


# In short runs: scenes with every part, and with a contact that jumps.
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.long] * (n not in ("pump", "four arcs"))) for n in SCENES],
)
def test_margins_have_the_sign_of_the_flags(name):
    pair = _pair(name)
    assert isinstance(pair.contact, SearchContact)

    @eqx.filter_jit
    def both(pair, *states):
        def at(state):
            searched = pair.margins(*state)
            near = _near(pair, searched.places.normal2).margins(*state)
            return searched.counts, searched.values > 0, near.values > 0

        return jax.lax.map(at, states)

    jumps = set(kinds(pair).jump) - {-1}
    assert len(jumps) == (pair.flanks if pair.contact.jumps else 0)
    counts, searched, near = map(np.array, both(pair, *_states(pair, 60)))
    # The margin of a jump needs the other root, which is known at the event alone.
    counts[:, list(jumps)] = False
    assert counts.sum() > 100
    np.testing.assert_array_equal(searched[counts], near[counts])


@pytest.mark.parametrize(
    "name", ["cic_drawn", *(pytest.param(n, marks=pytest.mark.long) for n in ("ee", "pump"))]
)
def test_equation_near_a_root_is_that_of_the_search(name):
    """From a root 1e-3 away, two evaluations reach the search's forces and derivatives."""
    pair = _pair(name)

    def searched(pair, tau, state):
        return pair.derivative(tau, state)[0]

    def near(pair, tau, state):
        moved = _near(pair, pair.margins(tau, state).places.normal2 + 1e-3)
        own, _ = moved.margins(tau, state).places
        return _near(pair, own.normal2).derivative(tau, state)[0]

    @eqx.filter_jit
    def each(found, pair, *states):
        return jax.lax.map(lambda at: (found(pair, *at), jax.jacfwd(found, 2)(pair, *at)), states)

    found = (each(function, pair, *_states(pair, 25)) for function in (searched, near))
    for one, other in zip(*found, strict=True):
        size = np.max(np.abs(one), axis=tuple(range(1, one.ndim)), keepdims=True)
        np.testing.assert_allclose(other / size, one / size, rtol=0, atol=2e-6)


def test_root_at_the_end_of_a_segment_has_one_slope():
    """There, automatic differentiation mixes the slopes of both segments to one of wrong sign."""
    flanks = paired(CIC(3, 0.033, np.radians(34.85), 3.956e-3, np.radians(3.29)))
    relative = jnp.asarray(-1.135e-3)
    end = flanks.profile.segments()[1].stop
    offset = eqx.filter_jit(lambda *at: flanks._mesh(*at)[0])
    roll = brentq(lambda x: float(offset(end, jnp.asarray(x), relative)), 0.2, 0.4, xtol=1e-15)
    at = eqx.filter_jit(
        lambda roots: NearContact(flanks, roots).approach(jnp.asarray(roll), relative)
    )
    beside, there = (at(jnp.full((1, 2), end + aside)) for aside in (-1e-9, 0.0))
    assert bool(there.place[0].found)
    np.testing.assert_allclose(there.gap, beside.gap, rtol=0, atol=1e-15)
    np.testing.assert_allclose(there.lever1, beside.lever1, rtol=1e-9)


@pytest.mark.parametrize(
    ("profile", "kinks"),
    [(arc(3, 0.033, 0.0297), 1), (CIC(3, 0.033, np.radians(36), 6e-3, np.radians(3)), 0)],
    ids=["arc", "involute"],
)
def test_lever_bends_where_a_margin_changes_its_sign(profile, kinks):
    """The curvature of an arc jumps at the pitch crossing, that of an involute does not.

    A search shows the kink as a jump of the lever's slope."""
    flanks = paired(profile)
    relative = jnp.asarray(-1e-3)
    # Rotor 2 touches at its crossing where half of the mesh has passed, less about ε.
    rolls = flanks.profile.half_pitch + 4e-3 * jnp.linspace(-1, -1e-3, 4001)

    @jax.jit
    def look(roll):
        found = flanks(roll, relative)
        return found.lever2, flanks.margins(roll, found)

    levers, margins = (np.asarray(x) for x in jax.lax.map(look, rolls))
    bends = np.abs(np.diff(levers, 2))
    bends = np.flatnonzero(bends > 1e3 * np.median(bends))
    changes = np.flatnonzero(np.any(np.diff(np.sign(margins), axis=0) != 0, axis=1))
    assert len(changes) == kinks
    assert np.all(np.isin(bends, [changes - 1, changes]))
    assert np.all(np.isin(changes, [bends - 1, bends, bends + 1]))


def test_margin_of_a_jump_is_zero_where_both_minima_are_equally_deep():
    """The contact of four arcs jumps over their joint. A search finds the same roll angle."""
    flanks = paired(four_arcs(3, 0.033, 0.023964, 0.020659, np.radians(34.22)))
    assert flanks.jumps
    relative = jnp.asarray(-1e-3)
    search = jax.jit(lambda roll: flanks(roll, relative).normal2)
    joint = float(flanks.profile.roll_angle(flanks.profile.segments()[0].stop))
    rolls = joint + np.linspace(-0.02, 0.02, 2001)
    normals = np.asarray(jax.lax.map(search, jnp.asarray(rolls)))
    (place,) = np.flatnonzero(np.abs(np.diff(normals)) > 0.05)
    before, after = normals[place : place + 2]

    @jax.jit
    def margin(roll):
        contact = NearContact(flanks, jnp.asarray([[before, after]]))
        return contact.margins(roll, contact.approach(roll, relative))[2]

    def zero(function):
        return brentq(lambda x: float(function(jnp.asarray(x))), *rolls[place:][:2], xtol=1e-14)

    jump = zero(lambda roll: search(roll) - (before + after) / 2)
    assert zero(margin) == pytest.approx(jump, abs=1e-9)
