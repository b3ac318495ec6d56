"""Integration of the equation of motion: method, tolerance and steps."""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.dynamics.landing import LandingControl
from rootsopt.dynamics.pair import RotorPair

METHODS: dict[str, Callable[..., diffrax.AbstractERK]] = {
    "tsit5": diffrax.Tsit5,
    "dopri8": diffrax.Dopri8,
}
# Upper limits on the step length: an absolute length (mesh periods), and a multiple of
# `Timescales.fall`. The smaller limit applies. In free flight, the error control alone would let a
# step skip a short contact of the gear. The third number, divided by `max_steps`, is the least
# value (mesh periods) of the second limit. Steps of this length use at most a quarter of
# `max_steps` per mesh period.
_LONGEST = 1 / 32, 1 / 8, 4.0


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

    def controller(self, pair: RotorPair) -> "diffrax.PIDController | LandingControl":
        """Return the step size control for `pair`, whose `timescales` limit the steps.

        The result is a `LandingControl` if they are known. Otherwise it is a plain
        `diffrax.PIDController`."""
        rtol, longest = self.tolerance, jnp.asarray(_LONGEST[0])
        if pair.timescales is not None:
            fall = pair.timescales.fall / pair.mesh_period
            flying = jnp.maximum(_LONGEST[1] * fall, _LONGEST[2] / self.max_steps)
            longest = jnp.minimum(longest, flying)
        base = diffrax.PIDController(rtol=rtol, atol=rtol, dtmax=longest)
        return base if pair.timescales is None else LandingControl.of(base, pair)
