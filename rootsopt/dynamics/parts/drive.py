"""What turns rotor 1."""

import abc

import equinox as eqx
from jaxtyping import Array, Float


class Drive(eqx.Module):
    """Turns rotor 1, at the angular speed `speed` (rad/s) or about it."""

    speed: eqx.AbstractVar[Float[Array, ""]]

    @property
    @abc.abstractmethod
    def free(self) -> bool:
        """Whether the speed of rotor 1 is a state of the motion."""


class PrescribedDrive(Drive):
    """Rotor 1 turns at the constant angular speed `speed` (rad/s) whatever the torque."""

    speed: Float[Array, ""]

    @property
    def free(self) -> bool:
        return False


class MotorDrive(Drive):
    """A motor on rotor 1 with a straight torque-speed line.

    It gives `torque` (N·m) at `speed` (rad/s), and `slope` (N·m·s/rad) less for every rad/s
    above. `inertia` (kg·m²) of its own is added to that of rotor 1.
    """

    speed: Float[Array, ""]
    torque: Float[Array, ""]
    slope: Float[Array, ""]
    inertia: Float[Array, ""]

    @property
    def free(self) -> bool:
        return True

    def torque_at(self, speed: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Torque (N·m) at the angular `speed` (rad/s) of rotor 1."""
        return self.torque - self.slope * (speed - self.speed)
