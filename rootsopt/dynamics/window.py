"""A window of a motion that has not settled: its forces, and its largest Lyapunov exponent.

The exponent distinguishes chaos from a long transient. It is the mean logarithmic growth rate of a
tangent vector that is renormalised every mesh period (Benettin et al., Meccanica 15 (1980) 9-20).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.flow import Flow, flow
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.pair import RotorPair

PERIODS = 128
"""Length of a window (mesh periods)."""
_BATCHES = 16
"""Number of batches into which a window is divided to estimate the standard error of the Lyapunov
exponent."""
_KEPT = 105
"""Number of states stored per mesh period."""
_SAMPLES = 630
"""Number of uniform samples per mesh period for locating the peak force; a multiple of `_KEPT`."""

_Arrays = Array | np.ndarray
"""Array type of a window: JAX arrays, or NumPy arrays after a copy from the device."""


class Window(NamedTuple):
    """A motion over p mesh periods, of which the first `done` have been integrated.

    `growth` (p,): logarithm of the tangent vector's growth factor in each mesh period; `response`
    (p, 3): mean (N), mean square (N²) and peak (N) of the contact force in each mesh period;
    `states` (p, s, n): uniform samples, scaled; `depth`: greatest penetration (m; negative: least
    gap); `solved`: whether the solver succeeded; `end` (n,): last scaled state; `direction` (n,):
    unit tangent vector at `end`.
    """

    growth: Float[Array, " p"]
    response: Float[Array, "p 3"]
    states: Float[Array, "p s n"]
    depth: Float[Array, ""]
    solved: Bool[Array, ""]
    end: Float[Array, " n"]
    direction: Float[Array, " n"]
    done: Int[Array, ""]

    @classmethod
    def empty(cls, state: Float[Array, " n"], periods: int) -> "Window":
        """Return a window of `periods` mesh periods from the scaled `state` (n,), before any
        integration."""
        count, dtype = state.shape[0], state.dtype
        return cls(
            growth=jnp.zeros(periods, dtype),
            response=jnp.zeros((periods, 3), dtype),
            states=jnp.zeros((periods, _KEPT, count), dtype),
            depth=jnp.full((), -jnp.inf, dtype),
            solved=jnp.ones((), bool),
            end=state,
            direction=jnp.zeros_like(state).at[0].set(1.0),
            done=jnp.zeros((), int),
        )

    def after(self, out: Flow) -> "Window":
        """Return the window extended by one mesh period; `out`: its flow."""
        count = self.end.shape[0]
        moved = out.slope[:count, :count] @ self.direction
        size = jnp.linalg.norm(moved)
        safe = jnp.where(size > 0, size, 1.0)
        every = out.states.shape[0] // _KEPT
        return Window(
            growth=self.growth.at[self.done].set(jnp.log(safe)),
            response=self.response.at[self.done].set(out.response[:3]),
            states=self.states.at[self.done].set(out.states[::every][:_KEPT]),
            depth=jnp.maximum(self.depth, out.depth),
            solved=self.solved & out.solved,
            end=out.end,
            direction=moved / safe,
            done=self.done + 1,
        )

    @property
    def exponent(self) -> Float[_Arrays, ""]:
        """Largest Lyapunov exponent per mesh period."""
        xp = _numpy_of(self.growth)
        return xp.asarray(xp.mean(self.growth))

    @property
    def error(self) -> Float[_Arrays, ""]:
        """Standard error of `exponent`, from the means of `_BATCHES` batches."""
        xp = _numpy_of(self.growth)
        batches = xp.mean(self.growth.reshape(_BATCHES, -1), axis=1)
        return xp.asarray(xp.std(batches, ddof=1) / _BATCHES**0.5)

    @property
    def forces(self) -> Float[_Arrays, " 3"]:
        """Mean (N), mean square (N²) and peak (N) of the contact force over the window."""
        xp = _numpy_of(self.response)
        mean, square, peak = self.response.T
        return xp.stack([xp.mean(mean), xp.mean(square), xp.max(peak)])


def _numpy_of(array: Any) -> Any:
    """Return the module NumPy if `array` is a NumPy array, else jax.numpy.

    NumPy operations need no compilation."""
    return np if isinstance(array, np.ndarray) else jnp


def lyapunov(
    pair: RotorPair, state: Float[Array, " n"], periods: int, integrator: Integrator
) -> Window:
    """Return a window of `periods` mesh periods (a multiple of 16), integrated from the scaled
    `state`."""
    one, still = jnp.ones_like(state[0]), no_tangents(pair)

    def step(_: Any, window: Window) -> Window:
        return window.after(
            flow(pair, window.end, one, integrator, _SAMPLES, still, measures=Measures())
        )

    return lax.fori_loop(0, periods, step, Window.empty(state, periods))


def no_tangents(pair: RotorPair) -> RotorPair:
    """Return an empty stack of parameter directions for `pair`.

    With it, `flow` computes derivatives with respect to the state only."""
    return jax.tree.map(
        lambda x: jnp.zeros((0, *x.shape), x.dtype), eqx.filter(pair, eqx.is_inexact_array)
    )
