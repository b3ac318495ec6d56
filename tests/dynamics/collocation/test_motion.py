"""Tests of orbits closed by collocation against orbits closed by shooting, which shares no code."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rootsopt
from rootsopt.contact.law import ContactLaw
from rootsopt.dynamics import closed
from rootsopt.dynamics.collocation.closing import supported
from rootsopt.dynamics.parts.base import Part
from rootsopt.dynamics.settle import settle
from rootsopt.scene import Scene
from rootsopt.status import Status

LIVELY = [
    "scene.speed_rpm=1700",
    "scene.load.torque_N_m=3",
    "scene.timing_gear.backlash_mm=0.25",
    "scene.timing_gear.damping_ratio=0.3",
    "scene.timing_gear.stiffness_N_m_per_rad=9000",
    "profile.pressure_angle_deg=30.7",
    "profile.involute_length_mm=4",
    "profile.tip_arc_angle_deg=1.5",
]
STIFF = [
    "scene.speed_rpm=657.2",
    "scene.load.torque_N_m=2.069",
    "scene.timing_gear={stiffness_N_m_per_rad: 42986, damping_ratio: 0.276, backlash_mm: 0.104}",
]
FOUR = [
    "profile={family: cic, lobes: 4, pitch_radius_mm: 33.0, pressure_angle_deg: 33, "
    "involute_length_mm: 6, tip_arc_angle_deg: 2}"
]


def _both(name, overrides):
    """Return forces, logarithmic derivatives and response of each method."""
    config = rootsopt.load_config(f"configs/{name}.yaml", overrides)
    scene = Scene.from_config(config)
    found = {}
    for method in ("collocation", "shooting"):
        solver = dataclasses.replace(scene.solver, closing=method)
        own = dataclasses.replace(scene, solver=solver)

        def forces(start, own=own):
            design, speed, load = start
            moved = dataclasses.replace(own, speed=speed, load_torque=load)
            response = rootsopt.steady_response(moved, design)
            return jnp.stack([response.mean, response.peak, response.rms]), response

        start = jnp.asarray(config.design, float), scene.speed, scene.load_torque
        slopes, response = jax.jacfwd(forces, has_aux=True)(start)
        slopes = [
            np.asarray(slope).reshape(3, jnp.size(at)) * np.ravel(at)
            for slope, at in zip(slopes, start, strict=True)
        ]
        found[method] = np.concatenate(slopes, axis=1), response
    return found["collocation"], found["shooting"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "overrides", "period"),
    [
        ("cic", [], 1),
        ("ee", [], 1),
        ("ee", STIFF, 1),
        ("cic", FOUR, 1),
        ("cic", LIVELY, 2),
        ("pump", [], 1),
    ],
    ids=["cic", "ee", "ee, steps down to rounding", "four lobes", "lively", "pump"],
)
def test_collocation_agrees_with_shooting(name, overrides, period):
    (by_one, one), (by_other, other) = _both(name, overrides)
    assert Status.of(int(one.status)) is Status.PERIODIC
    assert int(one.period) == int(other.period) == period
    for force in ("mean", "peak", "rms"):
        np.testing.assert_allclose(getattr(one, force), getattr(other, force), rtol=5e-7)
    size = np.max(np.abs(by_other), axis=1, keepdims=True)
    np.testing.assert_allclose(by_one / size, by_other / size, rtol=0, atol=1e-4)
    first, second = (np.sort(np.abs(response.multipliers)) for response in (one, other))
    np.testing.assert_allclose(first, second, atol=1e-5)
    np.testing.assert_allclose(one.state, other.state, rtol=1e-5, atol=1e-9)


@pytest.mark.long
def test_orbit_closed_over_too_many_periods_is_closed_again(monkeypatch):
    """Where the transient takes twice the period for the period, the result has the true one."""
    taken = []

    def twice(*args):
        found = settle(*args)
        taken.append(1)
        return found._replace(period=2 * found.period)

    config = rootsopt.load_config("configs/cic.yaml")
    scene = Scene.from_config(config)
    solver = dataclasses.replace(scene.solver, closing="collocation")
    pair, tangents, _ = scene.pair_and_tangents(jnp.asarray(config.design, float))
    monkeypatch.setattr(closed, "settle", twice)
    start = closed.Start.at(pair, pair.in_si(jnp.zeros(pair.states)), solver.max_orbit)
    found = eqx.filter_jit(closed.closed_motion)(pair, tangents, start, scene.pitch_radius, solver)
    assert taken
    assert Status.of(int(found.status)) is Status.PERIODIC
    assert int(found.period) == 1
    alone = rootsopt.evaluate(config)
    np.testing.assert_allclose(found.forces[0], alone.response["mean_force_N"], rtol=1e-6)


def test_program_has_the_shapes_of_shooting():
    """The results of both methods have the same structure, because `auto` has both in one
    program."""
    config = rootsopt.load_config("configs/cic.yaml", ["solver.orbit=auto"])
    scene = Scene.from_config(config)
    design = jnp.asarray(config.design, float)
    found = eqx.filter_eval_shape(rootsopt.steady_response, scene, design)
    assert found.multipliers.shape == (2,)


class _Flagged(Part):
    """A part with a flag but no margin."""

    def switches(self, motion, own):
        del own
        return (motion.relative > 0)[None]


class _Law(ContactLaw):
    """A law whose only flag is that of the base class."""

    exponent: jax.Array

    def __call__(self, depth, rate):
        del rate
        return 1e7 * jnp.maximum(depth, 0.0)

    def depth_at(self, force):
        return force / 1e7


def test_flags_without_margins_are_left_to_shooting():
    config = rootsopt.load_config("configs/cic.yaml")
    scene = Scene.from_config(config)
    make = eqx.filter_jit(lambda s, d: s.pair(d))
    design = jnp.asarray(config.design, float)
    assert supported(make(scene, design))
    assert supported(make(scene.with_law(_Law(jnp.ones(()))), design))
    assert not supported(make(scene.with_parts(_Flagged()), design))
