"""Close a periodic orbit by collocation: find its events, its mesh and the orbit itself.

An *event* is an instant at which a flag of the equation (`RotorPair.switches`) changes. The *mesh*
divides the orbit into elements that end at its events.

One loop does everything, so that each program is compiled once. Each iteration evaluates the flags
along the orbit. If the flags do not change exactly at the events of the mesh, the elements are
aligned with the changes found. Otherwise, Newton's method solves for the orbit and the times of its
events, and the flags are evaluated again.

An orbit whose flags agree is solved again on a finer mesh, graded according to the error on the
coarser mesh. The difference between the two solutions is the error estimate.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.contact.search import SearchContact
from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.collocation.equation import CollocatedEquation
from rootsopt.dynamics.collocation.events import (
    FlagScan,
    agrees,
    apart,
    found_events,
    look,
    rooted,
)
from rootsopt.dynamics.collocation.forces import OrbitForces, response
from rootsopt.dynamics.collocation.known import Known
from rootsopt.dynamics.collocation.mesh import aligned, counted, needed, ordered, roughness
from rootsopt.dynamics.collocation.newton import Converged, newton
from rootsopt.dynamics.orbit import choose
from rootsopt.dynamics.pair import RotorPair

FIRST, _EVENT = 40, 1
"""Number of elements per mesh period before events are known. The first mesh that is aligned with
events has half as many, and the second number per event."""
_FINER = 1.4
"""Factor by which the number of elements grows when the mesh is refined."""
_TURNS = 24
"""Maximum number of iterations of the loop."""
CORRECTED = 1e-6
"""Last correction of the states (scaled) above which an orbit is rejected."""
_FAILURES = 4
"""Number of failures of Newton's method above which the search for the orbit fails."""
_SMALL = 1e-5, 3e-9
"""Newton step (scaled) below which Newton's method stops: from a similar pair's orbit on the same
mesh, and otherwise. The step after it would be smaller by orders of magnitude, since convergence is
quadratic. It is made together with the derivatives."""
_FAR = 1e-6
"""Difference (rad) between the contact's normal angle in the solved orbit and that found by a
search, above which the orbit is solved again from the latter."""
_GAIN = 10.0
"""Factor by which the difference between the results on two meshes is divided to estimate the error
on the finer mesh. In theory the error falls by the larger factor 1.4⁸."""


class Closed(NamedTuple):
    """A closed orbit.

    `found`: its forces and derivatives; `roughness`: that of its elements (`mesh.roughness`), for
    which the errors hold; `error`: estimated relative error of the forces, the largest of mean, RMS
    and peak; `drift`: estimated error of their derivatives, relative to the largest derivative of
    the same force; `sound`: whether Newton's method has converged and the flags agree with the
    events of the mesh; `turns`: number of iterations of the loop; `steps`: number of Newton steps.
    `error` and `drift` are inf if they are not known.
    """

    found: OrbitForces
    roughness: Float[Array, ""]
    error: Float[Array, ""]
    drift: Float[Array, ""]
    sound: Bool[Array, ""]
    turns: Int[Array, ""]
    steps: Int[Array, ""]


class Loop(NamedTuple):
    """State of the loop.

    `closed`: result so far; `elements`: motion for the next iteration; `force` (e, s): contact
    force (N) at the Gauss points; `trusted`: whether the motion is the orbit of a similar pair,
    whose flags need not be evaluated; `fits`: whether the elements end at events; `solved`: whether
    Newton's method has converged on these elements; `failures`: number of times that it has not
    converged; `meshes`: number of meshes on which the orbit has been solved; `over`: whether the
    loop ends; `line`: what else the solution of the equations determines (see `bordered`).
    """

    closed: Closed
    elements: Elements
    force: Float[Array, "e s"]
    trusted: Bool[Array, ""]
    fits: Bool[Array, ""]
    solved: Bool[Array, ""]
    failures: Int[Array, ""]
    meshes: Int[Array, ""]
    over: Bool[Array, ""]
    line: Any = ()


def supported(pair: RotorPair) -> bool:
    """Return whether collocation can close orbits of `pair`.

    The contact must be a `SearchContact`. Every flag of contact law and parts needs a margin (see
    `Margins`)."""
    searched = isinstance(pair.contact, SearchContact)
    return searched and all(_has_margins(type(owner)) for owner in (pair.law, *pair.all_parts))


@functools.cache
def _has_margins(kind: type) -> bool:
    """Return whether a contact law or part of the class `kind` has a margin for each flag."""
    names = [("margins", "switches"), ("drag_margins", "drag_switches")]
    return all(_newer(kind, margin, flag) for margin, flag in names if hasattr(kind, flag))


