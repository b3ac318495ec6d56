"""The rotor pair as an ordinary differential equation.

The simplest scene has two states: ε = φ2 - φ1 and its rate. A part that sets rotor 1 free adds the
speed of rotor 1 as a third state. Every part appends its own states, in the order of the parts.

The independent variable τ is the rotation of rotor 1 in mesh periods (lobe pitches), so the
equation is periodic even if the speed varies. It repeats each mesh period, unless a part repeats
only after a turn of rotor 1 (`RotorPair.repeats`). ε is measured in units of `angle_scale`, so that
the solver works with numbers of order one.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.contact.gap import Contact
from rootsopt.contact.law import ContactLaw
from rootsopt.dynamics.flanks import (
    FlankForce,
    Margins,
    Pushes,
    force_of,
    kink_margins,
    pushes_of,
    sum_of,
    touches_of,
)
from rootsopt.dynamics.parts.base import Loads, Motion, Part, Timescales, Units
from rootsopt.dynamics.parts.load import Load
from rootsopt.dynamics.parts.machine import Drive, Friction, Supports, TimingGear
from rootsopt.errors import InputError
from rootsopt.profiles.soundness import Soundness

STALLED = 0.05
"""Speed of rotor 1, as a fraction of the drive's speed, below which the motor counts as stalled."""


