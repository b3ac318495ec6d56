"""Tests of integrations: their steps and methods, what they compile, and what a batch shares."""

import os
import subprocess
import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from rootsopt.config import load
from rootsopt.dynamics.flow import integrated, interpolated, one_period
from rootsopt.dynamics.integrator import METHODS, Integrator
from rootsopt.dynamics.orbit import branch
from rootsopt.scene import Scene, design_vector


def swing(tau, y, gravity):
    """Return the slope of a pendulum's state `y` (2,), which is known up to 1 rad.

    `gravity`: square of the angular frequency of small oscillations."""
    return jnp.stack([y[1], -gravity * jnp.sin(jnp.where(jnp.abs(y[0]) < 1, y[0], jnp.nan))])


def both(method, gravity, max_steps):
    """Return the integration by this loop, its states at the ends of diffrax's steps, and that by
    diffrax."""
    solver = Integrator(method, jnp.asarray(1e-6), max_steps).solver()
    term, control = diffrax.ODETerm(swing), diffrax.PIDController(1e-6, 1e-6, dtmax=1 / 32)

    @jax.jit
    def run(start, gravity):
        ours = integrated(term, solver, control, start, gravity, max_steps, recorded=True)
        theirs = diffrax.diffeqsolve(
            term,
            solver,
            t0=0.0,
            t1=1.0,
            dt0=None,
            y0=start,
            args=gravity,
            saveat=diffrax.SaveAt(t1=True, steps=True, dense=True),
            stepsize_controller=control,
            adjoint=diffrax.ForwardMode(),
            max_steps=max_steps,
            throw=False,
        )
        inside = jax.vmap(lambda share: interpolated(ours, solver, share)[0])
        shown = theirs.ts, theirs.ys, theirs.stats, theirs.result == diffrax.RESULTS.successful
        return ours, inside(jnp.minimum(theirs.ts, 1.0)), shown

    # Angle (rad) and speed (rad per unit of time) at the start.
    return run(jnp.array((0.3, -1.2)), jnp.asarray(gravity))


@pytest.mark.parametrize(
    ("method", "gravity"),
    [("tsit5", 4000.0), ("dopri8", 4000.0), ("tsit5", 1e5)],
    ids=["order 5", "order 8", "first step leaves the domain"],
)
def test_steps_are_those_of_diffrax(method, gravity):
    ours, inside, (ends, after, stats, solved) = both(method, gravity, max_steps=2048)
    count = int(ours.accepted)
    assert solved
    assert ours.solved
    assert (int(stats["num_steps"]), int(stats["num_accepted_steps"])) == (ours.steps, count)
    assert count > 30
    np.testing.assert_allclose(ours.records.ends[:count], ends[:count], rtol=1e-12)
    np.testing.assert_allclose(inside[:count], after[:count], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours.end, inside[count - 1], rtol=1e-12)
    assert ours.records.ends[count - 1] == 1
    assert np.all(np.isinf(ours.records.ends[count:]))


@pytest.mark.parametrize(
    ("gravity", "max_steps"), [(4000.0, 20), (np.nan, 2048)], ids=["too few steps", "not a number"]
)
def test_an_integration_that_does_not_reach_the_end_says_so(gravity, max_steps):
    ours, _, (_, _, stats, solved) = both("tsit5", gravity, max_steps)
    assert not solved
    assert not ours.solved
    assert int(ours.steps) == int(stats["num_steps"])


def test_solvers_agree():
    """All methods give the same mean, peak and RMS force on the CIC orbit."""
    config = load("configs/cic_drawn.yaml")
    found = []
    pair = eqx.filter_jit(Scene.pair)(Scene.from_config(config), design_vector(config))
    period = eqx.filter_jit(one_period)
    for method, rtol in (("tsit5", 1e-11), *((method, 1e-8) for method in METHODS)):
        how, state = Integrator(method, jnp.asarray(rtol), 20000), jnp.zeros(2)
        # The orbit's multiplier is 0.004: six periods leave 1e-14 of the start.
        for _ in range(7):
            out = period(pair, state, how)
            assert bool(out.solved)
            state = out.end
        mean, square, peak = out.response
        found.append([mean, peak, np.sqrt(square)])
    np.testing.assert_allclose(found[1:], [found[0]] * len(METHODS), rtol=1e-5)


_COUNT = """
import jax, jax.numpy as jnp, rootsopt
from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import Integrator

jax.config.update("jax_enable_x64", True)
config = rootsopt.load_config("configs/ee.yaml")
pair = rootsopt.Scene.from_config(config).pair(config.design)
how = Integrator("tsit5", jnp.asarray(1e-8), 1024)
state = jnp.zeros(2)
programs = (
    lambda state: strobe(pair, state, 4, how),
    lambda state: one_period(pair, state, how),
)
print([str(jax.make_jaxpr(program)(state)).count("callback") for program in programs])
"""


def test_no_callback_to_python_in_an_integration():
    """An integration has no callback to Python, because programs with callbacks cannot be cached.

    Equinox's checks of the arguments of diffrax would be such callbacks. A command turns them off,
    but a caller from Python does not."""
    variables = {name: x for name, x in os.environ.items() if name != "EQX_ON_ERROR"}
    command = [sys.executable, "-c", _COUNT]
    done = subprocess.run(command, env=variables, check=True, capture_output=True, text=True)
    assert done.stdout == "[0, 0]\n"


@pytest.mark.parametrize("taken", [[True] * 3, [False] * 3, [True, False, True]])
def test_branches_of_a_batch_on_a_gpu(monkeypatch, taken):
    """A batch computes only the branches that one of its motions takes."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    made = set()

    def told(name, value):
        jax.debug.callback(lambda: made.add(name))
        return value

    def one(taken, x):
        return branch(taken, lambda: told("then", 2 * x), lambda: told("otherwise", -x))

    values = jnp.arange(1.0, 4.0)
    found = jax.jit(jax.vmap(one))(jnp.asarray(taken), values)
    jax.effects_barrier()
    np.testing.assert_array_equal(found, jnp.where(jnp.asarray(taken), 2 * values, -values))
    assert made == {"then" if now else "otherwise" for now in taken}
    # A condition that is the same for the whole batch, and a branch without batched values.
    shared = jax.jit(jax.vmap(one, (None, 0)))(taken[1], values)
    np.testing.assert_array_equal(shared, 2 * values if taken[1] else -values)
    fixed = jax.vmap(lambda now: branch(now, lambda: jnp.ones(2), lambda: jnp.zeros(2)))
    np.testing.assert_array_equal(fixed(jnp.asarray(taken))[:, 0], taken)


def test_loops_of_a_branch_end_with_the_motions_that_take_it(monkeypatch):
    """In a batch on a GPU, a motion that does not take a branch does not prolong its loops."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    turns = []
    count = jnp.zeros((), int)

    def counted(k):
        jax.debug.callback(lambda: turns.append(1))
        return k + 1

    def one(limit):
        def loop():
            return lax.while_loop(lambda k: k < limit, counted, count)

        return branch(limit < 10, loop, lambda: count)

    found = jax.jit(jax.vmap(one))(jnp.asarray([3, 500, 5]))
    jax.effects_barrier()
    np.testing.assert_array_equal(found, [3, 0, 5])
    assert len(turns) <= 3 * 5
