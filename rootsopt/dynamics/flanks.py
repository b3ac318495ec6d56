"""The flanks of a rotor pair at one instant: where they touch, with what force, and how far they
are from a change of contact.

`RotorPair` passes itself to the functions of this module, together with position and velocity
(`Motion`). They add no state of their own."""

import functools
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.gap import Approach, ContactPoint
from rootsopt.dynamics.parts.base import Motion

if TYPE_CHECKING:
    from rootsopt.dynamics.pair import RotorPair


class FlankForce(NamedTuple):
    """Contact of the flanks at one or several instants.

    `drive`, `coast`: normal force (N) on each flank; `depth`: greatest penetration (m; negative:
    gap); `lever2`: lever (m) of rotor 2 at the deeper flank; `torque1`, `torque2`: contact torques
    (N·m) on the rotors, each positive in its rotor's sense of rotation; `push`: contact force (N)
    on rotor 2 in x and y, None if no part lets the axes move. The force on rotor 1 is equal and
    opposite.

    For twisted rotors, forces, torques and `push` are sums over the slices, and the lever is a
    mean."""

    drive: Float[Array, "*n"]
    coast: Float[Array, "*n"]
    depth: Float[Array, "*n"]
    lever2: Float[Array, "*n"]
    torque1: Float[Array, "*n"]
    torque2: Float[Array, "*n"]
    push: Float[Array, "*n 2"] | None = None

    @property
    def total(self) -> Float[Array, "*n"]:
        """Sum of the magnitudes of the normal forces (N)."""
        return self.drive + self.coast


class Sliding(NamedTuple):
    """Data of a contact that only friction and supports need.

    `point`: position of the contact; `speed` (m/s) at which rotor 1 slides on rotor 2; `normal` and
    `tangent`: unit vectors (x, y), None if no part lets the axes move."""

    point: ContactPoint
    speed: Float[Array, ""]
    normal: Float[Array, "2"] | None = None
    tangent: Float[Array, "2"] | None = None


class Touch(NamedTuple):
    """The flanks of one side (drive or coast) at given angles of the rotors and positions of their
    axes.

    `depth`: penetration (m); `closing`: rate of `depth` (m/s); `roll`: roll coordinate (rad);
    `approach`: gap and levers from the contact; `sliding`: data of the contact point, None if no
    part needs them."""

    depth: Float[Array, ""]
    closing: Float[Array, ""]
    roll: Float[Array, ""]
    approach: Approach
    sliding: Sliding | None


class Pushes(NamedTuple):
    """Contact forces of every slice (one for straight rotors) and side that can touch.

    `force` (slices, sides, x and y): on rotor 2 (N), friction included; on rotor 1 it is the
    opposite. `place` (slices, sides, x and y): of the contact, from the axis of rotor 1 (m).
    `torque` (slices, sides, rotor): of the normal force, in the rotor's sense of rotation (N·m)."""

    force: Float[Array, "slices sides xy"]
    place: Float[Array, "slices sides xy"]
    torque: Float[Array, "slices sides rotor"]


class Margins(NamedTuple):
    """Distances of a motion from the instants at which the equation is not smooth.

    `values` (s,): one *margin* for each flag of `RotorPair.switches`, positive where the flag is
    set. With a `NearContact`, each margin is zero at the instant at which its flag changes, and
    smooth around this instant. `counts` (s,): whether each flag matters. The flags of a flank
    matter where the flank transmits a force. A flag without a margin has the margin 1 or -1 (see
    `margins_of`). `places`: `Approach.place` with a leading axis for the flanks that can touch (see
    `RotorPair.flanks`). `pushes` (flanks,): whether these flanks transmit a force."""

    values: Float[Array, " s"]
    counts: Bool[Array, " s"]
    places: Any
    pushes: Bool[Array, " flanks"]


def touches_of(pair: "RotorPair", motion: Motion) -> tuple[Float[Array, "*sides"], Touch]:
    """Return the side of each flank that can touch at a `motion` (1 drive, -1 coast), and its
    `Touch`.

    A pair that is not two-sided has the nominal centre distance and no negative clearance. Then
    only the drive flank can touch when ε < 0, and only the coast flank when ε > 0. One search
    for the gap is therefore enough. Otherwise, both results have a leading axis for the sides.
    With twisted rotors, an axis for the slices stands before it."""
    return by_slice(pair, _section_touches, motion)


def _section_touches(pair: "RotorPair", motion: Motion) -> tuple[Float[Array, "*sides"], Touch]:
    """Return the result of `touches_of` for one section of the rotors."""
    if pair.two_sided:
        sides = jnp.asarray([1.0, -1.0], pair.angle_scale.dtype)
        return sides, jax.vmap(functools.partial(touch_of, pair), (0, None))(sides, motion)
    side = jnp.where(motion.relative < 0, jnp.ones_like(motion.relative), -1.0)
    return side, touch_of(pair, side, motion)


