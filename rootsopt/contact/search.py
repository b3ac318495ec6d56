"""Contacts of a flank pair: found by a search at every call, or near a known closest approach."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rootsopt.contact.closest import BEYOND, FlankPair, contact_begins
from rootsopt.contact.gap import Approach, ClosestApproach, Contact, ContactPoint
from rootsopt.profiles import base as trig
from rootsopt.profiles.base import Profile
from rootsopt.runtime.compute_once import compute_once_along


def contact_point(
    pair: FlankPair, roll: Float[Array, ""], relative: Float[Array, ""], closest: ClosestApproach
) -> ContactPoint:
    """Return position and direction of a contact, given the `closest` approach.

    `pair`: the flanks; `roll`, `relative`: x and ε (rad) at which `closest` was computed."""
    folded, mirrored = pair.folded(roll)
    mate = pair.profile.mate(closest.normal2)
    direction = mate.facing + folded - relative / 2
    support = pair.profile.support(closest.normal1)
    return ContactPoint(
        support1=jnp.where(mirrored, mate.support, support),
        support2=jnp.where(mirrored, support, mate.support),
        radial=trig.cos(direction),
    )


class _FlankContact(Contact):
    """Base class of the contacts of a flank pair."""

    pair: eqx.AbstractVar[FlankPair]

    @property
    def jumps(self) -> bool:
        """Whether levers may jump where two minima of the gap are equally deep."""
        return self.pair.jumps

    @property
    def center_distance(self) -> Float[Array, ""]:
        return jnp.asarray(self.pair.center_distance)

    def __call__(self, roll, relative):
        return self.approach(roll, relative)[:3]

    def switches(self, roll, approach: Approach):
        return self.margins(roll, approach) > 0

    def at_distance(self, distance: Float[Array, ""]):
        return eqx.tree_at(lambda contact: contact.pair.center_distance, self, distance)


class SearchContact(_FlankContact):
    """Gap and levers of a flank pair, from a search for the closest approach at every call.

    `pair`: the flanks; `two_sided`: whether the search also covers flanks turned away from each
    other.
    """

    pair: FlankPair
    two_sided: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(
        cls,
        profile: Profile,
        center_distance: Float[Array, ""] | None = None,
        two_sided: bool = False,
    ) -> "SearchContact":
        """Return the contact of `profile`.

        `center_distance` (m), `two_sided`: as in `FlankPair.of`."""
        return cls(FlankPair.of(profile, center_distance, two_sided), two_sided)

    def approach(self, roll, relative) -> Approach:
        closest = self.pair(roll, relative)
        return Approach(closest.gap, closest.lever1, closest.lever2, closest)

    def point(self, roll, relative, approach: Approach) -> ContactPoint:
        return contact_point(self.pair, roll, relative, approach.place)

    def margins(self, roll, approach: Approach):
        return self.pair.margins(roll, approach.place)


# Magnitude of the Newton step (rad) above which the flanks count as having no common normal.
_FARTHEST = 0.06
# Distance (rad) from a given root at which the offset is linearised. An event may lie exactly where
# a segment ends. Automatic differentiation would give a mixture of both slopes there.
_ASIDE = 1e-12


class NearContact(_FlankContact):
    """Gap and levers from one Newton step, next to a closest approach that is already known.

    `pair`: the flanks; `roots` (sides, 2): normal angles ν2 (rad) near the closest approach and
    near the minimum of the gap to which the contact jumps, if it does. If both drive and coast
    flanks can touch, each has a row; otherwise there is one row. For twisted rotors, there is a
    leading axis for the slices (see `in_slice`).

    The tangential offset T of `closest` is linearised at the given root. The error of ν2 is
    therefore of second order in the distance from this root. Repeated evaluations, each from the
    normal angles that the previous one returned in `Approach.place`, converge like Newton's method.
    Derivatives follow the root (implicit function theorem).
    """

    pair: FlankPair
    roots: Float[Array, "*slices sides 2"]

    @property
    def two_sided(self) -> bool:
        return True

    def in_slice(self, number: Int[Array, ""]) -> "NearContact":
        return eqx.tree_at(lambda contact: contact.roots, self, self.roots[number])

    def on_side(self, side: Float[Array, ""]) -> "NearContact":
        if self.roots.shape[0] == 1:
            return self
        own = jnp.where(side > 0, self.roots[:1], self.roots[1:])
        return eqx.tree_at(lambda contact: contact.roots, self, own)

    def approach(self, roll, relative) -> Approach:
        closest, rival = self._moved(0, roll, relative), None
        if self.jumps:
            rival = self._moved(1, roll, relative)
        return Approach(closest.gap, closest.lever1, closest.lever2, (closest, rival))

    def point(self, roll, relative, approach: Approach) -> ContactPoint:
        return contact_point(self.pair, roll, relative, approach.place[0])

    def margins(self, roll, approach: Approach) -> Float[Array, " s"]:
        closest, rival = approach.place
        return self.pair.margins(roll, closest, None if rival is None else rival.gap)

    def _moved(self, which: int, roll, relative) -> ClosestApproach:
        """Return the closest approach after one Newton step from the root with index `which`.

        `roll`, `relative`: x and ε (rad)."""
        pair = self.pair
        root = lax.stop_gradient(self.roots[0, which]) + _ASIDE
        folded, mirrored = pair.folded(roll)
        with trig.computed_once():
            here, turned = jax.jvp(
                lambda normal: pair._mesh(normal, folded, relative), (root,), (jnp.ones_like(root),)
            )
        turned = lax.stop_gradient(turned)
        offset, gap, normal1, lever1, lever2 = here
        falls = turned[0] < 0
        step = jnp.where(falls, -offset / jnp.where(falls, turned[0], -1.0), 0.0)
        low, high = pair.nodes.normal[0] - BEYOND, pair.nodes.normal[-1] + BEYOND
        present = falls & (jnp.abs(step) < _FARTHEST) & (root > low) & (root < high)
        present &= folded >= contact_begins(relative)
        step = jnp.clip(step, -_FARTHEST, _FARTHEST)
        if not pair.rolling:  # Roots beyond the lobe's axis belong to the other flank, and stay.
            step = jnp.where(root > low, step, 0.0)
        # The gap is stationary at the root: half a step's slope is its mean over the step.
        gap = gap + turned[1] * step / 2
        lever1, lever2 = lever1 + turned[3] * step, lever2 + turned[4] * step
        first, second = (
            jnp.where(mirrored, lever2, lever1),
            jnp.where(mirrored, lever1, lever2),
        )
        away = lax.stop_gradient(pair.profile.pitch_radius)
        numbers = (
            jnp.where(present, gap, away),
            jnp.where(present, first, 0.0),
            jnp.where(present, second, 0.0),
            normal1 + turned[2] * step,
            root + step,
        )
        return ClosestApproach(*compute_once_along(numbers), found=present)
