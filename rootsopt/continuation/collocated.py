"""Families of periodic orbits, closed by collocation.

Each orbit of a curve starts from the previous one, moved along the curve's tangent. Newton's method
then solves for all instants of the orbit, for the times of its events and for the parameter at once
(`rootsopt.dynamics.collocation.bordered`). The first orbit is closed by integration. So is an orbit
at which collocation fails, such as one that grazes an event.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from rootsopt.continuation.arclength import End, Linearization, Spot, StoppedError, by_newton
from rootsopt.continuation.orbits import (
    HALF_ALIKE,
    LOOKS,
    SPAN,
    OrbitData,
    OrbitFamily,
    longest_gap,
    pair_at,
)
from rootsopt.dynamics.collocation.bordered import Followed, Line, Plane, followed
from rootsopt.dynamics.collocation.known import Known
from rootsopt.dynamics.collocation.motion import ACCURACY, UNREFINED
from rootsopt.dynamics.collocation.seed import from_steps
from rootsopt.dynamics.collocation.system import Step
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import continues
from rootsopt.dynamics.verdict import TOO_DEEP
from rootsopt.runtime.programs import Program
from rootsopt.scene import Scene

_SHORT = 2e-3
"""Distance from the previous orbit (unit of `StepSizes`) below which an orbit that collocation does
not find is closed by integration. Above it, the search tries a shorter step first."""
_AGREE = 1e-4
"""Relative difference between the forces of the first orbit by collocation and by integration above
which collocation is not used."""


class _Memory(NamedTuple):
    """An orbit from which the next one on the curve can be closed (`Linearization.memory`).

    `known`: the orbit; `tangent` (n + 1,) of the curve; `motion`: change of the whole motion along
    it.
    """

    known: Known
    motion: Step
    tangent: NDArray[np.float64]


class _Seen(NamedTuple):
    """An orbit of a curve, as needed for a `BranchPoint`.

    `state` (n,): scaled, in the unit of ε of the curve; `half_way` (n,): state after half the
    period; `scale` (rad): unit of ε in the config at this value of the parameter; `touching`:
    whether flanks or gear touch, at `LOOKS` uniform times; `reach`: greatest |ε| (unit of ε);
    `lost`: see `RotorPair.lost`.
    """

    state: Float[Array, " n"]
    half_way: Float[Array, " n"]
    scale: Float[Array, ""]
    touching: Bool[Array, " looks"]
    reach: Float[Array, ""]
    lost: Bool[Array, ""]


class CollocatedFamily(OrbitFamily):
    """An `OrbitFamily` whose orbits are closed by collocation, from their neighbours on the curve.

    It has the parameters of an `OrbitFamily`. Orbits that collocation does not find are closed by
    integration."""

    def corrected(
        self,
        guess: NDArray[np.float64],
        across: NDArray[np.float64],
        along: NDArray[np.float64],
        near: Spot | None,
    ) -> Spot:
        """Return the orbit at which the curve meets a plane, as `arclength.corrected` does."""
        if near is None:
            spot = by_newton(self, guess, across, along)
            return self._again(spot, along)
        distance = float(np.linalg.norm(guess - near.place))
        try:
            return self._followed(self._memory(near), guess, across, along, near.place)
        except StoppedError as stop:
            if stop.end is not End.STEP_TOO_SMALL or distance > _SHORT:
                raise
        return by_newton(self, guess, across, along)

    def _again(self, spot: Spot, along: NDArray[np.float64]) -> Spot:
        """Return an orbit closed by integration as one closed by collocation, if both agree."""
        fixed = np.eye(len(spot.place))[-1]
        try:
            new = self._followed(self._memory(spot), spot.place, fixed, along, spot.place)
        except StoppedError:
            return spot
        one, other = new.look.data.statistics, spot.look.data.statistics
        return new if np.allclose(one, other, rtol=_AGREE, atol=0) else spot

    def _memory(self, spot: Spot) -> _Memory:
        """Return the orbit at `spot` in the form from which others are closed by collocation."""
        if isinstance(spot.look.memory, _Memory):
            return spot.look.memory
        # It was closed by integration.
        shot = self._shot(spot.place, spot.look.memory, refine=False)
        known, motion = _seeded(
            self.scene,
            self.names,
            self._values(self.value(spot.place)),
            np.asarray(self.unit),
            SPAN * spot.place[:-1],
            (shot.out.grid, shot.out.corners),
            np.zeros(self.period),
        )
        return _Memory(known, motion, np.zeros(len(spot.place)))

    def _followed(
        self,
        memory: _Memory,
        guess: NDArray[np.float64],
        across: NDArray[np.float64],
        along: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> Spot:
        """Return the orbit at which the curve meets a plane, from that of `memory` at `place`."""
        self._check_design(self.value(guess))
        low, width = np.asarray(float(self.limits.low)), np.asarray(float(self.width))
        made, seen = jax.device_get(
            _follow(
                self.scene,
                self.names,
                (self.values * (np.arange(len(self.values)) != self.index), low, width),
                np.eye(len(self.names))[self.index],
                np.asarray(self.unit),
                memory.known,
                memory.motion,
                np.asarray((guess - place) @ memory.tangent),
                guess,
                across,
                self.scene.solver.measures,
                self.integrator,
            )
        )
        limit = ACCURACY * UNREFINED * self.integrator.rtol
        if not (made.known.sound and made.known.error <= limit):
            raise StoppedError(End.STEP_TOO_SMALL)
        return self._spot(made, seen, along)

    def _spot(self, made: Followed, seen: _Seen, along: NDArray[np.float64]) -> Spot:
        """Return the orbit `made` as a point of the curve.

        Raises `StoppedError` if the orbit has no meaning. For `along`, see `corrected`."""
        line = made.line
        new = np.append(seen.state / SPAN, line.share)
        self._check_design(self.value(new))
        if not np.all(np.isfinite(np.append(new, line.tangent))):
            raise StoppedError(End.NON_FINITE)
        if seen.lost:
            raise StoppedError(End.LOST_MESH)
        if made.found.depth > TOO_DEEP * float(self.scene.pitch_radius):
            raise StoppedError(End.TOO_DEEP)
        monodromy = np.asarray(line.monodromy)
        mean, square, peak = made.found.response[:3]
        data = OrbitData(
            monodromy=monodromy,
            to_state=np.asarray(line.to_state),
            state=np.asarray(seen.state) * (self.unit / seen.scale),
            statistics=np.array([mean, peak, np.sqrt(square)]),
            half_way=float(np.max(np.abs(seen.half_way - seen.state))) / SPAN,
            residual=float(line.residual / max(1.0, np.max(np.abs(seen.state)))),
            depth=float(made.found.depth),
            reach=self.unit * float(seen.reach),
            gap_time=longest_gap(np.asarray(seen.touching)) * self.period,
        )
        if self.period % 2 == 0 and data.half_way < HALF_ALIKE:
            raise StoppedError(End.HALVED)
        count = len(new) - 1
        jacobian = np.column_stack([monodromy - np.eye(count), line.by_share])
        tangent, inner = np.asarray(line.tangent), np.asarray(line.inner)
        turned = np.sign(np.linalg.det(np.vstack([jacobian, inner]))) * tangent
        look = Linearization(
            np.atleast_1d(line.residual),
            jacobian,
            _Memory(made.known, line.motion, tangent),
            data,
            turned,
        )
        return Spot(new, tangent if tangent @ along >= 0 else -tangent, look, 1)


def can_follow(scene: Scene, pair: RotorPair) -> bool:
    """Return whether orbits of `pair` in the `scene` can be followed by collocation."""
    return continues(pair, scene.solver)


@Program
def _seeded(
    scene: Scene,
    names: tuple[str, ...],
    values: Float[Array, " p"],
    unit: Float[Array, ""],
    state: Float[Array, " n"],
    taken: Any,
    periods: Float[Array, " k"],
) -> tuple[Known, Step]:
    """Return an orbit closed by integration as a start for collocation, and a motion of zeros.

    `state` (n,): scaled; `taken`: as for `from_steps`; `periods`: its shape tells the period."""
    pair, _ = _with_unit(scene, names, values, unit)
    longest = periods.shape[0]
    known = from_steps(pair, state, taken, jnp.asarray(longest), longest)
    return known, Line.empty(known.elements, jnp.zeros(())).motion


def _with_unit(scene: Scene, names: tuple[str, ...], values, unit):
    """Return the pair with the `unit` of ε, and its own unit (rad); see `orbits.pair_at`."""
    pair, scale = pair_at(scene, names, values)
    return eqx.tree_at(lambda p: p.angle_scale, pair, unit), scale


@Program
def _follow(  # Twelve parameters, since a compiled program takes its arrays one by one.
    scene: Scene,
    names: tuple[str, ...],
    values: tuple[Float[Array, " p"], Float[Array, ""], Float[Array, ""]],
    direction: Float[Array, " p"],
    unit: Float[Array, ""],
    known: Known,
    motion: Any,
    distance: Float[Array, ""],
    guess: Float[Array, " m"],
    across: Float[Array, " m"],
    measures: Measures,
    integrator: Integrator,
) -> tuple[Followed, _Seen]:
    """Return the orbit whose place lies in the plane through `guess` (m,) normal to `across` (m,).

    `values`: those of the parameters `names`, with 0 for the followed one; the latter's least value
    and range; `direction` (p,): unit vector of the followed parameter; `unit`: fixed unit of ε
    (rad); `known`: orbit to start from; `motion`, `distance`: direction of the curve there, and
    distance to go along it."""
    others, low, width = values

    def at(share):
        return _with_unit(scene, names, others + direction * (low + width * share), unit)

    def family(share):
        def arrays(share):
            return eqx.filter(at(share)[0], eqx.is_inexact_array)

        _, tangent = jax.jvp(arrays, (share,), (jnp.ones_like(share),))
        return at(share)[0], jax.tree.map(lambda x: x[None], tangent)

    plane = Plane(guess, across, jnp.asarray(SPAN))
    tolerance = ACCURACY * integrator.tolerance
    made = followed(family, measures, (known, motion, distance), plane, tolerance)
    pair, scale = at(made.line.share)
    elements = made.found.elements
    period = elements.mesh.period
    times = period * jnp.arange(LOOKS) / LOOKS
    states = elements.motion(times)

    def touches(tau, state):
        held = pair.gear is not None and jnp.any(pair.gear.switches(pair.motion(tau, state), None))
        return (pair.contact_at(tau, state).total > 0) | held

    state = made.found.state
    reach = jnp.max(jnp.abs(states[:, 0]))
    lost = (unit * reach >= pair.angle_limit) | pair.lost(state)
    half_way = elements.motion(period / 2)
    touching = jax.vmap(touches)(times, states)
    return made, _Seen(state, half_way, scale, touching, reach, lost)


__all__ = ["CollocatedFamily", "can_follow"]
