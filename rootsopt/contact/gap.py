"""Base class of all contacts: gap and levers of two flanks at a pose."""

import abc
import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rootsopt.errors import InputError


class ContactPoint(NamedTuple):
    """Position and direction of a flank contact.

    n is the common normal, directed from rotor 1 to rotor 2; O1 and O2 are the axes.
    `support1`: (P - O1)·n (m), where P is the point of contact.
    `support2`: (O2 - P)·n (m).
    `radial`: component of n along the line of centres.
    """

    support1: Float[Array, ""]
    support2: Float[Array, ""]
    radial: Float[Array, ""]


class Approach(NamedTuple):
    """Gap and levers of two flanks at a pose.

    `gap`: gap (m), negative when the flanks penetrate; `lever1`, `lever2`: levers (m) of rotor 1
    and rotor 2; `place`: further result of the contact that its `point` and `switches` use, or
    `None`."""

    gap: Float[Array, ""]
    lever1: Float[Array, ""]
    lever2: Float[Array, ""]
    place: Any = None


class Slices(NamedTuple):
    """Gauss points along the axis of twisted rotors.

    `places` (n,): distance of each slice from the middle, as a share of the rotor's length.
    `weights` (n,): share of the length that each slice stands for; their sum is 1. `offsets` (n,):
    angle (rad) that is added to the angles of both rotors, each in its own sense of rotation.
    `twist` (rad): over the whole length."""

    places: Float[Array, " n"]
    weights: Float[Array, " n"]
    offsets: Float[Array, " n"]
    twist: Float[Array, ""]


