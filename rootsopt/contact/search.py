"""Contact found by a search for the closest approach at every call: the reference fidelity."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.contact.closest import FlankPair
from rootsopt.contact.gap import Approach, Contact
from rootsopt.contact.point import ContactPoint, contact_point
from rootsopt.profiles.base import Profile


class SearchContact(Contact):
    """Gap and levers of a flank pair, from a search for the closest approach at every call.

    `pair`: the flanks; `sides`: 1, or 2 if the search also covers flanks turned away from each
    other.
    """

    pair: FlankPair
    sides: int = eqx.field(static=True, default=1)

    @classmethod
    def of(
        cls,
        profile: Profile,
        center_distance: Float[Array, ""] | None = None,
        two_sided: bool = False,
    ) -> "SearchContact":
        """Return the contact of `profile`.

        `center_distance` (m), `two_sided`: as in `FlankPair.of`."""
        return cls(FlankPair.of(profile, center_distance, two_sided), 1 + two_sided)

    @property
    def jumps(self) -> bool:
        """Whether levers may jump where two minima of the gap are equally deep."""
        return self.pair.jumps

    @property
    def two_sided(self) -> bool:
        return self.sides == 2

    @property
    def length_scale(self) -> Float[Array, ""]:
        return self.pair.center_distance / 2

    @property
    def center_distance(self) -> Float[Array, ""]:
        return jnp.asarray(self.pair.center_distance)

    def __call__(self, roll, relative):
        return self.approach(roll, relative)[:3]

    def at_distance(self, distance: Float[Array, ""]) -> "SearchContact":
        return eqx.tree_at(lambda contact: contact.pair.center_distance, self, distance)

    def approach(self, roll, relative) -> Approach:
        found = self.pair(roll, relative)
        return Approach(found.gap, found.lever1, found.lever2, found)

    def point(self, roll, relative, approach: Approach) -> ContactPoint:
        return contact_point(self.pair, roll, relative, approach.place)

    def switches(self, roll, approach: Approach):
        return self.pair.switches(roll, approach.place)

    def margins(self, roll, approach: Approach):
        return self.pair.margins(roll, approach.place)
