"""What every contact is to a rotor pair: gap and levers of two flanks at a pose."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.point import ContactPoint
from rootsopt.errors import InputError


class Approach(NamedTuple):
    """Two flanks at a pose: `gap` (m, negative when they penetrate), levers (m) of rotor 1 and
    rotor 2, and what the contact itself has found there (`place`), None if nothing more."""

    gap: Float[Array, ""]
    lever1: Float[Array, ""]
    lever2: Float[Array, ""]
    place: Any = None


class Contact(eqx.Module):
    """Gap and levers of the drive flanks of two rotors.

    The pose is the roll coordinate x = -(φ1 + φ2)/2 and ε = φ2 - φ1 (rad), see `FlankPair`. A
    contact gives the gap with its levers, d gap = -lever1 dφ1 + lever2 dφ2, so that forces come
    from a potential. It is of period 2π/N in x; the coast flanks follow by x → -x, ε → -ε.
    What else a scene may ask for (the point of contact, other centre distances) is refused unless
    a contact has it.
    """

    @abc.abstractmethod
    def __call__(
        self, roll: Float[Array, ""], relative: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """Gap (m) and the levers about rotor 1 and rotor 2 (m) at x = `roll` and ε = `relative`
        (rad)."""

    @property
    def smooth(self) -> bool:
        """Whether gap and levers are smooth between the `switches`."""
        return True

    @property
    def jumps(self) -> bool:
        """Whether levers may jump at a switch. Such a contact needs a `length_scale`."""
        return False

    @property
    def two_sided(self) -> bool:
        """Whether the gap is also right for flanks turned away from each other (ε > 0), which can
        touch where axes are displaced or flanks are not conjugate."""
        return False

    @property
    def length_scale(self) -> Float[Array, ""] | None:
        """Length (m) to whose rounding the gap is known and which the levers are the size of,
        about the pitch radius. None: the gap has no rounding to speak of."""
        return None

    @property
    def center_distance(self) -> Float[Array, ""]:
        """Distance of the axes (m).

        Raises InputError where a contact is of the nominal distance only."""
        raise self._lacks("another centre distance", "displaced axes need")

    def at_distance(self, distance: Float[Array, ""]) -> "Contact":
        """Return the contact of the same flanks at another centre distance (m).

        Raises InputError where a contact is of the nominal distance only."""
        del distance
        raise self._lacks("another centre distance", "displaced axes need")

    def approach(self, roll: Float[Array, ""], relative: Float[Array, ""]) -> Approach:
        """Gap and levers, with what `point` and `switches` need of the same pose."""
        return Approach(*self(roll, relative))

    def point(
        self, roll: Float[Array, ""], relative: Float[Array, ""], approach: Approach
    ) -> ContactPoint:
        """Place and direction of the contact that `approach` has found at this pose.

        Raises InputError where a contact does not know them."""
        del roll, relative, approach
        raise self._lacks("the point of contact", "friction and supports need")

    def switches(self, roll: Float[Array, ""], approach: Approach) -> Bool[Array, " s"]:
        """On which of its smooth pieces the gap is: one flag for each surface in the space of
        poses at which a derivative of the gap jumps."""
        del roll, approach
        return jnp.zeros(0, bool)

    def _lacks(self, what: str, why: str) -> InputError:
        return InputError(
            f"the contact `{type(self).__name__}` does not give {what}, which {why}; use "
            f"`SearchContact` (`solver.fidelity` = search), or override the method that says so"
        )
