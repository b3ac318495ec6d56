"""Coulomb friction between the flanks."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.impact import smooth_step
from rootsopt.dynamics.parts.base import Part


class Friction(Part):
    """Coefficient of friction over the sliding speed, as multibody programs have it.

    It rises from -`static` to `static` between -`stiction_speed` and `stiction_speed` (m/s) and
    falls to `kinetic` at `friction_speed`, by cubic steps: continuously differentiable, so that
    rest is a slow creep.
    """

    static: Float[Array, ""]
    kinetic: Float[Array, ""]
    stiction_speed: Float[Array, ""]
    friction_speed: Float[Array, ""]

    def __call__(self, sliding: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Coefficient with the sign of the `sliding` speed (m/s)."""
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
        """On which of its smooth pieces the coefficient is."""
        speeds = jnp.stack([self.stiction_speed, self.friction_speed])
        return sliding > jnp.concatenate([speeds, -speeds])