def _newer(kind: type, margin: str, flag: str) -> bool:
    """Return whether the method `margin` of the class `kind` matches its method `flag`.

    It does if `margin` is defined in the same class as `flag`, or in a subclass of that class."""
    order = list(kind.__mro__)
    places = [
        next(k for k, base in enumerate(order) if name in vars(base)) for name in (margin, flag)
    ]
    return places[0] <= places[1]


class Closer(eqx.Module):
    """The loop of `close`: `start` returns its initial state, `turn` makes one iteration.

    `frozen`: the pair of `equation`, treated as constant by JAX. The other fields are arguments of
    `close`."""

    equation: CollocatedEquation
    frozen: RotorPair
    tangents: Any
    known: Known
    neighbour: RotorPair
    tolerance: Float[Array, ""]

    def start(self) -> Loop:
        """Return the initial state of the loop."""
        known, elements = self.known, self.known.elements
        nothing = _nothing(self.equation, self.tangents, elements)
        no, zero = jnp.zeros((), bool), jnp.zeros((), int)
        begun = known.aligned, known.aligned, no, zero, zero, no
        return Loop(nothing, elements, elements.slopes[..., 0], *begun)

    def frozen_at(self, now: Loop) -> RotorPair:
        """Return the pair whose flags are evaluated, treated as constant by JAX."""
        del now
        return self.frozen

    def converged(
        self, now: Loop, elements: Elements, limit: Float[Array, ""]
    ) -> tuple[Converged, Any]:
        """Return the result of Newton's method from `elements`, and the new `Loop.line`.

        `limit`: step (scaled) at which the method stops."""
        return newton(self.equation, elements, limit, self.neighbour, now.trusted), now.line

    def forces(self, now: Loop) -> OrbitForces:
        """Return the forces of the present orbit."""
        return response(self.equation, now.elements, now.force, self.tangents)

    def turn(self, now: Loop) -> Loop:
        """Evaluate the flags along the motion, and return the loop's state after one iteration.

        Depending on the flags, the iteration solves for the orbit, stores its forces or changes the
        mesh."""
        frozen = self.frozen_at(now)
        shape = jax.eval_shape(lambda: look(frozen, now.elements))
        empty: FlagScan = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
        seen = lax.cond(now.trusted, lambda: empty, lambda: look(frozen, now.elements))
        agree = now.trusted | (now.fits & agrees(frozen, now.elements, seen))
        done = agree & now.solved & (apart(now.elements, seen) <= _FAR)
        new = lax.cond(
            agree,
            lambda: lax.cond(done, lambda: self.keep(now, seen), lambda: self.solve(now, seen)),
            lambda: now,
        )
        new = lax.cond(
            (done | ~agree) & ~new.over, lambda: self.align(new, seen, done), lambda: new
        )
        closed = new.closed._replace(turns=now.closed.turns + 1)
        return new._replace(closed=closed, trusted=jnp.zeros((), bool))

    def run(self) -> Loop:
        """Return the final state of the loop."""

        def go_on(now: Loop) -> Bool[Array, ""]:
            return ~now.over & (now.closed.turns < _TURNS)

        return lax.while_loop(go_on, lambda now: self.turn(now), self.start())

    def align(self, now: Loop, seen: FlagScan, finer) -> Loop:
        """Return the loop's state with the motion on a mesh that ends at its events.

        `seen`: flags along the motion; `finer`: whether the new mesh has more elements than the old
        one."""
        room = now.elements.mesh.times.shape[0]
        events = found_events(self.frozen_at(now), now.elements, seen, room)
        taken = now.elements.mesh.used
        first = taken // 2 + _EVENT * events.count
        used = jnp.where(now.fits, jnp.where(finer, (_FINER * taken).astype(int), taken), first)
        used = jnp.clip(used, events.count + 2, now.elements.state.shape[0] - 1)
        (place, wanted), (spot, number) = needed(now.elements), counted(now.elements)
        density = jnp.where(now.fits, place, spot), jnp.where(now.fits, wanted, number)
        new = aligned(now.elements, (events.times, events.which), density, used)
        yes = jnp.ones((), bool)
        return now._replace(elements=new, fits=yes, solved=~yes, over=~events.fits)

    def solve(self, now: Loop, seen: FlagScan) -> Loop:
        """Return the loop's state after Newton's method on the present mesh.

        `seen`: flags along the motion."""
        given = rooted(now.elements, seen).roots
        begun = now.elements._replace(roots=jnp.where(now.trusted, now.elements.roots, given))
        limit = jnp.where(now.trusted, *_SMALL)
        got, line = self.converged(now, begun, limit)
        # Where events have passed each other, the elements between them have a negative length.
        mesh, rising = ordered(got.elements.mesh)
        good = rising & (got.stalled | (got.size <= 10 * limit))
        closed = now.closed._replace(steps=now.closed.steps + got.turns)
        # After a failure, the loop finds the events of the last motion and tries again.
        failures = now.failures + ~good
        return now._replace(
            closed=closed,
            elements=got.elements._replace(mesh=mesh),
            force=got.force,
            solved=good,
            failures=failures,
            line=line,
            over=~jnp.isfinite(got.size) | (failures > _FAILURES),
        )

    def keep(self, now: Loop, seen: FlagScan) -> Loop:
        """Return the loop's state with the forces, derivatives and errors of the present orbit.

        The flags along the orbit must change exactly at the events of its mesh. `seen`: these
        flags. The roots come from the search, since those of Newton's method lag behind."""
        found = self.forces(now._replace(elements=rooted(now.elements, seen)))
        size = roughness(found.elements)
        # On the first mesh, the errors are estimated from those of the known orbit.
        growth = jnp.maximum(size / self.known.roughness, 1.0) ** 2
        first = now.meshes == 0
        error, drift = (
            jnp.where(first, known * growth, x / _GAIN)
            for known, x in zip(
                (self.known.error, self.known.drift),
                _differences(now.closed.found, found),
                strict=True,
            )
        )
        full = now.elements.mesh.used >= now.elements.state.shape[0] - 1
        # Newton's method has converged, so the correction must be small. It is large or NaN where
        # the time derivative of a margin vanishes at its event.
        good = found.correction < CORRECTED
        size = jnp.where(first, jnp.maximum(size, self.known.roughness), size)
        kept = now.closed
        closed = kept._replace(
            found=choose(good, found, kept.found),
            roughness=jnp.where(good, size, kept.roughness),
            error=jnp.where(good, error, kept.error),
            drift=jnp.where(good, drift, kept.drift),
            sound=kept.sound | good,
        )
        return now._replace(
            closed=closed,
            elements=found.elements,
            meshes=now.meshes + 1,
            over=(error <= self.tolerance) | full | ~good,
        )


