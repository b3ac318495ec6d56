"""Integration of the equation of motion: method, tolerance and steps."""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.dynamics.landing import LandingControl
from rootsopt.dynamics.pair import RotorPair

METHODS: dict[str, Callable[..., diffrax.AbstractERK]] = {
    "tsit5": diffrax.Tsit5,
    "dopri8": diffrax.Dopri8,
}
_LONGEST = 1 / 32, 1 / 8, 4.0
"""Upper limits on the step length: an absolute length (mesh periods), and a multiple of
`Timescales.fall`. The smaller limit applies. In free flight, the error control alone would let a
step skip a short contact of the gear. The third number, divided by `max_steps`, is the least value
(mesh periods) of the second limit. Steps of this length use at most a quarter of `max_steps` per
mesh period."""


class Integrator(eqx.Module):
    """Settings for integrating the equation of motion.

    `method`: a key of `METHODS`; `rtol`: relative tolerance, also used as absolute tolerance, since
    states are scaled; `max_steps`: maximum number of steps in one integration.
    """

    method: str = eqx.field(static=True)
    rtol: Float[Array, ""]
    max_steps: int = eqx.field(static=True)

    @property
    def tolerance(self) -> Float[Array, ""]:
        """`rtol` or, if greater, 20 rounding errors."""
        return jnp.maximum(self.rtol, 20 * float(jnp.finfo(float).eps))

    def solver(self) -> diffrax.AbstractERK:
        """Return the diffrax solver."""
        return METHODS[self.method](scan_kind="lax")

    def controller(
        self, periods: Float[Array, ""] | float = 1.0, pair: RotorPair | None = None
    ) -> "diffrax.PIDController | LandingControl":
        """Return the step size control.

        `periods`: mesh periods per unit of the independent variable; `pair`: rotor pair whose
        `timescales` limit the steps. The result is a `LandingControl` if the `timescales` are
        known. Otherwise it is a plain `diffrax.PIDController`."""
        rtol = self.tolerance
        longest = _LONGEST[0]
        if pair is not None and pair.timescales is not None:
            fall = pair.timescales.fall / pair.mesh_period
            flying = jnp.maximum(_LONGEST[1] * fall, _LONGEST[2] / self.max_steps)
            longest = jnp.minimum(longest, flying)
        base = diffrax.PIDController(rtol=rtol, atol=rtol, dtmax=longest / periods)
        if pair is None or pair.timescales is None:
            return base
        return LandingControl.of(base, pair, periods)


class StepGrid(diffrax.AbstractAdaptiveStepSizeController):
    """Step size control that either chooses steps adaptively or repeats recorded steps.

    On repeated steps the discrete flow is a smooth function of state and parameters, so Newton's
    method converges to rounding. `pid`: control of adaptive steps; `ends`: ends of the recorded
    steps (inf beyond the last); `repeat`: whether to repeat the recorded steps.
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

    # diffrax prescribes the parameters of `init` and `adapt_step_size`.
    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        first, state = self.pid.init(terms, t0, t1, y0, dt0, args, func, error_order)
        strain = jnp.zeros((), self.ends.dtype)
        return jnp.where(self.repeat, self.ends[0], first), (state, jnp.asarray(1), strain)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):  # pyright: ignore[reportIncompatibleMethodOverride]
        state, count, strain = state
        # The choice of steps is not differentiated.
        y0, y1_candidate, y_error = lax.stop_gradient((y0, y1_candidate, y_error))
        keep, start, stop, jump, state, result = self.pid.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        recorded = self.ends[jnp.minimum(count, self.ends.shape[0] - 1)]
        # Repeated steps are never rejected. Their greatest error estimate is recorded instead.
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
