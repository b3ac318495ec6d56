"""Checks that every part of a scene must pass (`rootsopt.dynamics.parts.Part`)."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rootsopt.dynamics.parts import Loads, Motion, Units
from tests.conformance.kinks import along, unmarked

UNITS = Units(jnp.asarray(1.5e-3), jnp.asarray(6.7e-3))
SPEED = 314.0
"""Speed (rad/s) about which rotor 1 turns."""


def nothing(part, motion, own):
    return jnp.zeros(())


def draw(part, rng, reach, axes):
    """Return a random motion and own states, `reach` times the units of each, and other loads."""
    angle, rate = float(UNITS.angle), float(UNITS.angle / UNITS.time)
    own = jnp.zeros(0)
    if part.states:
        own = np.asarray(part.scales(UNITS)) * reach * rng.normal(size=len(part.states))
        start = part.start(UNITS)
        own = jnp.asarray(own if start is None else own + np.asarray(start))
    turns, apart, rate_apart, faster = rng.uniform(0, 2), *(reach * rng.normal(size=3))
    motion = Motion(
        *map(jnp.asarray, (turns, angle * apart, rate * rate_apart, SPEED + rate * faster))
    )
    if part.displaces or axes:
        shift, drift = 1e-5 * rng.normal(size=(2, 2, 2)) * np.array([1, 100]).reshape(2, 1, 1)
        if part.displaces:
            shift, drift = part.axes(own)
        motion = motion._replace(shift=jnp.asarray(shift), drift=jnp.asarray(drift))
    forces = None if motion.shift is None else jnp.asarray(100 * rng.normal(size=(2, 2)))
    torques = 5 * rng.normal(size=2)
    return motion, own, Loads(jnp.asarray(torques[0]), jnp.asarray(torques[1]), forces)


def check_part(part, energy=nothing, supply=nothing, losses=nothing, reach=2.0, axes=False):
    """Check a part by itself.

    `energy(part, motion, own)`: stored energy (J); `supply`, `losses`: power (W) taken in from
    outside, and dissipated, with the same arguments; `reach`: size of the states, in their units,
    within which the kinks of the part lie; `axes`: whether the part acts on moving axes."""
    rng = np.random.default_rng(11)
    check_states(part)
    cases = [draw(part, rng, reach, axes) for _ in range(20)]
    _check_power(part, cases, energy, supply, losses)
    _check_kinks(part, rng, reach, axes)
    if part.rubs:
        _check_drag(part)
    if part.play is not None:
        edges = np.sort(part.edges)
        assert np.isclose(np.ptp(edges), 2 * float(part.play), rtol=1e-9)
        motion, own, _ = draw(part, rng, 0.0, axes)
        for place in np.linspace(edges[0], edges[-1], 5):
            held = part.torque_on_2(motion._replace(relative=jnp.asarray(place)), own)
            assert abs(float(held)) < 1e-9, "torque inside its play"
    quickest = part.quickest(jnp.asarray(2e-3))
    assert quickest is None or float(quickest) > 0


def check_states(part):
    """Check that names, sizes and starts of the own states match, and that all numbers are
    arrays."""
    count = len(part.states)
    assert len(set(part.states)) == count
    if count:
        scales = np.asarray(part.scales(UNITS))
        assert scales.shape == (count,)
        assert np.all(np.isfinite(scales) & (scales > 0))
        start = part.start(UNITS)
        assert start is None or (start.shape == (count,) and np.all(np.isfinite(start)))
    leaves = jax.tree.leaves(part)
    assert all(eqx.is_inexact_array(leaf) for leaf in leaves), "a number that is no array"


def _check_power(part, cases, energy, supply, losses):
    """Check that the power taken in, minus the power to the rotors, is stored or dissipated."""

    @jax.jit
    def powers(motion, own, loads):
        works = [
            (part.torque_on_1(motion, own), motion.speed),
            (part.torque_on_2(motion, own), motion.speed + motion.rate),
        ]
        if motion.shift is not None:
            works.append((part.force_on_axes(motion, own), motion.drift))
        given = sum((jnp.sum(x * v) for x, v in works if x is not None), jnp.zeros(()))
        still = jax.tree.map(jnp.zeros_like, motion)
        moving = still._replace(phi=motion.speed, relative=motion.rate, shift=motion.drift)
        change = part.rates(motion, own, loads) if part.states else jnp.zeros(0)
        _, stored = jax.jvp(lambda m, o: energy(part, m, o), (motion, own), (moving, change))
        return supply(part, motion, own), given, stored, losses(part, motion, own)

    for case in cases:
        taken, given, stored, lost = (float(x) for x in powers(*case))
        scale = abs(taken) + abs(given) + abs(stored) + 1e-12
        assert lost >= 0
        assert abs(taken - given - stored - lost) < 1e-9 * scale, (
            f"power does not balance: {taken:g} W taken in, {given:g} W given to the rotors, "
            f"{stored:g} W stored, {lost:g} W lost; count absolute speeds in `energy`"
        )


def _check_kinks(part, rng, reach, axes):
    lines = [[draw(part, rng, 2 * reach, axes) for _ in range(2)] for _ in range(6)]

    def function(point):
        """Return everything the part does as one vector, and its flags."""
        motion, own, loads = point
        found = [jnp.zeros(1), part.torque_on_1(motion, own), part.torque_on_2(motion, own)]
        if motion.shift is not None:
            found.append(part.force_on_axes(motion, own))
        if part.states:
            found.append(part.rates(motion, own, loads))
        actions = jnp.concatenate([jnp.ravel(x) for x in found if x is not None])
        return actions, part.switches(motion, own)

    for values, slopes, flags in along(function, lines):
        missed = unmarked(values, slopes, flags)
        assert missed.size == 0, f"kinks that no switch marks: {missed}"


def _check_drag(part):
    speeds = np.random.default_rng(2).normal(size=50) * np.geomspace(1e-3, 10, 50)
    normal = jnp.asarray(100.0)
    drag = jax.jit(jax.vmap(lambda v: part.drag(normal, v)))(jnp.asarray(speeds))
    assert np.all(np.asarray(drag) * speeds >= 0)
    lines = [(-far, far) for far in (0.01, 0.3, 10.0)]
    found = along(lambda v: (part.drag(normal, v)[None], part.drag_switches(v)), lines)
    for values, slopes, flags in found:
        assert unmarked(values, slopes, flags).size == 0, "kinks that no switch marks"


def equations(jaxpr):
    """Return the number of equations of a traced program, including those of inner programs."""
    total = len(jaxpr.eqns)
    for equation in jaxpr.eqns:
        for value in jax.tree.leaves(equation.params, is_leaf=lambda v: hasattr(v, "jaxpr")):
            inner = getattr(value, "jaxpr", value)
            total += equations(inner) if hasattr(inner, "eqns") else 0
    return total


def size(pair):
    """Return the number of states, equations and numbers of a pair's right-hand side.

    The pair may have shapes in place of arrays."""
    numbers, static = eqx.partition(pair, lambda x: hasattr(x, "shape"))
    program = jax.make_jaxpr(lambda tau, y, n: eqx.combine(n, static).derivative(tau, y)[0])(
        jnp.zeros(()), jnp.zeros(pair.states), numbers
    )
    return pair.states, equations(program.jaxpr), len(program.jaxpr.invars)


def check_in_pair(pair, part, reach=2.0):
    """Check a part in a `pair` without it.

    The part must add its own states and numbers. The motion must have a derivative with respect to
    each of these numbers."""
    with_part = dataclasses.replace(pair, parts=(*pair.parts, part))
    before, after = size(pair), size(with_part)
    assert after[0] == before[0] + len(part.states) + (part.free and not pair.free)
    assert after[1] > before[1]
    assert after[2] == before[2] + len(jax.tree.leaves(part))
    assert len(with_part.state_names) == with_part.states
    states = reach * np.random.default_rng(4).normal(size=(12, with_part.states))

    @jax.jit
    @jax.jacfwd
    def slopes(part):
        held = dataclasses.replace(pair, parts=(*pair.parts, part))
        return jax.lax.map(lambda y: held.derivative(jnp.asarray(0.3), y)[0], jnp.asarray(states))

    for leaf in jax.tree.leaves(slopes(part)):
        assert np.all(np.isfinite(leaf))
        assert np.any(np.asarray(leaf) != 0), "a number that nothing depends on"
