"""Drives, the timing gear, friction of the flanks, and elastic supports of the axes."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.law import balanced_ramp, balanced_step, smooth_step
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
        return self.torque - self.slope * (motion.speed - self.speed)


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
        return dataclasses.replace(self, mass=context.mass, radius=context.pitch_radius)

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
        assert motion.shift is not None
        assert motion.drift is not None
        return -self.stiffness * motion.shift - self.damping * motion.drift

    def lost(self, own: Float[Array, "8"]) -> Bool[Array, ""]:
        return jnp.any(jnp.abs(own[:4]) > _DISPLACED * 2 * self.radius)

    def quickest(self, inertia: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.sqrt(self.mass / self.stiffness)


class GearErrors(eqx.Module):
    """How the play between the teeth moves and changes over a turn of rotor 1.

    `eccentricity` (2,), `angle` (2,) in rad: eccentricity of each gear, divided by the pitch
    radius, and its direction at φ1 = 0. The direction is measured from the line to the other axis,
    in the rotor's sense of rotation. `tooth_angle` (rad): pressure angle of the teeth; None: the
    change of the backlash is neglected. `knots` (n,) of φ1 (rad, from 0 on) and `measured` (6, n):
    powers, highest first, of polynomials that continue each knot: a measured transmission error
    (rad); None: no measurement. `docs/pump.md` derives the formulas.
    """

    eccentricity: Float[Array, "2"]
    angle: Float[Array, "2"]
    tooth_angle: Float[Array, ""] | None = None
    knots: Float[Array, " n"] | None = None
    measured: Float[Array, "6 n"] | None = None

    def __call__(self, phi: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Return the transmission error and the growth of the half backlash (rad), at `phi` (rad).

        The transmission error is the value of ε at the middle of the backlash."""
        return self.run_out(phi, self.measurement(phi))

    def run_out(
        self, phi: Float[Array, "*n"], measured: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Return the result of a call, with a `measured` error (rad) at `phi` (rad)."""
        turned = phi[..., None] + self.angle
        along, across = (self.eccentricity * of(turned) for of in (jnp.cos, jnp.sin))
        middle = measured + across[..., 0] - across[..., 1]
        if self.tooth_angle is None:
            return middle, jnp.zeros_like(middle)
        return middle, -jnp.tan(self.tooth_angle) * (along[..., 0] + along[..., 1])

    def measurement(self, phi: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the measured transmission error (rad) at `phi` (rad)."""
        if self.knots is None or self.measured is None:
            return jnp.zeros_like(phi)
        turned = jnp.mod(phi - self.knots[0], 2 * jnp.pi) + self.knots[0]
        piece = jnp.searchsorted(self.knots, turned, side="right") - 1
        value = jnp.zeros_like(phi)
        for powers in self.measured:
            value = value * (turned - self.knots[piece]) + powers[piece]
        return value


class TimingGear(Part):
    """Timing gear between the rotors: backlash, stiffness, damping.

    The torque is zero while ε differs from `offset` by at most `half_backlash` (rad). Beyond that,
    it is `stiffness` (N·m/rad) times the excess plus `damping` (N·m·s/rad) times dε/dt. The torque
    sets in smoothly over the first `rounding` (rad) of the excess. The rounding preserves integrals
    over ε. The spring therefore takes the same energy from a motion through the rounding, and the
    damper the same momentum, as at a sharp edge. `offset` (rad): ε at the middle of the backlash,
    for a gear mounted out of phase; None: 0. `errors`: what `offset` and `half_backlash` gain over
    a turn; None: nothing. Deflection and damping are then relative to these moving limits.
    """

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    half_backlash: Float[Array, ""]
    rounding: Float[Array, ""]
    offset: Float[Array, ""] | None = None
    errors: GearErrors | None = None

    def meshing(self, motion: Motion) -> tuple["TimingGear", Float[Array, ""]]:
        """Return the gear without errors that acts at the angle of `motion`, and the rate (rad/s)
        of ε relative to its limits."""
        if self.errors is None:
            return self, motion.rate
        speed = jnp.broadcast_to(motion.speed, motion.phi.shape)
        limits, rates = jax.jvp(self.errors, (motion.phi,), (speed,))
        (middle, wider), (moving, widening) = limits, rates
        middle = middle if self.offset is None else middle + self.offset
        half = self.half_backlash + wider
        gear = dataclasses.replace(self, half_backlash=half, offset=middle, errors=None)
        return gear, motion.rate - moving - jnp.sign(motion.relative - middle) * widening

    def __call__(self, relative: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        """Return the torque (N·m) on rotor 1 of a gear without `errors`, equal and opposite to the
        torque on rotor 2.

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
        gear, rate = self.meshing(motion)
        return gear(motion.relative, rate)

    def torque_on_2(self, motion: Motion, own) -> Float[Array, ""]:
        return -self.torque_on_1(motion, own)

    @property
    def whole_turns(self) -> bool:
        return self.errors is not None

    @property
    def play(self) -> Float[Array, ""]:
        return self.half_backlash

    @property
    def edges(self) -> tuple[Float[Array, ""], ...]:
        middle = 0.0 if self.offset is None else self.offset
        return middle + self.half_backlash, middle - self.half_backlash

    def edges_at(self, phi: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
        if self.errors is None:
            return self.edges
        middle, wider = self.errors(phi)
        upper, lower = self.edges
        return upper + middle + wider, lower + middle - wider

    @property
    def holding_stiffness(self) -> Float[Array, ""]:
        return self.stiffness

    def margins(self, motion: Motion, own) -> Float[Array, "2"]:
        """Return numbers (2,): penetration of the teeth (rad), and its excess of the rounding."""
        gear = self.meshing(motion)[0]
        excess = jnp.abs(gear._from_middle(motion.relative)) - gear.half_backlash
        return excess - jnp.stack([jnp.zeros_like(self.rounding), self.rounding])

    def _from_middle(self, relative):
        return relative if self.offset is None else relative - self.offset