def close(
    equation: CollocatedEquation,
    tangents: Any,
    known: Known,
    neighbour: RotorPair,
    tolerance: Float[Array, ""],
) -> Closed:
    """Close the orbit near a `known` one, and compute its forces and their derivatives.

    `tangents`: d directions of the pair's parameters along which to differentiate, stacked along a
    leading axis; `neighbour`: pair whose orbit is the known one; `tolerance`: relative error of the
    forces to reach. If the mesh of the known orbit is aligned with events, the new one is solved on
    it, and its error follows from the known one. Otherwise, and if the events are others or the
    error is too large, the mesh is changed until flags and events agree and the error is small
    enough."""
    frozen = lax.stop_gradient(equation.pair)
    return Closer(equation, frozen, tangents, known, neighbour, tolerance).run().closed


def _differences(before: OrbitForces, after: OrbitForces):
    """Return two relative differences between the results on two meshes.

    The first is the largest difference in mean, RMS and peak force, the second that in their
    derivatives."""

    def rms(values):
        return values.at[1].set(jnp.sqrt(jnp.maximum(values[1], 0.0)))[:3]

    one, other = rms(before.response), rms(after.response)
    size = jnp.maximum(jnp.abs(other), 1e-30)
    error = jnp.max(jnp.abs(one - other) / size)
    slopes = jnp.max(jnp.abs(before.sensitivity - after.sensitivity), axis=1, initial=0.0)
    largest = jnp.max(jnp.abs(after.sensitivity), axis=1, initial=0.0)
    drift = jnp.max((slopes / jnp.where(largest > 0, largest, 1.0))[:3])
    return error, drift


def _nothing(equation: CollocatedEquation, tangents: Any, elements: Elements) -> Closed:
    """Return the result before the first iteration: zeros, with infinite errors."""
    shape = jax.eval_shape(lambda: response(equation, elements, elements.slopes[..., 0], tangents))
    empty: OrbitForces = jax.tree.map(lambda x: jnp.full(x.shape, 0, x.dtype), shape)
    infinite, zero = jnp.asarray(jnp.inf), jnp.zeros((), int)
    no = jnp.zeros((), bool)
    return Closed(empty, jnp.ones(()), infinite, infinite, no, zero, zero)


__all__ = ["CORRECTED", "FIRST", "Closed", "Closer", "Loop", "close", "supported"]
