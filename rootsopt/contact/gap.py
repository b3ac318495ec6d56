"""Base class of all contacts: gap and levers of two flanks at a pose.

Also finds a root of the tangential offset T, which `rootsopt.contact.closest` defines."""

import abc
import dataclasses
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.errors import InputError
from rootsopt.profiles import base as trig

if TYPE_CHECKING:
    from rootsopt.contact.closest import FlankPair

# Maximum number of Newton steps from the point of perfect rolling; two or three are usual.
_NEWTON_STEPS = 5
# Length (rad) of the last step below which Newton's method has converged. The next step would then
# be smaller than the rounding error, even across a kink of T.
_CONVERGED = 1e-8
# Length (rad) of a step below which no further step is tried. Beside a kink of T, the normal angles
# of the result err by this length.
_FINISHED = 1e-11
# Maximum number of steps inside a bracket; bisection alone needs about fifty.
_GUARDED_STEPS = 60
# Penetration (pitch radii) above which a pair of points on flanks that are not conjugate is
# ignored.
DEEPEST = 0.1
# Magnitude of T (pitch radii) below which T at a node counts as zero, because it may be a rounding
# error.
_SLACK = 1e-13


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
        return self

    @property
    def center_distance(self) -> Float[Array, ""]:
        """Distance between the rotors' axes (m).

        Raises `InputError` if the contact supports only the nominal distance."""
        raise self._lacks("another centre distance", "displaced axes need")

    def at_distance(self, distance: Float[Array, ""]) -> "Contact":
        """Return the contact of the same flanks at another centre `distance` (m).

        Raises `InputError` if the contact supports only the nominal distance."""
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
        raise self._lacks("the point of contact", "friction and supports need")

    def switches(self, roll: Float[Array, ""], approach: Approach) -> Bool[Array, " s"]:
        """Return flags (s,) that identify the smooth piece of the gap at x = `roll` (rad).

        `approach`: result of `approach` at the same pose. A flag changes wherever a derivative of
        the gap jumps."""
        return jnp.zeros(0, bool)

    def margins(self, roll: Float[Array, ""], approach: Approach) -> Float[Array, " s"]:
        """Return numbers (s,) that are positive where the flags of `switches` are set.

        By default, a number is 1 or -1. In `NearContact`, a number whose flag changes during
        contact passes smoothly through zero. `roll`, `approach`: as in `switches`."""
        return jnp.where(self.switches(roll, approach), 1.0, -1.0)

    def on_side(self, side: Float[Array, ""]) -> "Contact":
        """Return the contact for one side of the flanks; by default, this contact itself.

        `side`: 1 for the drive flanks, -1 for the coast flanks."""
        return self

    def _lacks(self, what: str, why: str) -> InputError:
        return InputError(
            f"the contact `{type(self).__name__}` does not give {what}, which {why}; use "
            "`SearchContact`, the scene's own contact, or override the method that raises this"
        )


class WrappedContact(Contact):
    """A contact that delegates to its `section`, except for what a subclass overrides."""

    section: eqx.AbstractVar[Contact]

    slices = property(attrgetter("section.slices"))
    sections = property(attrgetter("section.sections"))
    smooth = property(attrgetter("section.smooth"))
    jumps = property(attrgetter("section.jumps"))
    two_sided = property(attrgetter("section.two_sided"))
    center_distance = property(attrgetter("section.center_distance"))

    def __call__(self, roll, relative):
        return self.approach(roll, relative)[:3]

    def in_slice(self, number: Int[Array, ""]):
        return dataclasses.replace(self, section=self.section.in_slice(number))

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


class ClosestApproach(NamedTuple):
    """Result of one search.

    `gap`: gap (m), negative when the flanks penetrate.
    `lever1`, `lever2`: moment arms (m) of the common normal about rotor 1 and rotor 2, so that
    d gap = -lever1 dφ1 + lever2 dφ2.
    `normal1`, `normal2`: ν1 and ν2 (rad).
    `found`: whether a common normal was found. Otherwise, the gap is the pitch radius and the
    levers are zero. The search is skipped at poses at which the flanks cannot touch yet (see
    `contact_begins`).
    `rank`: on a wavy flank (`Profile.wavy`), number of minima of the gap at a smaller ν2; otherwise
    0. Where it changes, the contact may jump from one minimum to another.
    """

    gap: Float[Array, ""]
    lever1: Float[Array, ""]
    lever2: Float[Array, ""]
    normal1: Float[Array, ""]
    normal2: Float[Array, ""]
    found: Bool[Array, ""]
    rank: Float[Array, ""] | float = 0.0


class FlankNodes(NamedTuple):
    """Nodes at which T is sampled, with the quantities that do not depend on the pose.

    `normal` (n,): normal angles ν2 (rad) of the nodes.
    `facing` (n,): direction (rad) of the common normal at x = 0.
    `direction` (2, n): cosine and sine of `facing`.
    `turned` (2, n): cosine and sine of `Profile.turn_ratio` times `facing`.
    `lever` (n,): lever (m) of rotor 2's point.
    `support` (n,): support function (m) of rotor 2's point; `None` for conjugate flanks at the
    distance of perfect rolling, whose gap has at most two minima.
    """

    normal: Float[Array, " n"]
    facing: Float[Array, " n"]
    direction: Float[Array, "2 n"]
    turned: Float[Array, "2 n"]
    lever: Float[Array, " n"]
    support: Float[Array, " n"] | None


def _share(before, after):
    """Return the fraction of an interval at which a linear function has its zero.

    `before`, `after`: values of the function at the interval's ends."""
    fall = before - after
    return jnp.clip(before / jnp.where(fall > 0, fall, 1.0), 0.0, 1.0)


