"""The rotor pair as an ordinary differential equation.

The simplest scene has two states: ε = φ2 - φ1 and its rate. A part that sets rotor 1 free adds the
speed of rotor 1 as a third state. Every part appends its own states, in the order of the parts.

The independent variable τ is the rotation of rotor 1 in mesh periods (lobe pitches), so the
equation is periodic even if the speed varies. ε is measured in units of `angle_scale`, so that the
solver works with numbers of order one.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.contact.gap import Approach, Contact
from rootsopt.contact.impact import force_rounding
from rootsopt.contact.law import ContactLaw
from rootsopt.contact.point import ContactPoint
from rootsopt.dynamics.parts import (
    Drive,
    Friction,
    Load,
    Loads,
    Motion,
    Part,
    Supports,
    TimingGear,
    Units,
)
from rootsopt.dynamics.timescales import Timescales
from rootsopt.errors import InputError

STALLED = 0.05
"""Speed of rotor 1, as a fraction of the drive's speed, below which the motor counts as stalled."""


class FlankForce(NamedTuple):
    """Contact of the flanks at one or several instants.

    `drive`, `coast`: normal force (N) on each flank; `depth`: greatest penetration (m; negative:
    gap); `closing`: rate of `depth` (m/s); `lever1`, `lever2`: levers (m) of the deeper flank;
    `torque1`, `torque2`: contact torques (N·m) on the rotors, each positive in its rotor's sense of
    rotation; `push`: contact force (N) on rotor 2 in x and y, None if no part lets the axes move.
    The force on rotor 1 is equal and opposite. `edges`: distance (rad) of the pose from the jumps
    of the gap (see `Edges`) and its rate (rad/s), None for a contact whose gap is continuous.

    For twisted rotors, forces, torques and `push` are sums over the slices, and the levers are
    means. `edges` then holds the mean of the slices' edges, or of their penetrations (m) and rates
    (m/s). A jump in one slice is a kink of this mean."""

    drive: Float[Array, "*n"]
    coast: Float[Array, "*n"]
    depth: Float[Array, "*n"]
    closing: Float[Array, "*n"]
    lever1: Float[Array, "*n"]
    lever2: Float[Array, "*n"]
    torque1: Float[Array, "*n"]
    torque2: Float[Array, "*n"]
    push: Float[Array, "*n 2"] | None = None
    edges: Float[Array, "*n 2"] | None = None

    @property
    def total(self) -> Float[Array, "*n"]:
        """Sum of the magnitudes of the normal forces (N)."""
        return self.drive + self.coast


class _Sliding(NamedTuple):
    """Data of a contact that only friction and supports need.

    `point`: position of the contact; `speed` (m/s) at which rotor 1 slides on rotor 2; `normal` and
    `tangent`: unit vectors (x, y), None if no part lets the axes move.
    """

    point: ContactPoint
    speed: Float[Array, ""]
    normal: Float[Array, "2"] | None = None
    tangent: Float[Array, "2"] | None = None


class _Touch(NamedTuple):
    """The flanks of one side (drive or coast) at given angles of the rotors and positions of their
    axes.

    `depth`: penetration (m); `closing`: rate of `depth` (m/s); `roll`: roll coordinate (rad);
    `approach`: gap and levers from the contact; `sliding`: data of the contact point, None if no
    part needs them.
    """

    depth: Float[Array, ""]
    closing: Float[Array, ""]
    roll: Float[Array, ""]
    approach: Approach
    sliding: _Sliding | None


class Pushes(NamedTuple):
    """Contact forces of every slice (one for straight rotors) and side that can touch.

    `force` (slices, sides, x and y): on rotor 2 (N), friction included; on rotor 1 it is the
    opposite. `place` (slices, sides, x and y): of the contact, from the axis of rotor 1 (m).
    `torque` (slices, sides, rotor): of the normal force, in the rotor's sense of rotation (N·m).
    """

    force: Float[Array, "slices sides xy"]
    place: Float[Array, "slices sides xy"]
    torque: Float[Array, "slices sides rotor"]