def force_of(pair: "RotorPair", motion: Motion, touches: Any = None) -> FlankForce:
    """Return the contact of the flanks at the position and velocity `motion`.

    `touches`: result of `touches_of` at this motion, if known."""
    touches = touches_of(pair, motion) if touches is None else touches
    slices = pair.contact.slices
    if slices is None:
        return _section_force(pair, motion, *touches)
    contacts = jax.vmap(functools.partial(_section_force, pair), (None, 0, 0))(motion, *touches)
    whole = jax.tree.map(lambda x: jnp.tensordot(slices.weights, x, 1), contacts)
    return whole._replace(depth=jnp.max(contacts.depth))


def _section_force(pair: "RotorPair", motion: Motion, side: Float[Array, "*sides"], touch: Touch):
    """Return the `FlankForce` of rotors that are this section over their whole length.

    `side`, `touch`: result of `_section_touches`."""
    if pair.two_sided:
        flanks = jax.vmap(functools.partial(_flank_force, pair), (0, None, 0))(side, motion, touch)
        drive, coast = flanks.drive
        summed = jax.tree.map(lambda x: jnp.sum(x, axis=0), flanks)
        deeper = jnp.argmax(flanks.depth)
        return summed._replace(
            drive=drive,
            coast=coast,
            depth=flanks.depth[deeper],
            lever2=flanks.lever2[deeper],
        )
    drives = motion.relative < 0
    flank = _flank_force(pair, side, motion, touch)
    return flank._replace(
        drive=jnp.where(drives, flank.drive, 0.0), coast=jnp.where(drives, 0.0, flank.drive)
    )


def _flank_force(
    pair: "RotorPair", side: Float[Array, ""], motion: Motion, touch: Touch
) -> FlankForce:
    """Return the contact on one side (1 drive, -1 coast) at the position and velocity `motion`.

    `touch`: the flanks of this side. The field `drive` of the result holds the normal force on
    either side; `coast` is zero."""
    force = pair.law(touch.depth, touch.closing)
    lever1, lever2 = touch.approach.lever1, touch.approach.lever2
    forward, sliding = side * force, touch.sliding
    torque1, torque2 = -lever1 * forward, lever2 * forward
    push = None
    if sliding is not None:
        if sliding.normal is not None:
            push = force * sliding.normal
        drag = sum_of(part.drag(force, sliding.speed) for part in pair.all_parts if part.rubs)
        if drag is not None:
            torque1 -= side * drag * sliding.point.support1
            torque2 += side * drag * sliding.point.support2
            if push is not None and sliding.tangent is not None:
                push += drag * sliding.tangent
    return FlankForce(
        drive=force,
        coast=jnp.zeros_like(force),
        depth=touch.depth,
        lever2=lever2,
        torque1=torque1,
        torque2=torque2,
        push=push,
    )


def touch_of(
    pair: "RotorPair", side: Float[Array, ""], motion: Motion, located: bool = False
) -> Touch:
    """Return the geometry of the flanks of one side (1 drive, -1 coast) at a `motion`.

    `located`: whether to give the direction of the force even if no part needs it.

    Let n be the drive side's normal from rotor 1 to rotor 2, and t the tangent: n turned by
    +90°. Rotor 1 slides along rotor 2 at the speed ω1 h1 - ω2 h2 + (v1 - v2)·t. The coast side
    is the mirror image. Let θ be the angle of the displaced line of centres. A pair with
    displaced axes is equivalent to a pair at another centre distance with the angles φ1 - θ and
    φ2 + θ."""
    contact, line, relative = pair.contact.on_side(side), None, motion.relative
    if motion.shift is not None:
        x, y = motion.shift[1] - motion.shift[0]
        line = jnp.stack([contact.center_distance + x, y])
        relative = relative + 2 * jnp.arctan2(y, line[0])
        contact = contact.at_distance(jnp.hypot(*line))
    elif located:
        line = jnp.stack([contact.center_distance, jnp.zeros_like(contact.center_distance)])
    roll, swung = -side * (motion.phi + motion.relative / 2), side * relative
    approach = contact.approach(roll, swung)
    gap, lever1, lever2 = approach[:3]
    other = motion.speed + motion.rate
    closing = side * (lever1 * motion.speed - lever2 * other)
    sliding = None
    if line is not None or any(part.rubs for part in pair.all_parts):
        point = contact.point(roll, swung, approach)
        speed = side * (motion.speed * point.support1 - other * point.support2)
        sliding = Sliding(point, speed)
        if line is not None:
            distance = contact.center_distance
            cos, sin = line / distance
            along, across = point.radial, side * (lever1 + lever2) / distance
            normal = jnp.stack([cos * along - sin * across, sin * along + cos * across])
            tangent = side * jnp.stack([-normal[1], normal[0]])
            if motion.drift is not None:
                approaching = motion.drift[0] - motion.drift[1]
                closing += jnp.dot(approaching, normal)
                speed += jnp.dot(approaching, tangent)
            sliding = Sliding(point, speed, normal, tangent)
    return Touch(-gap - pair.clearance, closing, roll, approach, sliding)


