"""Base class of contacts that change another one."""

import dataclasses

import equinox as eqx
from jaxtyping import Array, Float, Int

from rootsopt.contact.gap import Approach, Contact, Slices
from rootsopt.contact.point import ContactPoint


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
    def length_scale(self) -> Float[Array, ""] | None:
        return self.section.length_scale

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