class Margins(NamedTuple):
    """Distances of a motion from the instants at which the equation is not smooth.

    `values` (s,): one *margin* for each flag of `RotorPair.switches`, positive where the flag is
    set. With a `NearContact`, each margin is zero at the instant at which its flag changes, and
    smooth around this instant. `counts` (s,): whether each flag matters. The flags of a flank
    matter where the flank transmits a force. `places`: `Approach.place` of each flank that can
    touch (two if drive and coast flanks both can). `pushes` (sides,): whether these flanks transmit
    a force."""

    values: Float[Array, " s"]
    counts: Bool[Array, " s"]
    places: list[Any]
    pushes: Bool[Array, " sides"]


class RotorPair(eqx.Module):
    """Two identical rotors in mesh, rotor 1 driven, rotor 2 loaded.

    `lobes`: number per rotor; `contact`: gap and levers at a pose; `law`: contact force law;
    `clearance` (m) added to every flank gap; `inertia` of one rotor (kg·m²); `drive`, `load`,
    `gear`, `friction`, `supports`: parts that the scene names; `angle_scale` (rad) and
    `force_scale` (N): the solver's units; `timescales` of oscillation and free flight, None if
    unknown; `two_sided`: whether drive and coast flanks can touch at once (at the nominal centre
    distance, only with negative clearance); `parts`: all other parts. An absent part is None and
    costs nothing.

    Raises InputError if two parts let the axes move; if one part does but `two_sided` is False; if
    the pair is two-sided but the contact is not (see `Contact.two_sided`).
    """

    lobes: int = eqx.field(static=True)
    contact: Contact
    law: ContactLaw
    clearance: Float[Array, ""]
    inertia: Float[Array, ""]
    drive: Drive
    load: Load
    gear: TimingGear | None
    angle_scale: Float[Array, ""]
    force_scale: Float[Array, ""]
    friction: Friction | None = None
    supports: Supports | None = None
    timescales: Timescales | None = None
    two_sided: bool = eqx.field(static=True, default=False)
    parts: tuple[Part, ...] = ()

    def __check_init__(self):
        displacing = [type(part).__name__ for part in self.all_parts if part.displaces]
        if len(displacing) > 1:
            raise InputError(
                f"one part of a scene can let the axes move, but {' and '.join(displacing)} both "
                "do; leave one of them out"
            )
        if displacing and not self.two_sided:
            raise InputError(
                f"the part `{displacing[0]}` lets the axes move, so that both flanks can touch at "
                "once, but the pair has `two_sided` = False; set it to True"
            )
        if self.two_sided and not self.contact.two_sided:
            raise InputError(
                "drive and coast flanks of this scene can touch at once, but the contact "
                f"`{type(self.contact).__name__}` is right for one of them at a time; use "
                "`SearchContact` (`solver.fidelity` = search)"
            )

    @property
    def all_parts(self) -> tuple[Part, ...]:
        """Every part of the scene, in the order of their states."""
        named = self.drive, self.load, self.gear, self.friction, self.supports
        return (*(part for part in named if part is not None), *self.parts)

    @property
    def free(self) -> bool:
        """Whether the speed of rotor 1 is a state of the motion."""
        return any(part.free for part in self.all_parts)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, with the units they have before scaling."""
        first = ("relative rotation (rad)", "relative speed (rad/s)")
        speed = ("excess of the speed of rotor 1 over the drive's (rad/s)",) * self.free
        return (*first, *speed, *(name for part in self.all_parts for name in part.states))

    @property
    def states(self) -> int:
        """Number of states: ε, its rate, the speed of a free rotor 1, and the parts' own states."""
        return 2 + self.free + sum(len(part.states) for part in self.all_parts)

    @property
    def mesh_period(self) -> Float[Array, ""]:
        """Duration of one lobe pitch (s) at the drive's speed."""
        return 2 * jnp.pi / (self.lobes * self.drive.speed)

    @property
    def angle_limit(self) -> float:
        """|ε| (rad) above which the lobes count as having passed through each other.

        It is a quarter of the angle from a lobe's axis to its flank at the pitch circle.
        """
        return jnp.pi / (8 * self.lobes)

    @property
    def smooth(self) -> bool:
        """Whether the equation is smooth as long as no flag of `switches` changes."""
        return self.contact.smooth

    @property
    def jumps(self) -> bool:
        """Whether the contact force may jump (see `Contact.jumps`)."""
        return self.contact.jumps

    def rounding(self, depth: Float[Array, ""]) -> Float[Array, ""]:
        """Return the relative error of the force, due to rounding of the gap, at a `depth` (m).

        It is 0 if the contact has no `length_scale`."""
        length = self.contact.length_scale
        if length is None:
            return jnp.zeros_like(depth)
        return force_rounding(depth, self.law.exponent, length)

    def at_start(self, first: Float[np.ndarray, "*k 2"]) -> Float[np.ndarray, "*k n"]:
        """Return scaled states (…, n) for the start of a motion, from ε and dε/dt.

        `first` (…, 2): ε and dε/dt, scaled. All other states have their starting values, which are
        0 in scaled form.
        """
        return np.pad(first, [(0, 0)] * (first.ndim - 1) + [(0, self.states - 2)])

    def speed(self, state: Float[Array, "*k n"]) -> Float[Array, "*#k"]:
        """Return the angular speed of rotor 1 (rad/s) in a scaled `state`."""
        if not self.free:
            return self.drive.speed
        return self.drive.speed + self.angle_scale / self.mesh_period * state[..., 2]

    def lapse(self, state: Float[Array, "*k n"]) -> Float[Array, "*#k"]:
        """Return the duration of a mesh period at the present speed, relative to `mesh_period`.

        The speed follows from the scaled `state`. It is taken as at least half of `STALLED` times
        the drive's speed, so that the duration stays finite.
        """
        creep = STALLED / 2 * self.drive.speed
        return self.drive.speed / jnp.maximum(self.speed(state), creep)

    @property
    def _units(self) -> Units:
        return Units(self.angle_scale, self.mesh_period)

    def own_states(self, state: Float[Array, "*k n"]) -> list[Float[Array | np.ndarray, "*k _"]]:
        """Return a list of the parts' own states (SI units), in the order of `all_parts`, from the
        scaled `state` of the pair."""
        found, place = [], 2 + self.free
        for part in self.all_parts:
            count = len(part.states)
            # A part without states adds nothing to the traced program: NumPy, not JAX.
            own = np.zeros((*state.shape[:-1], 0), state.dtype)
            if count:
                own = part.scales(self._units) * state[..., place : place + count]
                start = part.start(self._units)
                own = own if start is None else start + own
            found.append(own)
            place += count
        return found

    def motion(self, tau: Float[Array, "*k"], state: Float[Array, "*k n"]) -> Motion:
        """Return position and velocity (SI units) at rotation `tau` (mesh periods) and scaled
        `state`, in the pair's precision."""
        return self._moving(tau, state)[0]

    def _moving(self, tau, state):
        """Return the `motion`, and a list of (part, its own states in SI units)."""
        tau, state = (jnp.asarray(x, self.angle_scale.dtype) for x in (tau, state))
        relative = self.angle_scale * state[..., 0]
        rate = self.angle_scale * state[..., 1] / self.mesh_period
        motion = Motion(2 * jnp.pi / self.lobes * tau, relative, rate, self.speed(state))
        acting = list(zip(self.all_parts, self.own_states(state), strict=True))
        for part, own in acting:
            if part.displaces:
                shift, drift = part.axes(own)
                motion = motion._replace(shift=shift, drift=drift)
        return motion, acting

    def in_si(self, state: Float[Array, " n"]) -> Float[Array, " n"]:
        """Convert a scaled `state` (n,) to the units of `state_names`."""
        angle, period = self.angle_scale, self.mesh_period
        first = [angle * state[:1], angle / period * state[1 : 2 + self.free]]
        return jnp.concatenate([*first, *self.own_states(state)])

    def scaled(self, state: Float[Array, " n"]) -> Float[Array, " n"]:
        """Convert a `state` (n,) in the units of `state_names` to scaled form."""
        nothing = jnp.zeros(self.states, self.angle_scale.dtype)
        start = self.in_si(nothing)
        return ((state - start) / (self.in_si(nothing + 1) - start)).astype(start.dtype)

    def physical(
        self, tau: Float[Array, "*k"], state: Float[Array, "*k n"]
    ) -> tuple[Float[Array, "*k"], Float[Array, "*k"], Float[Array, "*k"]]:
        """Return φ1 (rad), ε (rad) and dε/dt (rad/s) at rotation `tau` (mesh periods) and scaled
        `state`."""
        return self.motion(tau, state)[:3]

    def contact_force(
        self, phi: Float[Array, ""], relative: Float[Array, ""], rate: Float[Array, ""]
    ) -> FlankForce:
        """Return the flank contact at φ1 = `phi` (rad), ε = `relative` (rad) and dε/dt = `rate`
        (rad/s).

        Rotor 1 turns at the drive's speed, and neither axis is displaced."""
        motion = Motion(phi, relative, rate, self.drive.speed)
        if any(part.displaces for part in self.all_parts):
            rest = jnp.zeros((2, 2), self.angle_scale.dtype)
            motion = motion._replace(shift=rest, drift=rest)
        return self._force(motion)

    @eqx.filter_jit
    def contact_at(self, tau: Float[Array, ""], state: Float[Array, " n"]) -> FlankForce:
        """Return the flank contact at rotation `tau` (mesh periods) and scaled `state`."""
        return self._force(self.motion(tau, state))

    def pushes(self, motion: Motion) -> Pushes:
        """Return the `Pushes` of the flanks at the position and velocity `motion`.

        Raises `InputError` if the contact does not give the point of contact."""

        def of_flank(side, motion):
            touch = self._touch(side, motion, located=True)
            found = self._flank_force(side, motion, touch)
            sliding = touch.sliding
            assert sliding is not None
            assert sliding.normal is not None
            assert found.push is not None
            x, y = sliding.normal
            aside = side * touch.approach.lever1 * jnp.stack([-y, x])
            place = sliding.point.support1 * sliding.normal - aside
            levers = jnp.stack([-touch.approach.lever1, touch.approach.lever2])
            return Pushes(found.push, place, side * found.drive * levers)

        def of_section(motion):
            sides = jnp.asarray([1.0, -1.0], self.angle_scale.dtype)
            if not self.two_sided:
                sides = jnp.where(motion.relative < 0, sides[:1], sides[1:])
            return jax.vmap(of_flank, (0, None))(sides, motion)

        slices = self.contact.slices
        if slices is None:
            return jax.tree.map(lambda x: x[None], of_section(motion))
        found = jax.vmap(lambda by: of_section(_turned(motion, by)))(slices.offsets)
        weights = slices.weights[:, None, None]
        return Pushes(weights * found.force, found.place, weights * found.torque)

    def _touches(self, motion: Motion) -> tuple[Float[Array, "*sides"], _Touch]:
        """Return the side of each flank that can touch at a `motion` (1 drive, -1 coast), and its
        `_Touch`.

        A pair that is not two-sided has the nominal centre distance and no negative clearance. Then
        only the drive flank can touch when ε < 0, and only the coast flank when ε > 0. One search
        for the gap is therefore enough. Otherwise, both results have a leading axis for the sides.
        With twisted rotors, an axis for the slices stands before it.
        """
        slices = self.contact.slices
        if slices is None:
            return self._section_touches(motion)
        return jax.vmap(lambda by: self._section_touches(_turned(motion, by)))(slices.offsets)

    def _section_touches(self, motion: Motion) -> tuple[Float[Array, "*sides"], _Touch]:
        """Return the result of `_touches` for one section of the rotors."""
        if self.two_sided:
            sides = jnp.asarray([1.0, -1.0], self.angle_scale.dtype)
            return sides, jax.vmap(self._touch, (0, None))(sides, motion)
        side = jnp.where(motion.relative < 0, jnp.ones_like(motion.relative), -1.0)
        return side, self._touch(side, motion)

    def _force(self, motion: Motion, touches: Any = None) -> FlankForce:
        """Return the contact of the flanks at the position and velocity `motion`.

        `touches`: result of `_touches` at this motion, if known."""
        touches = self._touches(motion) if touches is None else touches
        slices = self.contact.slices
        if slices is None:
            return self._section_force(motion, *touches)
        found = jax.vmap(self._section_force, (None, 0, 0))(motion, *touches)
        whole = jax.tree.map(lambda x: jnp.tensordot(slices.weights, x, 1), found)
        if whole.edges is None and self.jumps:
            whole = whole._replace(edges=jnp.stack([whole.depth, whole.closing]))
        deepest = jnp.argmax(found.depth)
        return whole._replace(depth=found.depth[deepest], closing=found.closing[deepest])

    def _section_force(self, motion: Motion, side: Float[Array, "*sides"], touch: _Touch):
        """Return the `FlankForce` of rotors that are this section over their whole length.

        `side`, `touch`: result of `_section_touches`."""
        if self.two_sided:
            flanks = jax.vmap(self._flank_force, (0, None, 0))(side, motion, touch)
            drive, coast = flanks.drive
            summed = jax.tree.map(lambda x: jnp.sum(x, axis=0), flanks)
            deeper = jnp.argmax(flanks.depth)
            return summed._replace(
                drive=drive,
                coast=coast,
                depth=flanks.depth[deeper],
                closing=flanks.closing[deeper],
                lever1=flanks.lever1[deeper],
                lever2=flanks.lever2[deeper],
            )
        drives = motion.relative < 0
        flank = self._flank_force(side, motion, touch)
        return flank._replace(
            drive=jnp.where(drives, flank.drive, 0.0), coast=jnp.where(drives, 0.0, flank.drive)
        )

    def _flank_force(self, side: Float[Array, ""], motion: Motion, touch: _Touch) -> FlankForce:
        """Return the contact on one side (1 drive, -1 coast) at the position and velocity `motion`.

        `touch`: the flanks of this side. The field `drive` of the result holds the normal force on
        either side; `coast` is zero."""
        force = self.law(touch.depth, touch.closing)
        lever1, lever2 = touch.approach.lever1, touch.approach.lever2
        forward, sliding = side * force, touch.sliding
        torque1, torque2 = -lever1 * forward, lever2 * forward
        push = None
        if sliding is not None and sliding.normal is not None:
            push = force * sliding.normal
        drag = None
        if sliding is not None:
            drag = _sum(part.drag(force, sliding.speed) for part in self.all_parts if part.rubs)
        if sliding is not None and drag is not None:
            torque1 -= side * drag * sliding.point.support1
            torque2 += side * drag * sliding.point.support2
            if push is not None and sliding.tangent is not None:
                push += drag * sliding.tangent
        edges = touch.approach.edges
        if edges is not None:
            turning = -side * (motion.speed + motion.rate / 2)
            edges = jnp.stack([edges.distance, edges.by_roll * turning])
        return FlankForce(
            drive=force,
            coast=jnp.zeros_like(force),
            depth=touch.depth,
            closing=touch.closing,
            lever1=lever1,
            lever2=lever2,
            torque1=torque1,
            torque2=torque2,
            push=push,
            edges=edges,
        )

    def _touch(self, side: Float[Array, ""], motion: Motion, located: bool = False) -> _Touch:
        """Return the geometry of the flanks of one side (1 drive, -1 coast) at a `motion`.

        `located`: whether to give the direction of the force even if no part needs it.

        Let n be the drive side's normal from rotor 1 to rotor 2, and t the tangent: n turned by
        +90°. Rotor 1 slides along rotor 2 at the speed ω1 h1 - ω2 h2 + (v1 - v2)·t. The coast side
        is the mirror image. Let θ be the angle of the displaced line of centres. A pair with
        displaced axes is equivalent to a pair at another centre distance with the angles φ1 - θ and
        φ2 + θ.
        """
        contact, line, relative = self.contact.on_side(side), None, motion.relative
        if motion.shift is not None:
            x, y = motion.shift[1] - motion.shift[0]
            line = jnp.stack([contact.center_distance + x, y])
            relative = relative + 2 * jnp.arctan2(y, line[0])
            contact = contact.at_distance(jnp.hypot(*line))
        elif located:
            line = jnp.stack([contact.center_distance, jnp.zeros_like(contact.center_distance)])
        roll, turned = -side * (motion.phi + motion.relative / 2), side * relative
        approach = contact.approach(roll, turned)
        gap, lever1, lever2 = approach[:3]
        other = motion.speed + motion.rate
        closing = side * (lever1 * motion.speed - lever2 * other)
        sliding = None
        if line is not None or any(part.rubs for part in self.all_parts):
            point = contact.point(roll, turned, approach)
            speed = side * (motion.speed * point.support1 - other * point.support2)
            sliding = _Sliding(point, speed)
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
                sliding = _Sliding(point, speed, normal, tangent)
        return _Touch(-gap - self.clearance, closing, roll, approach, sliding)

    @eqx.filter_jit
    def switches(
        self, tau: Float[Array, ""], state: Float[Array, " n"]
    ) -> tuple[Bool[Array, " s"], Bool[Array, " s"]]:
        """Return flags that change wherever the equation has a kink or a jump, and a mask of the
        flags that matter.

        The flags describe the side of contact, the flank segment, the contact law and the parts, at
        rotation `tau` (mesh periods) and scaled `state`. The mask excludes flanks out of contact.
        """
        motion, acting = self._moving(tau, state)

        def of_flank(side, motion):
            touch = self._touch(side, motion)
            flags = [
                self.law.switches(touch.depth, touch.closing),
                self.contact.switches(touch.roll, touch.approach),
            ]
            if touch.sliding is not None:
                speed = touch.sliding.speed
                flags += [part.drag_switches(speed) for part in self.all_parts if part.rubs]
            found = jnp.concatenate(flags)
            return found, jnp.full_like(found, touch.depth > 0)

        def of_section(motion):
            if not self.two_sided:
                return of_flank(jnp.where(motion.relative < 0, 1.0, -1.0), motion)
            sides = jnp.asarray([1.0, -1.0], self.angle_scale.dtype)
            return tuple(x.ravel() for x in jax.vmap(of_flank, (0, None))(sides, motion))

        slices = self.contact.slices
        if slices is None:
            flags, counts = of_section(motion)
        else:
            each = jax.vmap(lambda by: of_section(_turned(motion, by)))(slices.offsets)
            flags, counts = (x.ravel() for x in each)
        if not self.two_sided:
            flags, counts = jnp.append(flags, motion.relative < 0), jnp.append(counts, True)
        flags = jnp.concatenate([flags, *(part.switches(motion, own) for part, own in acting)])
        return flags, jnp.pad(counts, (0, flags.size - counts.size), constant_values=True)

    @eqx.filter_jit
    def margins(self, tau: Float[Array, ""], state: Float[Array, " n"]) -> Margins:
        """Return the `Margins` at rotation `tau` (mesh periods) and scaled `state`."""
        motion, acting = self._moving(tau, state)
        return self._margins(motion, acting, self._touches(motion))

    def _margins(self, motion: Motion, acting, touches: Any) -> Margins:
        """Return the `Margins` at a `motion`; `acting`, `touches`: as in `_slope`.

        Raises NotImplementedError for twisted rotors, whose orbits collocation does not close."""
        if self.contact.slices is not None:
            raise NotImplementedError("Margins are for straight rotors; these are twisted.")

        def of_flank(side, touch):
            found = [
                self.law.margins(touch.depth, touch.closing),
                self.contact.on_side(side).margins(touch.roll, touch.approach),
            ]
            if touch.sliding is not None:
                speed = touch.sliding.speed
                found += [part.drag_margins(speed) for part in self.all_parts if part.rubs]
            pushes = self.law(touch.depth, touch.closing) > 0
            values = jnp.concatenate(found)
            return values, jnp.full(values.shape, pushes), touch.approach.place, pushes

        if self.two_sided:
            values, counts, both, pushes = jax.vmap(of_flank)(*touches)
            places = [jax.tree.map(lambda x, k=k: x[k], both) for k in range(2)]
            values, counts = [values.ravel()], [counts.ravel()]
        else:
            values, counts, place, push = of_flank(*touches)
            values, counts = [values, -motion.relative[None]], [counts, counts[:1]]
            places, pushes = [place], push[None]
        values += [part.margins(motion, own) for part, own in acting]
        found, counted = jnp.concatenate(values), jnp.concatenate(counts)
        counted = jnp.pad(counted, (0, found.size - counted.size), constant_values=True)
        return Margins(found, counted, places, pushes)

    @eqx.filter_jit
    def derivative(
        self, tau: Float[Array, ""], state: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], FlankForce]:
        """Return d(state)/dτ and the flank contact, at rotation `tau` (mesh periods) and scaled
        `state`."""
        motion, acting = self._moving(tau, state)
        return self._slope(state, motion, acting, self._touches(motion))

    @eqx.filter_jit
    def derivative_and_margins(
        self, tau: Float[Array, ""], state: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], FlankForce, Margins]:
        """Return the results of `derivative` and `margins`, with one evaluation of the contact."""
        motion, acting = self._moving(tau, state)
        touches = self._touches(motion)
        slope, contact = self._slope(state, motion, acting, touches)
        return slope, contact, self._margins(motion, acting, touches)

    @eqx.filter_jit
    def contact_and_margins(
        self, tau: Float[Array, ""], state: Float[Array, " n"]
    ) -> tuple[FlankForce, Margins]:
        """Return the results of `contact_at` and `margins`, with one evaluation of the contact."""
        motion, acting = self._moving(tau, state)
        touches = self._touches(motion)
        return self._force(motion, touches), self._margins(motion, acting, touches)

    def _slope(self, state, motion: Motion, acting, touches: Any):
        """Return d(state)/dτ and the flank contact at the scaled `state`.

        `motion`, `acting`: result of `_moving`; `touches`: result of `_touches`."""
        contact = self._force(motion, touches)
        loads = self._loads(motion, acting, contact)
        unit = self.mesh_period**2 / self.angle_scale
        acceleration = loads.torque2 / self.inertia
        slopes = [state[1:2]]
        if loads.torque1 is None:
            slopes += [jnp.stack([acceleration * unit])]
        else:
            added = _sum(part.added_inertia for part in self.all_parts)
            inertia = self.inertia if added is None else self.inertia + added
            driven = loads.torque1 / inertia
            slopes += [unit * jnp.stack([acceleration - driven, driven])]
        for part, own in acting:
            if part.states:
                per_period = self.mesh_period / part.scales(self._units)
                slopes += [per_period * part.rates(motion, own, loads)]
        slope = jnp.concatenate(slopes)
        if self.free:
            slope = self.lapse(state) * slope
        # A pair that is `lost` gets derivative zero, so that its states stay finite. The caller
        # reports the loss.
        return jnp.where(lax.stop_gradient(self._lost(state, acting)), 0.0, slope), contact

    def _loads(self, motion: Motion, acting, contact: FlankForce) -> Loads:
        """Return the sums of all loads; `acting`: list of (part, its own states in SI units)."""
        torque1 = axes = None
        if self.free:
            torques = (part.torque_on_1(motion, own) for part, own in acting)
            torque1 = _sum([contact.torque1, *torques])
        torques = (part.torque_on_2(motion, own) for part, own in acting)
        torque2 = _sum([contact.torque2, *torques])
        assert torque2 is not None
        if contact.push is not None:
            forces = (part.force_on_axes(motion, own) for part, own in acting)
            axes = _sum([*forces, jnp.stack([-contact.push, contact.push])])
        return Loads(torque1, torque2, axes)

    def lost(self, state: Float[Array, " n"]) -> Bool[Array, ""]:
        """Return whether the rotors no longer run as a pair in the scaled `state`.

        There are three possible reasons: the lobes have passed through each other; the motor has
        stalled; or a part reports a loss, such as an axis displaced too far."""
        return self._lost(state, zip(self.all_parts, self.own_states(state), strict=True))

    def _lost(self, state, acting) -> Bool[Array, ""]:
        """Return `lost` for a scaled `state`; `acting`: pairs (part, its own states in SI)."""
        lost = ~(jnp.abs(self.angle_scale * state[0]) < self.angle_limit)
        for part, own in acting:
            gone = part.lost(own)
            lost = lost if gone is None else lost | gone
        return lost | self.stalled(state) if self.free else lost

    def stalled(self, state: Float[Array, " n"]) -> Bool[Array, ""]:
        """Return whether the motor has stalled: rotor 1 is slower than `STALLED` times the drive's
        speed. Always False at prescribed speed."""
        if not self.free:
            return jnp.zeros((), bool)
        return self.speed(state) < STALLED * self.drive.speed


def _turned(motion: Motion, by: Float[Array, ""]) -> Motion:
    """Return the `motion` of a section that is turned by the angle `by` (rad) from the middle."""
    return motion._replace(phi=motion.phi + by)


def _sum(terms: Iterable[Array | None]) -> Array | None:
    """Return the sum of the terms that are not None; None if there are none."""
    total = None
    for term in terms:
        if term is not None:
            total = term if total is None else total + term
    return total
