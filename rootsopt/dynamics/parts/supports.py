"""Elastic bearings of the rotors."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.dynamics.parts.base import Context, Loads, Motion, Part, Units

# Displacement of an axis (fraction of the centre distance) above which the rotors no longer count
# as being in mesh.
_DISPLACED = 0.1


class Supports(Part):
    """Elastic bearings that let the axes of both rotors move.

    `stiffness` (N/m) and `damping` (N·s/m) of a rotor's two bearings together, the same in every
    direction perpendicular to the axis; `mass` (kg) of one rotor; `radius` (m): the pitch radius.
    Mass and radius come from the scene (`prepare`). The solver's unit of displacement is `radius`
    times the unit of ε.
    """

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    mass: Float[Array, ""]
    radius: Float[Array, ""]

    @property
    def states(self) -> tuple[str, ...]:
        axes = [f"{axis} of rotor {rotor}" for rotor in (1, 2) for axis in "xy"]
        return (*(f"{axis} (m)" for axis in axes), *(f"velocity of {axis} (m/s)" for axis in axes))

    @property
    def displaces(self) -> bool:
        return True

    def prepare(self, context: Context) -> "Supports":
        new = context.mass, context.pitch_radius
        return eqx.tree_at(lambda supports: (supports.mass, supports.radius), self, new)

    def scales(self, units: Units) -> Float[Array, "8"]:
        length = units.angle * self.radius
        return jnp.repeat(jnp.stack([length, length / units.time]), 4)

    def axes(self, own: Float[Array, "*k 8"]):
        shape = *own.shape[:-1], 2, 2
        return own[..., :4].reshape(shape), own[..., 4:].reshape(shape)

    def rates(self, motion: Motion, own: Float[Array, "8"], loads: Loads) -> Float[Array, "8"]:
        assert loads.axes is not None
        return jnp.concatenate([own[4:], loads.axes.ravel() / self.mass])

    def force_on_axes(self, motion: Motion, own: Float[Array, "8"]) -> Float[Array, "2 2"]:
        del own
        assert motion.shift is not None
        assert motion.drift is not None
        return self.force(motion.shift, motion.drift)

    def lost(self, own: Float[Array, "8"]) -> Bool[Array, ""]:
        return jnp.any(jnp.abs(own[:4]) > _DISPLACED * 2 * self.radius)

    def quickest(self, inertia: Float[Array, ""]) -> Float[Array, ""]:
        del inertia
        return jnp.sqrt(self.mass / self.stiffness)

    def force(
        self, displacement: Float[Array, "*n"], velocity: Float[Array, "*n"]
    ) -> Float[Array, "*n"]:
        """Return the bearing forces (N) on the rotors.

        `displacement` (m), `velocity` (m/s): those of the axes. All arrays have the same shape."""
        return -self.stiffness * displacement - self.damping * velocity