def _rotate(directions, angle):
    """Return the cosines and sines (2, n) of angles, after adding `angle` (rad) to each of them.

    `directions` (2, n): cosines and sines of the original angles."""
    cos, sin = trig.cos(angle), trig.sin(angle)
    return cos * directions[0] - sin * directions[1], cos * directions[1] + sin * directions[0]


def bracket_of(pair: "FlankPair", attempt, roll, relative):
    """Return an interval between two nodes where T falls through zero.

    `roll`, `relative`: as in `FlankPair._mesh`. On a wavy flank, attempt k takes the k-th such
    interval. For conjugate flanks, attempt 1 takes the last one and attempt 2 the first. Where
    these have more than two, and for other flanks, attempt 1 takes the interval with the least gap
    and attempt 2 that with the second least gap. The result is ((low, high), first guess, whether
    such an interval exists, whether there is at most one)."""
    profile, nodes = pair.profile, pair.nodes
    turned = _rotate(nodes.turned, 2 * profile.turn_ratio * roll)
    normal1 = nodes.facing + 2 * roll
    lever1 = profile.lever_from(normal1, turned[0], turned[1])
    cos, sin = _rotate(nodes.direction, roll - relative / 2)
    offset = pair.center_distance * sin - lever1 - nodes.lever
    # The tolerance keeps a root on a node. A compiled program may round T[i] differently as the
    # end of one interval and as the start of the next.
    slack = _SLACK * profile.pitch_radius
    falling = (offset[:-1] >= -slack) & (offset[1:] < slack)

    def outermost():
        # The maximum of integers is vectorised, an arg-minimum is not.
        place = jnp.arange(falling.shape[0])
        last = jnp.max(jnp.where(falling, place, -1))
        first = jnp.min(jnp.where(falling, place, place.shape[0]))
        index = jnp.where(last >= 0, jnp.where(attempt == 1, last, first), 0)
        return index, last >= 0, first >= last

    def deepest():
        assert nodes.support is not None
        # The derivative of the gap between parallel tangents with respect to their angle is -T.
        gap = pair.center_distance * cos - profile.support(normal1) - nodes.support
        share = _share(offset[:-1], offset[1:])
        least = gap[:-1] - jnp.diff(nodes.facing) * share * offset[:-1] / 2
        # A pair this deep belongs to the other flank of the lobe.
        near = falling & (least > -DEEPEST * profile.pitch_radius)
        least = jnp.where(near, least, jnp.inf)
        first = jnp.argmin(least)
        index = jnp.where(attempt == 1, first, jnp.argmin(least.at[first].set(jnp.inf)))
        return index, jnp.any(near), jnp.sum(near) < 2

    if profile.wavy:
        number = jnp.cumsum(falling)
        index = jnp.argmax(falling & (number == attempt))
        present, single = number[-1] >= attempt, number[-1] <= attempt
    elif nodes.support is None:
        index, present, single = outermost()
    elif profile.conjugate:  # Gaps at all nodes take as long as all else.
        index, present, single = lax.cond(jnp.sum(falling) > 2, deepest, outermost)
    else:
        index, present, single = deepest()
    low, high = nodes.normal[index], nodes.normal[index + 1]
    share = _share(offset[index], offset[index + 1])
    return (low, high), low + (high - low) * share, present, single


def root_in(pair: "FlankPair", bracket, guess, guarded, roll, relative):
    """Return ((G, ν1, q1, q2, ν2) at a root of T, whether Newton's method from `guess` has
    converged to it).

    `bracket`: (low, high) (rad); `roll`, `relative`: as in `FlankPair._mesh`.
    `guarded`: whether T falls through zero in the bracket. The bracket then shrinks around the
    root, and is halved if Newton's step leaves it or is longer than half the previous step. Halving
    is needed because T has a kink where ν1 crosses a segment's end. G, ν1 and the levers follow
    from values and slopes before the last step; the error is of second order in this step.
    """
    limit = jnp.where(guarded, _GUARDED_STEPS, _NEWTON_STEPS)

    def go_on(carry):
        count, step = carry[:2]
        return (count < limit) & (jnp.abs(step) >= _FINISHED)

    def newton(carry):
        count, before, _, (low, high), root = carry
        normal2 = root[-1]
        (value, *here), (slope, *turned) = jax.jvp(
            lambda nu: pair._mesh(nu, roll, relative), (normal2,), (jnp.ones_like(normal2),)
        )
        step = value / jnp.where(slope < 0, slope, -jnp.inf)
        left = guarded & (value >= 0)
        low, high = jnp.where(left, normal2, low), jnp.where(guarded & ~left, normal2, high)
        new = normal2 - step
        slow = (slope >= 0) | (jnp.abs(step) > 0.5 * jnp.abs(before))
        # The root may lie on an end of the bracket. A compiled program may round the step
        # differently for each result. All results must agree on whether to halve.
        halve = guarded & (slow | (new < low - _FINISHED) | (new > high + _FINISHED))
        new = jnp.where(halve, (low + high) / 2, jnp.clip(new, low, high))
        step = jnp.where(halve, (high - low) / 2, step)
        # The gap is stationary at the root: its mean slope is half of that before the step.
        moves = (new - normal2) * jnp.array([0.5, 1, 1, 1], new.dtype)
        after = [x + move * by for x, move, by in zip(here, moves, turned, strict=True)]
        return count + 1, step, slope, (low, high), (*after, new)

    nothing = jnp.zeros_like(guess)
    root = *[nothing] * 4, guess
    start = 0, jnp.full_like(guess, jnp.inf), nothing, bracket, root
    _, step, slope, (low, high), root = lax.while_loop(go_on, newton, start)
    inside = (root[-1] > low) & (root[-1] < high) & (slope < 0)
    return root, inside & (jnp.abs(step) < _CONVERGED)
