"""Integration over the unit interval takes the steps that `diffrax.diffeqsolve` takes."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.dynamics.flow import integrated, interpolated
from rootsopt.dynamics.integrator import Integrator

START = (0.3, -1.2)
"""Angle (rad) and speed (rad per unit of time) of the pendulum at the start."""


def swing(tau, y, gravity):
    """Return the slope of a pendulum's state `y` (2,), which is known up to 1 rad.

    `gravity`: square of the angular frequency of small oscillations."""
    known = jnp.where(jnp.abs(y[0]) < 1, y[0], jnp.nan)
    return jnp.stack([y[1], -gravity * jnp.sin(known)])


def both(method, gravity=4000.0, max_steps=512):
    """Return the integration by this loop and by diffrax."""
    integrator = Integrator(method, jnp.asarray(1e-6), max_steps)
    solver, control = integrator.solver(), diffrax.PIDController(1e-6, 1e-6, dtmax=1 / 32)
    term = diffrax.ODETerm(swing)

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
        return (
            ours,
            inside(jnp.minimum(theirs.ts, 1.0)),
            (
                theirs.ts,
                theirs.ys,
                theirs.stats,
                theirs.result == diffrax.RESULTS.successful,
            ),
        )

    return run(jnp.array(START), jnp.asarray(gravity))


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
    ("gravity", "max_steps"), [(4000.0, 20), (np.nan, 512)], ids=["too few steps", "not a number"]
)
def test_an_integration_that_does_not_reach_the_end_says_so(gravity, max_steps):
    ours, _, (_, _, stats, solved) = both("tsit5", gravity, max_steps)
    assert not solved
    assert not ours.solved
    assert int(ours.steps) == int(stats["num_steps"])
