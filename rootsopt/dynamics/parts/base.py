"""The base class of all parts of a scene, and the data that the rotor pair gives a part."""

from typing import NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_Part = TypeVar("_Part", bound="Part")
Own = Float[Array, " m"] | Float[np.ndarray, " m"]
"""A part's own states (SI units). A part without states gets an empty NumPy array, which adds
nothing to a compiled program."""


class Motion(NamedTuple):
    """Position and velocity of the pair at one or several instants.

    `phi`: angle φ1 of rotor 1 (rad); `relative`: ε (rad); `rate`: dε/dt (rad/s); `speed`: angular
    speed of rotor 1 (rad/s); `shift` (rotor, x and y): displacements of the axes (m); `drift`:
    their velocities (m/s). The last two are None if no part lets the axes move.
    """

    phi: Float[Array, "*n"]
    relative: Float[Array, "*n"]
    rate: Float[Array, "*n"]
    speed: Float[Array, "*n"]
    shift: Float[Array, "*n 2 2"] | None = None
    drift: Float[Array, "*n 2 2"] | None = None


class Loads(NamedTuple):
    """Sums of all loads at an instant, contact included.

    `torque1`, `torque2`: torques (N·m) on the rotors, each positive in its rotor's sense of
    rotation; `axes` (rotor, x and y): forces (N) on the axes. `torque1` is None where the speed of
    rotor 1 is prescribed. `axes` is None where the bearings are rigid.
    """

    torque1: Float[Array, ""] | None
    torque2: Float[Array, ""]
    axes: Float[Array, "2 2"] | None


class Units(NamedTuple):
    """Units of the solver: `angle` (rad), in which ε is of order one, and `time` (s), one mesh
    period at the drive's speed."""

    angle: Float[Array, ""]
    time: Float[Array, ""]


class Context(NamedTuple):
    """The scene that a part is prepared for.

    `inertia` (kg·m²) and `mass` (kg) of one rotor; `pitch_radius` (m); `angle` (rad): unit of ε;
    `load_torque` (N·m): mean on rotor 2; `speed` (rad/s) of the drive.
    """

    inertia: Float[Array, ""]
    mass: Float[Array, ""]
    pitch_radius: Float[Array, ""]
    angle: Float[Array, ""]
    load_torque: Float[Array, ""]
    speed: Float[Array, ""]