def kink_margins(pair: "RotorPair", motion: Motion, acting, touches: Any) -> Margins:
    """Return the `Margins` at a `motion`.

    `acting`: list of (part, its own states in SI units); `touches`: result of `touches_of`."""

    def of_flank(contact, side, touch):
        margins = [
            margins_of(pair.law, touch.depth, touch.closing),
            margins_of(contact.on_side(side), touch.roll, touch.approach),
        ]
        if touch.sliding is not None:
            speed = touch.sliding.speed
            rubbing = (part for part in pair.all_parts if part.rubs)
            margins += [margins_of(part, speed, flags="drag_switches") for part in rubbing]
        values = jnp.concatenate(margins)
        return values, pair.law(touch.depth, touch.closing) > 0, touch.approach.place

    def of_section(section, motion, side, touch):
        if pair.two_sided:
            return jax.vmap(functools.partial(of_flank, section.contact))(side, touch)
        margins = of_flank(section.contact, side, touch)
        return jax.tree.map(lambda x: jnp.expand_dims(x, 0), margins)

    margins = by_slice(pair, of_section, motion, *touches)
    if pair.contact.slices is not None:
        margins = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), margins)
    values, pushes, places = margins
    counts, values = jnp.repeat(pushes, values.shape[1]), [values.ravel()]
    if not pair.two_sided:
        values, counts = [*values, -motion.relative[None]], jnp.append(counts, jnp.any(pushes))
    values += [margins_of(part, motion, own) for part, own in acting]
    every = jnp.concatenate(values)
    counts = jnp.pad(counts, (0, every.size - counts.size), constant_values=True)
    return Margins(every, counts, places, pushes)


def margins_of(owner: Any, *at: Any, flags: str = "switches") -> Float[Array, " s"]:
    """Return the margins of a contact law, contact or part: 1 or -1 if it only has flags.

    `at`: arguments of its method `flags`, which returns the flags."""
    if has_margins(type(owner), flags):
        return getattr(owner, _MARGINS[flags])(*at)
    return jnp.where(getattr(owner, flags)(*at), 1.0, -1.0)


@functools.cache
def has_margins(kind: type, flags: str = "switches") -> bool:
    """Return whether a contact law, contact or part of the class `kind` has a margin for each flag.

    It does if the margins are defined in the same class as the method `flags`, or in a subclass of
    that class."""
    order = list(kind.__mro__)
    places = [
        next(k for k, base in enumerate(order) if name in vars(base))
        for name in (_MARGINS[flags], flags)
    ]
    return places[0] <= places[1]


# Methods that return margins, keyed by those that return flags.
_MARGINS = {"switches": "margins", "drag_switches": "drag_margins"}


def pushes_of(pair: "RotorPair", motion: Motion) -> Pushes:
    """Return the `Pushes` of the flanks at the position and velocity `motion`.

    Raises `InputError` if the contact does not give the point of contact."""

    def of_flank(side, motion):
        touch = touch_of(pair, side, motion, located=True)
        forces = _flank_force(pair, side, motion, touch)
        sliding = touch.sliding
        assert sliding is not None
        assert sliding.normal is not None
        assert forces.push is not None
        x, y = sliding.normal
        aside = side * touch.approach.lever1 * jnp.stack([-y, x])
        place = sliding.point.support1 * sliding.normal - aside
        levers = jnp.stack([-touch.approach.lever1, touch.approach.lever2])
        return Pushes(forces.push, place, side * forces.drive * levers)

    def of_section(_, motion):
        sides = jnp.asarray([1.0, -1.0], pair.angle_scale.dtype)
        if not pair.two_sided:
            sides = jnp.where(motion.relative < 0, sides[:1], sides[1:])
        return jax.vmap(of_flank, (0, None))(sides, motion)

    forces, slices = by_slice(pair, of_section, motion), pair.contact.slices
    if slices is None:
        return jax.tree.map(lambda x: x[None], forces)
    weights = slices.weights[:, None, None]
    return Pushes(weights * forces.force, forces.place, weights * forces.torque)


def by_slice(pair: "RotorPair", of_section: Callable[..., Any], motion: Motion, *more: Any) -> Any:
    """Return `of_section(pair, motion, *more)` for every slice of twisted rotors.

    The pair's contact is then that of the slice, and `motion` that of the slice's section; `more`:
    arrays with a leading axis for the slices, which the result has as well. For straight rotors,
    the only section is the pair itself, and there is no such axis."""
    slices = pair.contact.slices
    if slices is None:
        return of_section(pair, motion, *more)

    def of_slice(number, by, *more):
        contact = pair.contact.in_slice(number)
        own = eqx.tree_at(lambda p: p.contact, pair, contact)
        return of_section(own, motion._replace(phi=motion.phi + by), *more)

    return jax.vmap(of_slice)(jnp.arange(slices.offsets.shape[0]), slices.offsets, *more)


def sum_of(terms: Iterable[Array | None]) -> Array | None:
    """Return the sum of the terms that are not None; None if there are none."""
    total = None
    for term in terms:
        if term is not None:
            total = term if total is None else total + term
    return total