class Contact(eqx.Module):
    """Gap and levers of the drive flanks of two rotors.

    φ1 and φ2 (rad) are the rotations of the rotors. A pose is the roll coordinate x = -(φ1 + φ2)/2
    and the relative rotation ε = φ2 - φ1. A contact returns the gap and its levers. The gap and the
    levers satisfy d gap = -lever1 dφ1 + lever2 dφ2, so that forces come from a potential. The gap's
    period in x is 2π/N. The coast flanks follow by x → -x, ε → -ε.

    A scene may also need the point of contact or another centre distance. By default, a contact
    does not support these and raises `InputError`.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> class Wedge(rootsopt.Contact):
    ...     lever: jax.Array
    ...
    ...     def __call__(self, roll, relative):
    ...         return self.lever * relative, self.lever, self.lever
    >>> gap, _, _ = Wedge(jax.numpy.asarray(0.03))(0.0, -1e-3)
    >>> print(f"{1e6 * float(gap):.0f} µm")
    -30 µm
    """

    @abc.abstractmethod
    def __call__(
        self, roll: Float[Array, ""], relative: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """Return the gap (m) and the levers (m) of rotor 1 and rotor 2 at a pose.

        `roll`, `relative`: x and ε (rad)."""

    @property
    def smooth(self) -> bool:
        """Whether gap and levers are smooth wherever no flag of `switches` changes.

        If they are not, forces have no derivatives: these are NaN."""
        return True

    @property
    def jumps(self) -> bool:
        """Whether levers may jump where a flag of `switches` changes.

        The gap is continuous there."""
        return False

    @property
    def two_sided(self) -> bool:
        """Whether the gap is also valid where the flanks are turned away from each other (ε > 0).

        Such flanks can touch if the axes are displaced or the flanks are not conjugate."""
        return False

    @property
    def slices(self) -> Slices | None:
        """Slices of twisted rotors, for each of which the pair evaluates the contact; `None`: the
        rotors are straight."""
        return None

    @property
    def sections(self) -> int:
        """Number of slices; 1 for straight rotors."""
        return 1

    def in_slice(self, number: Int[Array, ""]) -> "Contact":
        """Return the contact in the slice with the index `number`; by default, this contact
        itself."""
        del number
        return self

    @property
    def center_distance(self) -> Float[Array, ""]:
        """Distance between the rotors' axes (m).

        Raises `InputError` if the contact supports only the nominal distance."""
        raise self._lacks("another centre distance", "displaced axes need")

    def at_distance(self, distance: Float[Array, ""]) -> "Contact":
        """Return the contact of the same flanks at another centre `distance` (m).

        Raises `InputError` if the contact supports only the nominal distance."""
        del distance
        raise self._lacks("another centre distance", "displaced axes need")

    def approach(self, roll: Float[Array, ""], relative: Float[Array, ""]) -> Approach:
        """Return the gap and the levers (m) at x = `roll` and ε = `relative` (rad).

        The result also holds what `point` and `switches` need at the same pose."""
        return Approach(*self(roll, relative))

    def point(
        self, roll: Float[Array, ""], relative: Float[Array, ""], approach: Approach
    ) -> ContactPoint:
        """Return position and direction of the contact that `approach` has found at this pose.

        `roll`, `relative`: x and ε (rad). Raises `InputError` if the contact cannot compute the
        point."""
        del roll, relative, approach
        raise self._lacks("the point of contact", "friction and supports need")

    def switches(self, roll: Float[Array, ""], approach: Approach) -> Bool[Array, " s"]:
        """Return flags (s,) that identify the smooth piece of the gap at x = `roll` (rad).

        `approach`: result of `approach` at the same pose. A flag changes wherever a derivative of
        the gap jumps."""
        del roll, approach
        return jnp.zeros(0, bool)

    def margins(self, roll: Float[Array, ""], approach: Approach) -> Float[Array, " s"]:
        """Return numbers (s,) that are positive where the flags of `switches` are set.

        By default, a number is 1 or -1. In `NearContact`, a number whose flag changes during
        contact passes smoothly through zero. `roll`, `approach`: as in `switches`."""
        return jnp.where(self.switches(roll, approach), 1.0, -1.0)

    def on_side(self, side: Float[Array, ""]) -> "Contact":
        """Return the contact for one side of the flanks; by default, this contact itself.

        `side`: 1 for the drive flanks, -1 for the coast flanks."""
        del side
        return self

    def _lacks(self, what: str, why: str) -> InputError:
        return InputError(
            f"the contact `{type(self).__name__}` does not give {what}, which {why}; use "
            "`SearchContact`, the scene's own contact, or override the method that raises this"
        )


class WrappedContact(Contact):
    """A contact that delegates to its `section`, except for what a subclass overrides."""

    section: eqx.AbstractVar[Contact]

    @property
    def slices(self) -> Slices | None:
        return self.section.slices

    @property
    def sections(self) -> int:
        return self.section.sections

    def in_slice(self, number: Int[Array, ""]):
        return dataclasses.replace(self, section=self.section.in_slice(number))

    @property
    def smooth(self) -> bool:
        return self.section.smooth

    @property
    def jumps(self) -> bool:
        return self.section.jumps

    @property
    def two_sided(self) -> bool:
        return self.section.two_sided

    @property
    def center_distance(self) -> Float[Array, ""]:
        return self.section.center_distance

    def __call__(self, roll, relative):
        return self.approach(roll, relative)[:3]

    def at_distance(self, distance: Float[Array, ""]):
        return dataclasses.replace(self, section=self.section.at_distance(distance))

    def on_side(self, side: Float[Array, ""]):
        return dataclasses.replace(self, section=self.section.on_side(side))

    def approach(self, roll, relative) -> Approach:
        return self.section.approach(roll, relative)

    def point(self, roll, relative, approach: Approach) -> ContactPoint:
        return self.section.point(roll, relative, approach)

    def switches(self, roll, approach: Approach):
        return self.section.switches(roll, approach)

    def margins(self, roll, approach: Approach):
        return self.section.margins(roll, approach)


def innermost(contact: Contact) -> Contact:
    """Return the contact inside all wrappers of `contact`."""
    while isinstance(contact, WrappedContact):
        contact = contact.section
    return contact


def around(contact: Contact, inside: Contact) -> Contact:
    """Return `contact` with the contact `inside` all of its wrappers."""
    if not isinstance(contact, WrappedContact):
        return inside
    return dataclasses.replace(contact, section=around(contact.section, inside))