class Part(eqx.Module):
    """Something that acts on a rotor pair: by torques, by forces on the axes or by drag at the
    flanks. It can have states of its own.

    Override the methods that apply to your part. A method you leave out costs nothing: no state, no
    computation. Store every number in a field that holds an array: a response is differentiable
    with respect to these fields. Quantities are in SI units; torques, speeds and angles are
    positive in the rotor's own sense of rotation.
    """

    # Properties of the part.

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the part's own states, with units."""
        return ()

    @property
    def free(self) -> bool:
        """Whether the part sets rotor 1 free, which makes the speed of rotor 1 a state."""
        return False

    @property
    def displaces(self) -> bool:
        """Whether the part lets the axes move (see `axes`). At most one part of a scene may."""
        return False

    @property
    def rubs(self) -> bool:
        """Whether the part acts against the sliding of the flanks (see `drag`)."""
        return False

    @property
    def added_inertia(self) -> Float[Array, ""] | None:
        """Inertia (kg·m²) that the part adds to rotor 1; None: no inertia."""
        return None

    def prepare(self: _Part, context: Context) -> _Part:
        """Return the part with the values it needs from the scene; keep them differentiable."""
        del context
        return self

    # The part's own states: m numbers in SI units. A motion begins at `start`. The solver works
    # with the difference from `start`, divided by `scales`.

    def scales(self, units: Units) -> Float[Array, " m"]:
        """Return the typical size of each of the part's own states, which the solver divides it by.

        Raises NotImplementedError for a part that has states but does not override this."""
        raise NotImplementedError(f"`{type(self).__name__}` has states, but no `scales`")

    def start(self, units: Units) -> Float[Array, " m"] | None:
        """Return the part's own states at the start of a motion; None: zero."""
        del units
        return None

    def rates(self, motion: Motion, own: Own, loads: Loads) -> Float[Array, " m"]:
        """Return the time derivatives of the part's own states `own`.

        Raises NotImplementedError for a part that has states but does not override this."""
        raise NotImplementedError(f"`{type(self).__name__}` has states, but no `rates`")

    def axes(
        self, own: Float[Array, "*k m"] | Float[np.ndarray, "*k m"]
    ) -> tuple[Float[Array, "*k 2 2"], Float[Array, "*k 2 2"]]:
        """Return the displacements (m) of the axes and their velocities (m/s) (rotor, x and y).

        Raises NotImplementedError for a part that `displaces` but does not override this."""
        raise NotImplementedError(f"`{type(self).__name__}` displaces the axes, but has no `axes`")

    def lost(self, own: Own) -> Bool[Array, ""] | None:
        """Return whether a pair with these states no longer runs; None: it always runs."""
        del own
        return None

    # Loads from the part. None: no load.

    def torque_on_1(self, motion: Motion, own: Own) -> Float[Array, ""] | None:
        """Return the torque (N·m) on rotor 1. It is called only where rotor 1 is free."""
        del motion, own
        return None

    def torque_on_2(self, motion: Motion, own: Own) -> Float[Array, ""] | None:
        """Return the torque (N·m) on rotor 2."""
        del motion, own
        return None

    def force_on_axes(self, motion: Motion, own: Own) -> Float[Array, "2 2"] | None:
        """Return the forces (N) on the axes (rotor, x and y).

        It is called only where a part `displaces` the axes."""
        del motion, own
        return None

    def drag(self, force: Float[Array, ""], sliding: Float[Array, ""]) -> Float[Array, ""]:
        """Return the tangential force (N) at a contact with the normal `force` (N).

        It has the sign of `sliding`, the speed (m/s) at which rotor 1 slides on rotor 2.

        Raises NotImplementedError for a part that `rubs` but does not override this."""
        raise NotImplementedError(f"`{type(self).__name__}` rubs, but has no `drag`")

    # Flags of the smooth piece that the part's equations are on. One flag changes at each kink or
    # jump. If a flag is missing, integrals lose accuracy and derivatives are wrong.

    def switches(self, motion: Motion, own: Own) -> Bool[Array, " s"]:
        """Return flags of the smooth piece that the torques, forces and rates are on."""
        del motion, own
        return jnp.zeros(0, bool)

    def drag_switches(self, sliding: Float[Array, ""]) -> Bool[Array, " s"]:
        """Return flags of the smooth piece that the drag is on at the speed `sliding` (m/s)."""
        del sliding
        return jnp.zeros(0, bool)

    # Numbers that are positive where these flags are set. Each is smooth across the instant at
    # which its flag changes, and zero there. Collocation needs them; a part that has flags but no
    # margins is left to shooting.

    def margins(self, motion: Motion, own: Own) -> Float[Array, " s"]:
        """Return numbers that are positive where the flags of `switches` are set."""
        del motion, own
        return jnp.zeros(0)

    def drag_margins(self, sliding: Float[Array, ""]) -> Float[Array, " s"]:
        """Return numbers that are positive where the flags of `drag_switches` are set."""
        del sliding
        return jnp.zeros(0)

    # Data from which the solver chooses its steps.

    @property
    def play(self) -> Float[Array, ""] | None:
        """Half the range of ε (rad) over which the part leaves the rotors loose; None for a part
        that never holds them."""
        return None

    @property
    def edges(self) -> tuple[Float[Array, ""], ...]:
        """Values of ε (rad) at which the part begins to hold the rotors. Solver steps end there."""
        return ()

    @property
    def holding_stiffness(self) -> Float[Array, ""] | None:
        """Stiffness (N·m/rad) with which the part holds ε; None: no stiffness."""
        return None

    def quickest(self, inertia: Float[Array, ""]) -> Float[Array, ""] | None:
        """Return 1/ω (s) of the part's fastest oscillation, on rotors of this `inertia` (kg·m²);
        None: it has no oscillation of its own."""
        del inertia
        return None
