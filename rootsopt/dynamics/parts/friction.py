"""Coulomb friction between the flanks."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.impact import smooth_step
from rootsopt.dynamics.parts.base import Part


class Friction(Part):
    """Coefficient of friction as a function of the sliding speed, as in multibody programs.

    The coefficient rises from -`static` to `static` between -`stiction_speed` and `stiction_speed`
    (m/s). It falls to `kinetic` at `friction_speed` (m/s). Both changes are cubic steps, so the
    coefficient is continuously differentiable. As a consequence, flanks never stick: they creep.
    """

    static: Float[Array, ""]
    kinetic: Float[Array, ""]
    stiction_speed: Float[Array, ""]
    friction_speed: Float[Array, ""]

    def __call__(self, sliding: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the coefficient, with the sign of the `sliding` speed (m/s)."""
        rise = 2 * smooth_step((sliding / self.stiction_speed + 1) / 2) - 1
        span = self.friction_speed - self.stiction_speed
        fall = smooth_step((jnp.abs(sliding) - self.stiction_speed) / span)
        return rise * (self.static - (self.static - self.kinetic) * fall)

    @property
    def rubs(self) -> bool:
        return True

    def drag(self, force: Float[Array, ""], sliding: Float[Array, ""]) -> Float[Array, ""]:
        return self(sliding) * force

    def drag_switches(self, sliding: Float[Array, ""]) -> Bool[Array, "4"]:
        """Return flags (4,) that change where the coefficient is not smooth: at ±`stiction_speed`
        and ±`friction_speed`."""
        speeds = jnp.stack([self.stiction_speed, self.friction_speed])
        return sliding > jnp.concatenate([speeds, -speeds])

    def drag_margins(self, sliding: Float[Array, ""]) -> Float[Array, "4"]:
        speeds = jnp.stack([self.stiction_speed, self.friction_speed])
        return sliding - jnp.concatenate([speeds, -speeds])
