"""How the equation of motion is integrated: method, tolerance and steps."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import optimistix
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.dynamics.landing import LandingControl
from rootsopt.dynamics.pair import RotorPair

METHODS: dict[str, Callable[..., diffrax.AbstractSolver]] = {
    "tsit5": diffrax.Tsit5,
    "dopri5": diffrax.Dopri5,
    "dopri8": diffrax.Dopri8,
    "kvaerno3": diffrax.Kvaerno3,
    "kvaerno5": diffrax.Kvaerno5,
}
IMPLICIT = ("kvaerno3", "kvaerno5")


_STAGES = 1e5
"""Roundings to which the stages of an implicit method are known: the gap is the difference of
lengths ten thousand times a penetration, and the force a power of it. Iterations that are asked for
less never end, and a repeated step cannot be made shorter. (Each is a whole step of Newton's
method, so that the last one gains more than was asked for.)"""
_FIRST_STEP = 1e-3, 0.05
"""First step: in mesh periods, and in units of the pair's quickest swing; the shorter counts. Too
large a one is rejected by the error control."""
_LONGEST = 1 / 32, 1 / 8, 4.0
"""Longest step: in mesh periods, and in units of a fall through the play; the shorter counts. In
free flight the error control would let a step pass over a short touch of the gear without a stage
inside it. But steps so long must not use up more than the last of these as a share (1 / x) of
those allowed: an implicit method takes far longer ones where the pair does not fly."""


class Integrator(eqx.Module):
    """How the equation is integrated.

    `method`: a key of `METHODS` (tsit5, dopri5, dopri8 explicit; kvaerno3, kvaerno5
    implicit); `rtol`: relative tolerance, which is also the absolute one, the state
    being scaled; `max_steps` for one mesh period. The precision is that of the state, and
    the tolerance is never asked to be finer than some twenty roundings of it.
    """

    method: str = eqx.field(static=True)
    rtol: Float[Array, ""]
    max_steps: int = eqx.field(static=True)

    def tolerance(self, dtype: Any) -> Float[Array, ""]:
        """Tolerance for states of type `dtype`."""
        floor = 20 * float(jnp.finfo(dtype).eps)
        return jnp.maximum(self.rtol, floor).astype(dtype)

    def solver(self, dtype: Any, loops: str = "lax") -> diffrax.AbstractSolver:
        """The method for states of type `dtype`; `loops` over the stages of a step are
        "lax" (forward mode only) or "bounded" (either mode)."""
        method = METHODS[self.method]
        if self.method not in IMPLICIT:
            return method(scan_kind=loops)
        least = _STAGES * float(jnp.finfo(dtype).eps)
        rtol: Any = jnp.maximum(self.tolerance(dtype), least).astype(dtype)
        # With a Jacobian for every iteration: one kept from the step's begin does not converge
        # across a kink, and a repeated step cannot be made shorter.
        return method(scan_kind=loops, root_finder=optimistix.Newton(rtol=rtol, atol=rtol))

    def controller(
        self,
        dtype: Any,
        periods: Float[Array, ""] | float = 1.0,
        pair: RotorPair | None = None,
    ) -> "diffrax.PIDController | LandingControl":
        """Step size control of states of type `dtype` over an interval of `periods`, for `pair`
        if that is known."""
        rtol = self.tolerance(dtype)
        longest = _LONGEST[0]
        if pair is not None and pair.timescales is not None:
            fall = pair.timescales.fall / pair.mesh_period
            flying = jnp.maximum(_LONGEST[1] * fall, _LONGEST[2] / self.max_steps)
            longest = jnp.minimum(longest, flying).astype(dtype)
        base = diffrax.PIDController(rtol=rtol, atol=rtol, dtmax=longest / periods)
        if pair is None or pair.timescales is None:
            return base
        return LandingControl.of(base, pair, periods)


def first_step(pair: RotorPair, dtype: Any) -> Float[Array, ""]:
    """First step (mesh periods) to be tried."""
    longest, share = _FIRST_STEP
    if pair.timescales is None:
        return jnp.asarray(longest, dtype)
    swing = lax.stop_gradient(pair.timescales.swing / pair.mesh_period)
    return jnp.minimum(longest, share * swing).astype(dtype)


class StepGrid(diffrax.AbstractAdaptiveStepSizeController):
    """Adaptive steps, or a repetition of steps recorded before.

    On repeated steps the discrete flow is a smooth function of state and parameters, and
    Newton's method converges to rounding. `ends`: ends of the recorded steps (inf beyond
    the last), used where `repeat` is true.
    """

    pid: diffrax.PIDController | LandingControl
    ends: Float[Array, " steps"]
    repeat: Bool[Array, ""]

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.pid.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.pid.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.pid.norm

    def wrap(self, direction):
        return eqx.tree_at(lambda self: self.pid, self, self.pid.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        first, state = self.pid.init(terms, t0, t1, y0, dt0, args, func, error_order)
        strain = jnp.zeros((), self.ends.dtype)
        return jnp.where(self.repeat, self.ends[0], first), (state, jnp.asarray(1), strain)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):  # pyright: ignore[reportIncompatibleMethodOverride]
        state, count, strain = state
        # The choice of steps is no part of what is differentiated.
        y0, y1_candidate, y_error = lax.stop_gradient((y0, y1_candidate, y_error))
        keep, start, stop, jump, state, result = self.pid.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        recorded = self.ends[jnp.minimum(count, self.ends.shape[0] - 1)]
        # Nothing is rejected where steps are repeated; whether it would have been is remembered.
        unit = self.pid.atol + self.pid.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1_candidate))
        strain = jnp.maximum(strain, self.pid.norm(y_error / unit))
        return (
            keep | self.repeat,
            jnp.where(self.repeat, t1, start),
            jnp.where(self.repeat, recorded, stop),
            jump & ~self.repeat,
            (state, count + 1, strain),
            diffrax.RESULTS.where(self.repeat, diffrax.RESULTS.successful, result),
        )