class RotorPair(eqx.Module):
    """Two identical rotors in mesh, rotor 1 driven, rotor 2 loaded.

    `lobes`: number per rotor; `contact`: gap and levers at a pose; `law`: contact force law;
    `clearance` (m) added to every flank gap; `inertia` of one rotor (kg·m²); `drive`, `load`,
    `gear`, `friction`, `supports`: parts that the scene names; `angle_scale` (rad) and
    `force_scale` (N): the solver's units; `timescales` of oscillation and free flight, None if
    unknown; `two_sided`: whether drive and coast flanks can touch at once (at the nominal centre
    distance, only with negative clearance); `parts`: all other parts; `soundness`: margins of the
    design, None if it was not checked; `begins`: mesh periods from φ1 = 0 to the start of τ, None:
    0 (see `later`). An absent part is None and costs nothing.

    Raises InputError if two parts let the axes move, or if one part does but `two_sided` is False.
    Also raises it if the pair is two-sided but the contact is not (see `Contact.two_sided`).
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
    soundness: Soundness | None = None
    begins: Int[Array, ""] | None = None

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
                "`SearchContact`"
            )

    @property
    def all_parts(self) -> tuple[Part, ...]:
        """Every part of the scene, in the order of their states."""
        named = self.drive, self.load, self.gear, self.friction, self.supports
        return (*(part for part in named if part is not None), *self.parts)

    @property
    def flanks(self) -> int:
        """Number of flanks that can touch at once: one or two in each slice."""
        return self.contact.sections * (1 + self.two_sided)

    @property
    def free(self) -> bool:
        """Whether the speed of rotor 1 is a state of the motion."""
        return any(part.free for part in self.all_parts)

    @property
    def repeats(self) -> int:
        """Mesh periods after which the equation repeats: 1, or those of a turn of rotor 1."""
        return self.lobes if any(part.whole_turns for part in self.all_parts) else 1

    def whole(self, periods: int) -> int:
        """Return the least multiple of `repeats` that is at least this number of mesh `periods`."""
        return -(-periods // self.repeats) * self.repeats

    def orders(self, longest: int) -> Int[Array, " k"]:
        """Return the periods (k,) that an orbit of up to `whole(longest)` mesh periods can have."""
        orders = jnp.arange(1, self.whole(longest) // self.repeats + 1)
        return orders if self.repeats == 1 else self.repeats * orders

    def later(self, periods: Int[Array, ""] | int) -> "RotorPair":
        """Return the pair with τ starting `periods` mesh periods later.

        Return the pair itself if the equation repeats each mesh period."""
        if self.repeats == 1:
            return self
        begins = periods if self.begins is None else self.begins + periods
        return dataclasses.replace(self, begins=jnp.mod(begins, self.repeats))

    def angle(self, tau: Float[Array, "*k"]) -> Float[Array, "*k"]:
        """Return φ1 (rad) at rotation `tau` (mesh periods)."""
        return 2 * jnp.pi / self.lobes * (tau if self.begins is None else tau + self.begins)

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
    def sound(self) -> Bool[Array, ""]:
        """Whether the design is sound, as far as it was checked."""
        return jnp.ones((), bool) if self.soundness is None else self.soundness.sound

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
        states, place = [], 2 + self.free
        for part in self.all_parts:
            count = len(part.states)
            # A part without states adds nothing to the traced program: NumPy, not JAX.
            own = np.zeros((*state.shape[:-1], 0), state.dtype)
            if count:
                own = part.scales(self._units) * state[..., place : place + count]
                start = part.start(self._units)
                own = own if start is None else start + own
            states.append(own)
            place += count
        return states

    def motion(self, tau: Float[Array, "*k"], state: Float[Array, "*k n"]) -> Motion:
        """Return position and velocity (SI units) at rotation `tau` (mesh periods) and scaled
        `state`, in the pair's precision."""
        return self._moving(tau, state)[0]

    def _moving(self, tau, state):
        """Return the `motion`, and a list of (part, its own states in SI units)."""
        tau, state = (jnp.asarray(x, self.angle_scale.dtype) for x in (tau, state))
        relative = self.angle_scale * state[..., 0]
        rate = self.angle_scale * state[..., 1] / self.mesh_period
        motion = Motion(self.angle(tau), relative, rate, self.speed(state))
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
        return force_of(self, motion)

    @eqx.filter_jit
    def contact_at(self, tau: Float[Array, ""], state: Float[Array, " n"]) -> FlankForce:
        """Return the flank contact at rotation `tau` (mesh periods) and scaled `state`."""
        return force_of(self, self.motion(tau, state))

    def pushes(self, motion: Motion) -> Pushes:
        """Return the `Pushes` of the flanks at the position and velocity `motion`.

        Raises `InputError` if the contact does not give the point of contact."""
        return pushes_of(self, motion)

    @eqx.filter_jit
    def switches(
        self, tau: Float[Array, ""], state: Float[Array, " n"]
    ) -> tuple[Bool[Array, " s"], Bool[Array, " s"]]:
        """Return flags that change wherever the equation has a kink or a jump, and a mask of the
        flags that matter.

        The flags describe the side of contact, the flank segment, the contact law and the parts, at
        rotation `tau` (mesh periods) and scaled `state`. The mask excludes flanks without a force.
        """
        margins = self.margins(tau, state)
        return margins.values > 0, margins.counts

    @eqx.filter_jit
    def margins(self, tau: Float[Array, ""], state: Float[Array, " n"]) -> Margins:
        """Return the `Margins` at rotation `tau` (mesh periods) and scaled `state`."""
        motion, acting = self._moving(tau, state)
        return kink_margins(self, motion, acting, touches_of(self, motion))

    @eqx.filter_jit
    def derivative(
        self, tau: Float[Array, ""], state: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], FlankForce]:
        """Return d(state)/dτ and the flank contact, at rotation `tau` (mesh periods) and scaled
        `state`."""
        motion, acting = self._moving(tau, state)
        return self._slope(state, motion, acting, touches_of(self, motion))

    @eqx.filter_jit
    def derivative_and_margins(
        self, tau: Float[Array, ""], state: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], FlankForce, Margins]:
        """Return the results of `derivative` and `margins`, with one evaluation of the contact."""
        motion, acting = self._moving(tau, state)
        touches = touches_of(self, motion)
        slope, contact = self._slope(state, motion, acting, touches)
        return slope, contact, kink_margins(self, motion, acting, touches)

    def _slope(self, state, motion: Motion, acting, touches: Any):
        """Return d(state)/dτ and the flank contact at the scaled `state`.

        `motion`, `acting`: result of `_moving`; `touches`: result of `touches_of`."""
        contact = force_of(self, motion, touches)
        loads = self._loads(motion, acting, contact)
        unit = self.mesh_period**2 / self.angle_scale
        acceleration = loads.torque2 / self.inertia
        slopes = [state[1:2]]
        if loads.torque1 is None:
            slopes += [jnp.stack([acceleration * unit])]
        else:
            added = sum_of(part.added_inertia for part in self.all_parts)
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
            torque1 = sum_of([contact.torque1, *torques])
        torques = (part.torque_on_2(motion, own) for part, own in acting)
        torque2 = sum_of([contact.torque2, *torques])
        assert torque2 is not None
        if contact.push is not None:
            forces = (part.force_on_axes(motion, own) for part, own in acting)
            axes = sum_of([*forces, jnp.stack([-contact.push, contact.push])])
        return Loads(torque1, torque2, axes)

    def lost(self, state: Float[Array, " n"]) -> Bool[Array, ""]:
        """Return whether the rotors no longer run as a pair in the scaled `state`.

        There are three possible reasons: the lobes have passed through each other; the motor has
        stalled; or a part reports a loss, such as an axis displaced too far."""
        return self._lost(state, zip(self.all_parts, self.own_states(state), strict=True))

    def _lost(self, state, acting) -> Bool[Array, ""]:
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
