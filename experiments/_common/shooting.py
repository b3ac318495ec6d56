"""Closes an orbit by shooting, to check the package, which closes orbits by collocation.

The two share the equation of motion alone. diffrax integrates it at a tolerance of 1e-14 without
knowing its events; the monodromy matrix and all derivatives are differences. It takes a hundred
times as long."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from rootsopt.dynamics.pair import RotorPair

# Tolerance and longest step (mesh periods) of the integration. The tolerance is close to rounding:
# at 1e-12, corners of the force inside steps left errors of 1e-10 in the states, which differences
# of forces show enlarged.
_TOLERANCE, _LONGEST = 1e-14, 1 / 256

# Maximum number of steps of an integration.
_STEPS = 2**16

# Distance between start and end (scaled) of a closed orbit, and maximum number of Newton steps.
_CLOSED, _NEWTON = 1e-11, 8

# Distance above which an orbit does not count as closed in differences of forces.
_NEAR = 1e-9

# Change of a state (scaled) for the central differences that give the monodromy matrix, and
# factor on the distance between start and end in one Newton step above which it is computed
# again.
_AWAY, _SLOW = 1e-5, 0.01
_GOLDEN = (5**0.5 - 1) / 2

# Number of sections of the interval in which the peak lies.
_CUTS = 40


class Shot(NamedTuple):
    """An orbit: scaled `state` at φ1 = 0; mean, peak and RMS force (N); distance between start and
    end (scaled); monodromy matrix (n, n) near the state."""

    state: NDArray[np.float64]
    forces: NDArray[np.float64]
    miss: float
    monodromy: NDArray[np.float64]

    @property
    def multiplier(self) -> float:
        """Greatest modulus of the Floquet multipliers."""
        return float(np.max(np.abs(np.linalg.eigvals(self.monodromy))))


def closed(pair: RotorPair, state: Any, period: int, monodromy: Any = None) -> Shot:
    """Close the orbit of `period` mesh periods near the scaled `state` (n,).

    `monodromy`: that of an orbit nearby, which saves computing it while Newton steps with it
    converge."""
    state = np.asarray(state, float)

    def fly(start: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        end, forces = _flown(pair, jnp.asarray(start), jnp.asarray(float(period)))
        return np.asarray(end), np.asarray(forces)

    unit = np.eye(len(state))
    end, forces = fly(state)
    before, fresh = np.inf, False
    for _ in range(_NEWTON):
        miss = np.max(np.abs(end - state))
        slow = miss > max(_SLOW * before, _CLOSED)
        # Integrations are that exact: the corners of the force do not lie at ends of steps.
        if slow and fresh and miss < _NEAR:
            break
        if monodromy is None or slow:
            fresh = True
            sides = [[fly(state + sign * _AWAY * way)[0] for sign in (1, -1)] for way in unit]
            ahead, behind = np.moveaxis(np.array(sides), 1, 0)
            monodromy = (ahead - behind).T / (2 * _AWAY)
        state, before = state + np.linalg.solve(unit - monodromy, end - state), miss
        end, forces = fly(state)
        # One step follows the first orbit that closes: else the differences between orbits would
        # show how far each of them stopped from its end.
        if miss < _CLOSED:
            break
    return Shot(state, forces, float(np.max(np.abs(end - state))), np.asarray(monodromy))


def forces_near(
    pair_of: Callable[[float], RotorPair], orbit: Shot, period: int
) -> Callable[[float], NDArray[np.float64]]:
    """Return the function change → forces (3,) in N of the orbit of `pair_of` that change.

    `orbit`: that without change. Forces are NaN where no orbit closes. The function predicts each
    orbit from the one before, so it is cheap where changes become smaller, as in
    `differentiated`."""
    slope = np.zeros_like(orbit.state)

    def forces(change: float) -> NDArray[np.float64]:
        nonlocal slope
        found = closed(pair_of(change), orbit.state + change * slope, period, orbit.monodromy)
        near = found.miss < _NEAR
        slope = (found.state - orbit.state) / change if near else slope
        return found.forces if near else np.full_like(found.forces, np.nan)

    return forces


def differentiated(
    forces: Callable[[float], NDArray[np.float64]], step: float, levels: int = 3
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the derivatives of `forces` at 0, and their estimated errors.

    Central differences with `step`, half of it and so on, at `levels` steps (at least 3), are
    extrapolated in pairs to step 0. Each component takes the result that agrees best with both of
    its neighbours (C. J. F. Ridders, Adv. Eng. Softw. 4 (1982) 75-76): steps that are too long and
    those whose differences are rounding are left out."""
    steps = step * 0.5 ** np.arange(levels)
    slopes = np.array([(forces(h) - forces(-h)) / (2 * h) for h in steps])
    limits = (4 * slopes[1:] - slopes[:-1]) / 3
    errors = np.abs(np.diff(limits, axis=0))
    errors = np.where(np.isfinite(errors), errors, np.inf)
    errors = np.maximum(errors[1:], errors[:-1]) if levels > 3 else errors
    best = np.argmin(errors, axis=0)[None]
    value, error = (np.take_along_axis(x, best, axis=0)[0] for x in (limits[1:], errors))
    return np.where(np.isfinite(error), value, np.nan), error


