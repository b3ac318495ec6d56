"""The base class of all parts of a scene, and the data that the rotor pair gives a part.

Timescales of a pair, which follow from its parts, set the solver's first and longest steps."""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.contact.law import ContactLaw

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
    """Quantities of the scene for which a part is prepared.

    `inertia` (kg·m²) and `mass` (kg) of one rotor; `pitch_radius` (m); `angle` (rad): the solver's
    unit of ε; `load_torque` (N·m): mean load torque against rotor 2; `speed` (rad/s) of the drive.
    """

    inertia: Float[Array, ""]
    mass: Float[Array, ""]
    pitch_radius: Float[Array, ""]
    angle: Float[Array, ""]
    load_torque: Float[Array, ""]
    speed: Float[Array, ""]


class Part(eqx.Module):
    """A component that acts on a rotor pair through torques, forces on the axes, or drag at the
    flanks. A part can have states of its own.

    Override the methods that apply to your part. A method you leave out costs nothing: no state, no
    computation. Store every number in a field that holds an array: a response is differentiable
    with respect to these fields. Quantities are in SI units; torques, speeds and angles are
    positive in the rotor's own sense of rotation.

    Arguments of several methods: `motion`: position and velocity of the pair; `own` (m,): the
    part's own states; `loads`: sums of all loads on the pair.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> class Brake(rootsopt.Part):
    ...     torque: jax.Array
    ...
    ...     def torque_on_2(self, motion, own):
    ...         return -self.torque
    >>> scene = rootsopt.Scene.from_config(rootsopt.load_config("cic"))
    >>> braked = scene.with_parts(Brake(jax.numpy.asarray(0.5)))  # N·m
    >>> float(braked.extra[0].torque)
    0.5
    """

    # Properties of the part.

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the part's own states, with units."""
        return ()

    @property
    def free(self) -> bool:
        """Whether the part makes the speed of rotor 1 a state, instead of a prescribed quantity."""
        return False

    @property
    def whole_turns(self) -> bool:
        """Whether the part's loads repeat only after a whole turn of rotor 1, instead of each mesh
        period."""
        return False

    @property
    def displaces(self) -> bool:
        """Whether the part lets the axes move (see `axes`). Only one part of a scene can do so."""
        return False

    @property
    def rubs(self) -> bool:
        """Whether the part opposes the sliding of the flanks (see `drag`)."""
        return False

    @property
    def added_inertia(self) -> Float[Array, ""] | None:
        """Inertia (kg·m²) that the part adds to rotor 1; None: no inertia."""
        return None

    def prepare(self: _Part, context: Context) -> _Part:
        """Return the part, completed with values from the scene's `context`.

        Keep these values differentiable: store them as JAX arrays."""
        return self

    # The part's own states: m numbers in SI units. A motion begins at `start`. The solver works
    # with the difference from `start`, divided by `scales`.

    def scales(self, units: Units) -> Float[Array, " m"]:
        """Return the typical size (m,) of each of the part's own states, in SI units.

        The solver divides states by these sizes. Raises NotImplementedError for a part that has
        states but does not override this method."""
        raise NotImplementedError(f"`{type(self).__name__}` has states, but no `scales`")

    def start(self, units: Units) -> Float[Array, " m"] | None:
        """Return the part's own states (m,) at the start of a motion, in SI units; None: zero."""
        return None

    def rates(self, motion: Motion, own: Own, loads: Loads) -> Float[Array, " m"]:
        """Return the time derivatives (m,) of the part's own states `own` (SI units).

        `motion`: position and velocity of the pair; `loads`: sums of all loads on it.

        Raises NotImplementedError for a part that has states but does not override this method."""
        raise NotImplementedError(f"`{type(self).__name__}` has states, but no `rates`")

    def axes(
        self, own: Float[Array, "*k m"] | Float[np.ndarray, "*k m"]
    ) -> tuple[Float[Array, "*k 2 2"], Float[Array, "*k 2 2"]]:
        """Return the displacements (m) and the velocities (m/s) of the axes (rotor, x and y).

        `own`: the part's own states (SI units).

        Raises NotImplementedError for a part that `displaces` but does not override this method."""
        raise NotImplementedError(f"`{type(self).__name__}` displaces the axes, but has no `axes`")

    def lost(self, own: Own) -> Bool[Array, ""] | None:
        """Return whether the part's own states show that the pair no longer runs; None: they never
        do."""
        return None

    # Loads from the part. None: no load.

    def torque_on_1(self, motion: Motion, own: Own) -> Float[Array, ""] | None:
        """Return the torque (N·m) on rotor 1; None: zero.

        `motion`: position and velocity of the pair; `own` (m,): the part's own states (SI units).
        This method is called only if rotor 1 is `free`.
        """
        return None

    def torque_on_2(self, motion: Motion, own: Own) -> Float[Array, ""] | None:
        """Return the torque (N·m) on rotor 2; None: zero.

        `motion`: position and velocity of the pair; `own` (m,): the part's own states (SI
        units)."""
        return None

    def force_on_axes(self, motion: Motion, own: Own) -> Float[Array, "2 2"] | None:
        """Return the forces (N) on the axes (rotor, x and y); None: zero.

        `motion`: position and velocity of the pair; `own` (m,): the part's own states (SI units).
        This method is called only if a part `displaces` the axes."""
        return None

    def drag(self, force: Float[Array, ""], sliding: Float[Array, ""]) -> Float[Array, ""]:
        """Return the tangential force (N) at a contact with the normal `force` (N).

        The result has the sign of `sliding`, the speed (m/s) at which rotor 1 slides on rotor 2.

        Raises NotImplementedError for a part that `rubs` but does not override this method."""
        raise NotImplementedError(f"`{type(self).__name__}` rubs, but has no `drag`")

    # Flags that change at each kink or jump of the part's equations. If a flag is missing,
    # integrals lose accuracy and derivatives are wrong.

    def switches(self, motion: Motion, own: Own) -> Bool[Array, " s"]:
        """Return flags (s,) that change where the part's loads or rates are not smooth.

        `motion`: position and velocity of the pair; `own` (m,): the part's own states (SI
        units). By default, they are those of `margins`."""
        return self.margins(motion, own) > 0

    def drag_switches(self, sliding: Float[Array, ""]) -> Bool[Array, " s"]:
        """Return flags (s,) that change where the drag is not smooth in `sliding` (m/s).

        By default, they are those of `drag_margins`."""
        return self.drag_margins(sliding) > 0

    # Numbers that are positive where these flags are set. Each is smooth across the instant at
    # which its flag changes, and zero there. Without margins, such instants take more iterations to
    # find, and derivatives of an orbit are right only if loads and rates do not jump there.

    def margins(self, motion: Motion, own: Own) -> Float[Array, " s"]:
        """Return numbers (s,), each positive where the flag of `switches` with the same index is
        set."""
        return jnp.zeros(0)

    def drag_margins(self, sliding: Float[Array, ""]) -> Float[Array, " s"]:
        """Return numbers (s,), each positive where the flag of `drag_switches` with the same index
        is set."""
        return jnp.zeros(0)

    # Data from which the solver chooses its steps.

    @property
    def play(self) -> Float[Array, ""] | None:
        """Half the backlash (rad): half the range of ε over which the part exerts no torque between
        the rotors. None for a part that never couples the rotors."""
        return None

    @property
    def edges(self) -> tuple[Float[Array, ""], ...]:
        """Values of ε (rad) at which the part begins to couple the rotors. Solver steps end at
        these.
        """
        return ()

    def edges_at(self, phi: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
        """Return the `edges` at φ1 = `phi` (rad), for a part of `whole_turns` whose edges move."""
        return self.edges

    @property
    def holding_stiffness(self) -> Float[Array, ""] | None:
        """Torsional stiffness (N·m/rad) with which the part opposes ε; None: no stiffness."""
        return None

    def quickest(self, inertia: Float[Array, ""]) -> Float[Array, ""] | None:
        """Return 1/ω (s), where ω is the angular frequency of the part's fastest oscillation.

        `inertia` (kg·m²) of one rotor. The result is None if the part has no oscillation of its
        own."""
        return None


class Timescales(eqx.Module):
    """Timescales of the fastest oscillation and of free flight.

    `swing`: 1/ω (s), where ω is the angular frequency of the fastest oscillation: of rotor 2 on
    flank and timing gear, or of another part; `fall`: time (s) in which the load closes the whole
    backlash of the timing gear; `free`: |ε| (rad) below which the clearance keeps the flanks apart
    at the nominal centre distance. If the backlash is at most the rotation at static penetration,
    there is no free flight, and `fall` is infinite.
    """

    swing: Float[Array, ""]
    fall: Float[Array, ""]
    free: Float[Array, ""]

    @classmethod
    def of(
        cls,
        law: ContactLaw,
        parts: Sequence[Part],
        inertia: Float[Array, ""],
        force: Float[Array, ""],
        radius: Float[Array, ""],
        clearance: Float[Array, ""],
    ) -> "Timescales":
        """Return the timescales of a pair, without derivatives.

        `law`: contact law; `parts`: all parts of the scene; `inertia` (kg·m²) of one rotor; `force`
        (N): static flank force at the pitch `radius` (m); `clearance` (m) of the flanks. The
        contact stiffness is taken at the greater of two depths: the static penetration, and the
        penetration of an impact after free flight through the whole backlash. The energy of this
        impact is the work of the load."""
        play = jnp.zeros_like(force)
        for part in parts:
            play = play if part.play is None else play + 2 * part.play
        static = law.depth_at(force)
        deepest = jnp.maximum(static, law.depth_absorbing(force * radius * play))
        stiffness = radius**2 * law.stiffness_at(deepest)
        for part in parts:
            holding = part.holding_stiffness
            stiffness = stiffness if holding is None else stiffness + holding
        flies = play > static / radius
        fall = jnp.sqrt(2 * jnp.where(flies, play, 1.0) * inertia / (force * radius))
        swing = jnp.sqrt(inertia / stiffness)
        for part in parts:
            own = part.quickest(inertia)
            swing = swing if own is None else jnp.minimum(swing, own)
        # No lever is longer than the pitch radius.
        free = jnp.maximum(clearance, 0.0) / radius
        return lax.stop_gradient(cls(swing, jnp.where(flies, fall, jnp.inf), free))
