"""Drives, friction of the flanks, and elastic supports of the axes."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.law import smooth_step
from rootsopt.dynamics.parts.base import Context, Loads, Motion, Part, Units


class Drive(Part):
    """A part that turns rotor 1, at or near the angular speed `speed` (rad/s).

    Unless a part of the scene is `free`, rotor 1 turns at exactly this speed, whatever the torque.
    """

    speed: eqx.AbstractVar[Float[Array, ""]]


class PrescribedDrive(Drive):
    """A drive that turns rotor 1 at the constant angular speed `speed` (rad/s), whatever the
    torque."""

    speed: Float[Array, ""]


class MotorDrive(Drive):
    """A motor that turns rotor 1, with a linear torque-speed characteristic.

    `torque` (N·m) at `speed` (rad/s); `slope` (N·m·s/rad): loss of torque for each rad/s above
    `speed`; `inertia` (kg·m²) of the motor, which is added to the inertia of rotor 1.
    """

    speed: Float[Array, ""]
    torque: Float[Array, ""]
    slope: Float[Array, ""]
    inertia: Float[Array, ""]

    @property
    def free(self) -> bool:
        return True

    @property
    def added_inertia(self) -> Float[Array, ""]:
        return self.inertia

    def torque_on_1(self, motion, own):
        del own
        return self.torque_at(motion.speed)

    def torque_at(self, speed: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the torque (N·m) at the angular `speed` (rad/s) of rotor 1."""
        return self.torque - self.slope * (speed - self.speed)


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

    def drag_margins(self, sliding: Float[Array, ""]) -> Float[Array, "4"]:
        """Return numbers (4,) that are zero where the coefficient is not smooth: at
        ±`stiction_speed` and ±`friction_speed`."""
        speeds = jnp.stack([self.stiction_speed, self.friction_speed])
        return sliding - jnp.concatenate([speeds, -speeds])


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
