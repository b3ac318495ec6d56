"""Drives: the parts that turn rotor 1."""

import equinox as eqx
from jaxtyping import Array, Float

from rootsopt.dynamics.parts.base import Part


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
        return self.torque_at(motion.speed)

    def torque_at(self, speed: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the torque (N·m) at the angular `speed` (rad/s) of rotor 1."""
        return self.torque - self.slope * (speed - self.speed)