@eqx.filter_jit
def _flown(pair: RotorPair, start: Any, period: Any) -> tuple[Any, Any]:
    """Return the state at the end of `period` mesh periods; mean, peak and RMS force (N)."""
    count, unit = start.shape[0], pair.force_scale

    def force(tau: Any, y: Any, _: Any) -> Any:
        return pair.contact_at(tau, y[:count]).total / unit

    def rates(tau: Any, y: Any, _: Any) -> Any:
        slope, contact = pair.derivative(tau, y[:count])
        size = contact.total / unit
        lapse = pair.lapse(y[:count]) * jnp.ones_like(size)
        return jnp.append(slope, lapse * jnp.stack([size, size**2, jnp.ones_like(size)]))

    term, solver = diffrax.ODETerm(rates), diffrax.Dopri8()
    begin, here = jnp.zeros(()), jnp.append(start, jnp.zeros(3))
    saved = diffrax.SubSaveAt(t0=True, steps=True), diffrax.SubSaveAt(t0=True, steps=True, fn=force)
    out = diffrax.diffeqsolve(
        term,
        solver,
        begin,
        period,
        1e-5,
        here,
        saveat=diffrax.SaveAt(subs=[*saved, diffrax.SubSaveAt(t1=True)]),
        stepsize_controller=diffrax.PIDController(_TOLERANCE, _TOLERANCE, dtmax=_LONGEST),
        max_steps=_STEPS,
        throw=False,
    )
    assert out.ts is not None
    assert out.ys is not None
    times, states, sizes, end = out.ts[0], out.ys[0], out.ys[1], out.ys[2][0]
    # The peak lies between the steps beside the greatest force at the end of a step.
    top = jnp.argmax(jnp.where(jnp.isfinite(times), sizes, -jnp.inf))
    first = jnp.maximum(top - 1, 0)
    after = times[jnp.minimum(top + 1, times.shape[0] - 1)]
    last = jnp.where(jnp.isfinite(after), after, period)

    def height(tau: Any) -> Any:
        memory = solver.init(term, times[first], tau, states[first], None)
        y = solver.step(term, times[first], tau, states[first], None, memory, made_jump=False)[0]
        return force(tau, y, None)

    def cut(_: Any, ends: Any) -> Any:
        low, high = ends
        one, other = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        lower, upper = lax.map(height, jnp.stack([one, other]))
        return jnp.where(lower > upper, low, one), jnp.where(lower > upper, other, high)

    low, high = lax.fori_loop(0, _CUTS, cut, (times[first], last))
    peak = jnp.maximum(height((low + high) / 2), jnp.max(jnp.nan_to_num(sizes, posinf=0.0)))
    mean, square = end[count : count + 2] / end[-1]
    solved = out.result == diffrax.RESULTS.successful
    return end[:count], jnp.where(solved, unit * jnp.stack([mean, peak, jnp.sqrt(square)]), jnp.nan)
