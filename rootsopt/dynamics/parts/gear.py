"""The timing gear between the rotors."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.impact import balanced_ramp, balanced_step
from rootsopt.dynamics.parts.base import Motion, Part


class TimingGear(Part):
    """Timing gear between the rotors: backlash, stiffness, damping.

    The torque is zero while ε differs from `offset` by at most `half_backlash` (rad). Beyond that,
    it is `stiffness` (N·m/rad) times the excess plus `damping` (N·m·s/rad) times dε/dt. The torque
    sets in smoothly over the first `rounding` (rad) of the excess. The rounding preserves integrals
    over ε. The spring therefore takes the same energy from a motion through the rounding, and the
    damper the same momentum, as at a sharp edge. `offset` (rad): ε at the middle of the backlash,
    for a gear mounted out of phase; None: 0.
    """

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    half_backlash: Float[Array, ""]
    rounding: Float[Array, ""]
    offset: Float[Array, ""] | None = None

    def __call__(self, relative: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        """Return the torque (N·m) on rotor 1, equal and opposite to the torque on rotor 2.

        `relative`: ε (rad); `rate`: dε/dt (rad/s)."""
        relative = self._from_middle(relative)
        excess = jnp.abs(relative) - self.half_backlash
        engaged = jnp.where(
            self.rounding > 0,
            balanced_step(excess / jnp.where(self.rounding > 0, self.rounding, 1.0)),
            jnp.where(excess > 0, 1.0, 0.0),
        )
        spring = self.stiffness * jnp.sign(relative) * balanced_ramp(excess, self.rounding)
        return spring + self.damping * engaged * rate

    def torque_on_1(self, motion: Motion, own) -> Float[Array, ""]:
        del own
        return self(motion.relative, motion.rate)

    def torque_on_2(self, motion: Motion, own) -> Float[Array, ""]:
        del own
        return -self(motion.relative, motion.rate)

    @property
    def play(self) -> Float[Array, ""]:
        return self.half_backlash

    @property
    def edges(self) -> tuple[Float[Array, ""], ...]:
        middle = 0.0 if self.offset is None else self.offset
        return middle + self.half_backlash, middle - self.half_backlash

    @property
    def holding_stiffness(self) -> Float[Array, ""]:
        return self.stiffness

    def switches(self, motion: Motion, own) -> Bool[Array, "2"]:
        """Return flags (2,): whether the gear is engaged, and whether it is beyond the rounding."""
        del own
        excess = jnp.abs(self._from_middle(motion.relative)) - self.half_backlash
        return excess > jnp.stack([jnp.zeros_like(self.rounding), self.rounding])

    def margins(self, motion: Motion, own) -> Float[Array, "2"]:
        del own
        excess = jnp.abs(self._from_middle(motion.relative)) - self.half_backlash
        return excess - jnp.stack([jnp.zeros_like(self.rounding), self.rounding])

    def _from_middle(self, relative):
        """Return ε (rad) relative to the middle of the backlash."""
        return relative if self.offset is None else relative - self.offset
