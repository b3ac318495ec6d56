"""What every part of a scene is to the rotor pair, and what the pair tells a part."""

from typing import NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_Part = TypeVar("_Part", bound="Part")
Own = Float[Array, " m"] | Float[np.ndarray, " m"]
"""A part's own states (SI); of none an empty array of NumPy, which a program does not see."""


class Motion(NamedTuple):
    """Position and velocity of the pair at an instant (SI units): angle φ1 and angular speed of
    rotor 1, ε and its rate; with displaced axes, displacements of both (rotor, x and y) and their
    velocities."""

    phi: Float[Array, "*n"]
    relative: Float[Array, "*n"]
    rate: Float[Array, "*n"]
    speed: Float[Array, "*n"]
    shift: Float[Array, "*n 2 2"] | None = None
    drift: Float[Array, "*n 2 2"] | None = None


class Loads(NamedTuple):
    """What acts in sum at an instant, contact included: torques (N·m) on rotor 1 and rotor 2, each
    in its rotor's sense of rotation, and forces (N) on both axes (rotor, x and y). On rotor 1 None
    where its speed is prescribed, on the axes None where they are in rigid bearings."""

    torque1: Float[Array, ""] | None
    torque2: Float[Array, ""]
    axes: Float[Array, "2 2"] | None


class Units(NamedTuple):
    """What the solver counts in: `angle` (rad), in which ε is of order one, and `time` (s), a mesh
    period at the drive's speed."""

    angle: Float[Array, ""]
    time: Float[Array, ""]


class Context(NamedTuple):
    """The scene that a part is prepared for: `inertia` (kg·m²) and `mass` (kg) of one rotor,
    `pitch_radius` (m), `angle` (rad; unit of ε), `load_torque` (N·m; mean on rotor 2) and `speed`
    (rad/s) of the drive."""

    inertia: Float[Array, ""]
    mass: Float[Array, ""]
    pitch_radius: Float[Array, ""]
    angle: Float[Array, ""]
    load_torque: Float[Array, ""]
    speed: Float[Array, ""]


class Part(eqx.Module):
    """Something that acts on a rotor pair, by torques, by forces on the axes or by drag at the
    flanks, and that may have states of its own.

    Override what the part has. What it leaves alone adds no state and no operation. All its numbers
    are fields that hold arrays: a response is differentiable with respect to them. Quantities are
    in SI units; torques, speeds and angles are positive in the rotor's own sense of rotation.
    """

    # What it is

    @property
    def states(self) -> tuple[str, ...]:
        """Names of its own states, with units."""
        return ()

    @property
    def free(self) -> bool:
        """Whether it sets rotor 1 free: its speed is then a state of the motion."""
        return False

    @property
    def displaces(self) -> bool:
        """Whether it lets the axes move: see `axes`. One part of a scene may."""
        return False

    @property
    def rubs(self) -> bool:
        """Whether it acts against the sliding of the flanks: see `drag`."""
        return False

    @property
    def added_inertia(self) -> Float[Array, ""] | None:
        """Inertia (kg·m²) that turns with rotor 1."""
        return None

    def prepare(self: _Part, context: Context) -> _Part:
        """Return the part with what it needs of the scene filled in, differentiable."""
        del context
        return self

    # Its own states. They are m numbers, in SI units; the solver counts them from `start`, in
    # units of `scales`, and a motion begins at `start`.

    def scales(self, units: Units) -> Float[Array, " m"]:
        """Sizes of its own states, such that they are of order one in these units."""
        raise NotImplementedError(f"`{type(self).__name__}` has states, but no `scales`")

    def start(self, units: Units) -> Float[Array, " m"] | None:
        """Its own states at the start of a motion; None: zero."""
        del units
        return None

    def rates(self, motion: Motion, own: Own, loads: Loads) -> Float[Array, " m"]:
        """Time derivatives of its own states `own`."""
        raise NotImplementedError(f"`{type(self).__name__}` has states, but no `rates`")

    def axes(
        self, own: Float[Array, "*k m"] | Float[np.ndarray, "*k m"]
    ) -> tuple[Float[Array, "*k 2 2"], Float[Array, "*k 2 2"]]:
        """Displacements (m) of the axes and their velocities (m/s), of a part that `displaces`."""
        raise NotImplementedError(f"`{type(self).__name__}` displaces the axes, but has no `axes`")

    def lost(self, own: Own) -> Bool[Array, ""] | None:
        """Whether these states are no longer those of a running pair; None: they always are."""
        del own
        return None

    # What it does. None: nothing.

    def torque_on_1(self, motion: Motion, own: Own) -> Float[Array, ""] | None:
        """Torque (N·m) on rotor 1; asked for only where rotor 1 is free."""
        del motion, own
        return None

    def torque_on_2(self, motion: Motion, own: Own) -> Float[Array, ""] | None:
        """Torque (N·m) on rotor 2."""
        del motion, own
        return None

    def force_on_axes(self, motion: Motion, own: Own) -> Float[Array, "2 2"] | None:
        """Forces (N) on the axes (rotor, x and y); asked for only where a part `displaces` them."""
        del motion, own
        return None

    def drag(self, force: Float[Array, ""], sliding: Float[Array, ""]) -> Float[Array, ""]:
        """Tangential force (N) at a contact with the normal `force` (N), with the sign of the speed
        `sliding` (m/s) at which rotor 1 slides on rotor 2; of a part that `rubs`."""
        raise NotImplementedError(f"`{type(self).__name__}` rubs, but has no `drag`")

    # Where its equations are not smooth: one flag for every kink or jump, which changes there. An
    # integral is as accurate as promised, and a derivative is right, only if none is missing.

    def switches(self, motion: Motion, own: Own) -> Bool[Array, " s"]:
        """On which of their smooth pieces torques, forces and rates are."""
        del motion, own
        return jnp.zeros(0, bool)

    def drag_switches(self, sliding: Float[Array, ""]) -> Bool[Array, " s"]:
        """On which of its smooth pieces the drag is at a sliding speed (m/s)."""
        del sliding
        return jnp.zeros(0, bool)

    # What the steps of a solver follow from.

    @property
    def play(self) -> Float[Array, ""] | None:
        """Half the range of ε (rad) in which it does not hold the rotors, of a part that does so
        beyond."""
        return None

    @property
    def edges(self) -> tuple[Float[Array, ""], ...]:
        """ε (rad) at which it begins to hold the rotors: a step of the solver ends there."""
        return ()

    @property
    def holding_stiffness(self) -> Float[Array, ""] | None:
        """Stiffness (N·m/rad) with which it holds ε."""
        return None

    def quickest(self, inertia: Float[Array, ""]) -> Float[Array, ""] | None:
        """Time (s) in which its quickest swing advances by one radian, 1/ω, on rotors of this
        `inertia` (kg·m²)."""
        del inertia
        return None
