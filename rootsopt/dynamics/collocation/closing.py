"""Close a periodic orbit by collocation: find its events, its mesh and the orbit itself.

An *event* is an instant at which a flag of the equation (`RotorPair.switches`) changes. The *mesh*
divides the orbit into elements that end at its events.

One loop does everything, so that each part is compiled once. An iteration evaluates the flags along
the motion, or makes a step of Newton's method for the orbit and the times of its events. If the
flags do not change exactly at the events of the mesh, the elements are aligned with the changes
found. Steps follow until they are small, and the flags are evaluated again. If they agree, a last
step yields the forces and their derivatives.

An orbit whose flags agree is solved again on a finer mesh, graded according to the error on the
coarser mesh. The difference between the two solutions is the error estimate.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.elements import POINTS, Elements
from rootsopt.dynamics.collocation.equation import CollocatedEquation, Points
from rootsopt.dynamics.collocation.events import (
    Events,
    FlagScan,
    apart,
    empty_like,
    found_events,
    known_events,
    look,
    rooted,
)
from rootsopt.dynamics.collocation.mesh import (
    KnownOrbit,
    aligned,
    counted,
    differences,
    most_elements,
    needed,
    ordered,
    roughness,
    snug,
)
from rootsopt.dynamics.collocation.newton import (
    advanced,
    columns_of,
    evaluated,
    forces_of,
    lines,
    numbers,
    with_numbers,
)
from rootsopt.dynamics.collocation.peak import Rivals, forces_along, is_settled, peak_of, rivals_of
from rootsopt.dynamics.collocation.system import Step, chained, condensed, unchanged
from rootsopt.dynamics.orbit import Orbit, branch, choose
from rootsopt.dynamics.pair import RotorPair
from rootsopt.runtime.compute_once import compute_once

# Size of the first mesh that is aligned with events: elements for each element of the mesh before
# (more at a finer than the usual accuracy), and further elements per event; at least the third
# number per event. With half of that, Newton's method failed where rotors bounce 40 times in a mesh
# period; the other two numbers keep the mesh of a few events small.
_SHARE, _EVENT, _BOUNCE = 0.5, 1, 3
USUAL = 1e-7
"""Relative error of the forces (usual accuracy) for which `_SHARE` and `CORRECTED` hold."""
# Order of the forces' error in the length of the elements.
_ORDER = 2 * POINTS
# Estimated relative errors of forces and of their derivatives on a first mesh, as multiples of its
# roughness, which counts as at least the third number. In 45 random pairs, 95 % of the errors were
# below 8e-6 and 1.5e-3 times the roughness.
_UNCOMPARED = 1e-5, 1e-3, 0.1
# Factor by which the number of elements grows when the mesh is refined. If there is less room, a
# second or later mesh is refined only if it grows by at least the other factor. A mesh of nearly
# the same size would have nearly the same error, and say nothing about it.
_FINER, _LAST = 1.4, 1.4**0.5
# Step (scaled) below which Newton's method also stops if the step exceeds the second number times
# the step before. The steps then only follow rounding.
_ROUNDING = 1e-7, 0.5
# Maximum number of evaluations of the flags, and of Newton steps after each of them.
_TURNS, _STEPS = 24, 16
# Fraction of the way to the new pair over which the predictor takes its difference.
_WAY = 1e-3
# Change of a root (rad) above which it is limited to this value.
_TURNED = 0.1
CORRECTED = 1e-6
"""Last correction of the states (scaled) above which an orbit is rejected, at the usual
accuracy."""
# Number of failures of Newton's method above which the search for the orbit fails.
_FAILURES = 4
# Greatest Newton step (scaled) at which Newton's method may stop. It stops at a step whose square
# is below the error of the forces to reach. Convergence is quadratic, so the next step, which is
# made together with the derivatives, is about as small.
_LARGEST = 3e-3
# Correction (scaled, at the usual accuracy) below which its effect on the derivatives is
# negligible. Ratio to the previous correction above which a correction only follows rounding.
_NEGLIGIBLE, _STALLED = 3e-9, 0.5
# Difference (rad) between the contact's normal angle in the solved orbit and that found by a
# search, above which the orbit is solved again from the latter. Roots lag one Newton step behind,
# and another minimum of the gap lies much further away.
_FAR = 1e-3
# Divisors of the difference between two meshes that give the error on the finer one, for forces and
# for derivatives. They hold if it has `_FINER` times as many elements. In theory, both errors fall
# by 1.4⁸. Derivatives fall less evenly, and their estimate must be a bound. `gained` returns the
# numbers for other meshes.
_GAINS = 10.0, 0.2
# Error of derivatives above which the mesh is refined: the first number times the error of the
# forces to reach, at least the second and at most the third.
_TURNING = 100.0, 2.5e-7, 1e-2
# Relative error of derivatives that does not show in their difference: both meshes have the same
# roots of the gap to 1e-6 rad, and the same rounding errors.
_ROUGH = 1e-7


class Loop(NamedTuple):
    """State of the loop.

    The result so far: `orbit`: forces and derivatives; `known`: motion and errors, `sound` if
    Newton's method has converged and the flags agree with the events of the mesh; `turns`: number
    of evaluations of the flags; `steps`: number of Newton steps before the last, which yields the
    forces.

    For the next iteration: `elements`: motion for the next iteration; `rivals`: instants at which
    its force may be greatest; `looks`: whether the next iteration evaluates the flags along the
    motion. Otherwise it makes a step of Newton's method. `keeps`: whether the motion is a solution
    with the right events, so that the step is the last one, which yields forces and derivatives;
    `trusted`: whether the motion is the orbit of a similar pair, whose flags need not be evaluated;
    `fits`: whether the elements end at events; `solved`: whether Newton's method has converged on
    these elements; `size`: greatest change in the last step, of the states (scaled) and of the
    event times (mesh periods); `tries`: number of steps since the last look; `failures`: number of
    times that Newton's method has not converged; `meshes`: number of meshes on which the orbit has
    been solved; `over`: whether the loop ends; `line`: what else the solution of the equations
    determines (see `bordered`).
    """

    orbit: Orbit
    known: KnownOrbit
    turns: Int[Array, ""]
    steps: Int[Array, ""]
    elements: Elements
    rivals: Rivals
    looks: Bool[Array, ""]
    keeps: Bool[Array, ""]
    trusted: Bool[Array, ""]
    fits: Bool[Array, ""]
    solved: Bool[Array, ""]
    size: Float[Array, ""]
    tries: Int[Array, ""]
    failures: Int[Array, ""]
    meshes: Int[Array, ""]
    over: Bool[Array, ""]
    line: Any = ()


def corrected(tolerance: Float[Array, ""]) -> Float[Array, ""]:
    """Return the last correction of the states (scaled) above which an orbit is rejected.

    `tolerance`: relative error of the forces to reach. Derivatives are those before this
    correction."""
    return CORRECTED * jnp.sqrt(jnp.maximum(tolerance / USUAL, 1.0))


def gained(coarse: Int[Array, ""], fine: Int[Array, ""]) -> tuple[Array, Array]:
    """Return the numbers of `_GAINS` for meshes of `coarse` and `fine` elements.

    Errors fall with a power of the number of elements, the one for which `_GAINS` hold."""
    power = jnp.log(fine / coarse) / jnp.log(_FINER)
    force, slope = ((1 + gain) ** power - 1 for gain in _GAINS)
    return force, slope


class Closer(eqx.Module):
    """Closes the orbit near a `known` one, and computes its forces and their derivatives.

    `equation`: that of the orbit; `frozen`: its pair, treated as constant by JAX; `tangents`: d
    directions of the pair's parameters along which to differentiate, stacked along a leading axis;
    `neighbour` (m,): `numbers` of the pair whose orbit is the known one; `tolerance`: relative
    error of the forces to reach.

    If the mesh of the known orbit is aligned with events, the new orbit is solved on it. Its error
    then follows from that of the known orbit. Otherwise, or if the events differ or the error is
    too large, the mesh is changed. This continues until flags and events agree and the error is
    small enough. `start` returns the initial state of the loop, `turn` makes one iteration."""

    equation: CollocatedEquation
    frozen: RotorPair
    tangents: Any
    known: KnownOrbit
    neighbour: Float[Array, " m"]
    tolerance: Float[Array, ""]

    def start(self) -> Loop:
        """Return the initial state of the loop."""
        known, elements = self.known, self.known.elements
        infinite, zero, no = jnp.asarray(jnp.inf), jnp.zeros((), int), jnp.zeros((), bool)
        count = jax.tree.leaves(eqx.filter(self.tangents, eqx.is_inexact_array))[0].shape[0]
        still = unchanged(elements, count) if self.equation.variation else None
        orbit = Orbit.empty(elements.state[0], count, self.equation.measures.count + 1, still)
        unknown = KnownOrbit(elements, jnp.ones(()), infinite, infinite, no, ~no)
        return Loop(
            orbit=orbit,
            known=unknown,
            turns=zero,
            steps=zero,
            elements=elements,
            rivals=Rivals.anywhere(elements),
            looks=~known.aligned,
            keeps=no,
            trusted=known.aligned,
            fits=known.aligned,
            solved=no,
            size=infinite,
            tries=zero,
            failures=zero,
            meshes=zero,
            over=no,
        )

    @property
    def denser(self) -> Float[Array, ""]:
        """Factor by which meshes are denser than at the usual accuracy, at least 1."""
        return jnp.maximum(USUAL / self.tolerance, 1.0) ** (1 / _ORDER)

    def most(self, now: Loop) -> Int[Array, ""]:
        """Return the number of elements above which the mesh is not refined."""
        return most_elements(now.elements.mesh, self.denser, self.frozen.contact.sections)

    def frozen_at(self, now: Loop) -> RotorPair:
        """Return the pair whose flags are evaluated, treated as constant by JAX."""
        return self.frozen

    @property
    def limit(self) -> Float[Array, ""]:
        """Size of a step (scaled) at which Newton's method stops."""
        return jnp.minimum(jnp.sqrt(self.tolerance), _LARGEST)

    def step(self, now: Loop) -> tuple[CollocatedEquation, Points, Array, Step, Any]:
        """Solve the linearised equation for Newton's step and the directions of the parameters.

        Return five results: the equation; the equation along the motion; direct changes of its
        values in all columns of the step (e, p, r, k); the step; the new `Loop.line`.

        If the motion is the orbit of a similar pair, the first step is a predictor. It goes along
        the tangent of the family of orbits that leads to the equation's pair. Newton's first step
        would be evaluated at penetrations of the wrong size, since the flanks have moved. The
        tangent is Newton's step for a pair a small way (`_WAY`) towards the new one, divided by
        this way."""
        at = now.elements
        way = jnp.where(now.trusted & (now.tries == 0), _WAY, 1.0)
        own = numbers(self.equation.pair)
        toward = self.neighbour + way * (own - self.neighbour)
        pair = compute_once(jnp.where(way == 1, own, toward))
        points, along = evaluated(self.equation, pair, at, now.rivals, self.tangents, now.keeps)
        linearised = lines(at, points)
        columns = columns_of(at, linearised, along)
        step = chained(at, linearised, columns, condensed(at, linearised, columns))
        first = jnp.arange(columns.gap.shape[-1]) == 0
        # All changes are proportional to the right-hand sides.
        longer = jnp.where(first, 1 / way, 1.0)
        moves = step.state * longer, step.slopes * longer, step.times * longer
        step = Step(*moves, step.monodromy)
        given = at.roots.at[at.mesh.used].set(now.rivals.roots)
        turned = jnp.clip((points.roots - given) / way, -_TURNED, _TURNED)
        points = points._replace(roots=given + turned)
        direct = jnp.pad(along, ((0, 0), (0, 0), (0, 0), (1, 0)))
        return with_numbers(self.equation, pair), points, direct, step, now.line

    def turn(self, now: Loop) -> Loop:
        """Evaluate the flags along the motion or make a step, then change the mesh if needed.

        In a batch, motions that are over take the branches that cost least."""
        frozen = self.frozen_at(now)

        def look_at():
            seen = look(frozen, now.elements)
            return seen, found_events(frozen, now.elements, seen)

        seen, events = branch(now.looks & ~now.over, look_at, lambda: empty_like(look_at))
        agree = now.fits & (events.new == 0) & (events.gone == 0)
        new = branch(
            now.looks | now.over,
            lambda: self.looked(now, seen, agree),
            lambda: self.stepped(now),
        )
        changes = jnp.where(now.looks, ~agree, now.keeps & new.solved) & ~new.over
        return branch(changes, lambda: self.align(new, events, now.keeps), lambda: new)

    def looked(self, now: Loop, seen: FlagScan, agree: Bool[Array, ""]) -> Loop:
        """Return the loop's state after the flags `seen` along the motion.

        `agree`: whether they change exactly at the events of the mesh. The roots for the next step
        come from the search, since those of Newton's method lag behind."""
        keeps = agree & now.solved & (apart(now.elements, seen) <= _FAR)
        motion = choose(agree, rooted(self.frozen, now.elements, seen), now.elements)
        return now._replace(
            turns=now.turns + 1,
            elements=motion,
            rivals=now.rivals.rooted(now.elements, motion),
            looks=~agree,
            keeps=keeps,
            size=jnp.full_like(now.size, jnp.inf),
            tries=jnp.zeros_like(now.tries),
        )

    def run(self) -> Loop:
        """Return the final state of the loop."""
        return lax.while_loop(
            lambda now: ~now.over & (now.turns < _TURNS), lambda now: self.turn(now), self.start()
        )

    def align(self, now: Loop, events: Events, finer: Bool[Array, ""]) -> Loop:
        """Return the loop's state with the motion on a mesh that ends at its `events`.

        `finer`: whether the mesh already ends at all events, and the new one has more elements."""
        mesh, same = now.elements.mesh, (events.new == 0) & (events.gone == 0)
        events = branch(same, lambda: known_events(self.frozen_at(now), mesh), lambda: events)
        taken = mesh.used
        first = jnp.round(_SHARE * self.denser * taken).astype(int) + _EVENT * events.count
        first = jnp.maximum(first, _BOUNCE * events.count)
        used = jnp.where(now.fits, jnp.where(finer, (_FINER * taken).astype(int), taken), first)
        most = self.most(now)
        used = jnp.maximum(snug(jnp.minimum(used, most)), events.count + 2)
        used = jnp.minimum(used, now.elements.state.shape[0] - 1)
        density = choose(now.fits, needed(now.elements), counted(now.elements))
        new = aligned(now.elements, (events.times, events.which), density, used)
        yes = jnp.ones((), bool)
        return now._replace(
            elements=new,
            rivals=now.rivals.moved(now.elements, new),
            looks=~finer,
            keeps=~yes,
            fits=yes,
            solved=~yes,
            size=jnp.full_like(now.size, jnp.inf),
            tries=jnp.zeros_like(now.tries),
            over=~events.fits,
        )

    def stepped(self, now: Loop) -> Loop:
        """Return the loop's state after a step of Newton's method."""
        equation, points, direct, step, line = self.step(now)
        at, extra = now.elements, now.elements.mesh.used
        roots = points.roots.at[extra].set(at.roots[extra])
        moved, size, _ = advanced(at, step, roots)
        along = forces_along(equation, points)
        peak = peak_of(at, now.rivals, *along)

        def kept() -> Loop:
            orbit = forces_of(equation, at, peak, (points, direct), step, moved)
            return self.keep(now._replace(line=line), orbit, moved)

        def goes_on() -> Loop:
            rivals = rivals_of(at, points, *along, now.rivals)
            found = is_settled(now.rivals, rivals, peak, self.tolerance / USUAL)
            after = now._replace(elements=moved, rivals=rivals, line=line)
            return self.judged(now, after, size, found)

        return branch(now.keeps, kept, goes_on)._replace(steps=now.steps + ~now.keeps)

    def judged(self, now: Loop, after: Loop, size: Float[Array, ""], found: Any) -> Loop:
        """Return the loop's state `after` a step of the given size.

        If the step is small enough and the peak is `found`, the motion is solved. Where rounding
        keeps steps above the limit, the method ends when they no longer shrink."""
        limit, tries = self.limit, now.tries + 1
        stalled = (size < _ROUNDING[0]) & (size > _ROUNDING[1] * now.size)
        # A size of NaN also ends the method.
        ends = ~(size > limit) | stalled
        ends = (ends & (found | ~jnp.isfinite(size))) | (tries >= _STEPS)
        # Where events have passed each other, the elements between them have a negative length.
        mesh, rising = ordered(after.elements.mesh)
        good = rising & (stalled | (size <= 10 * limit))
        mesh = choose(ends, mesh, after.elements.mesh)
        # After a failure, the loop finds the events of the last motion and tries again.
        failures = now.failures + (ends & ~good)
        return after._replace(
            elements=after.elements._replace(mesh=mesh),
            looks=ends,
            trusted=now.trusted & ~ends,
            solved=ends & good,
            size=size,
            tries=tries,
            failures=failures,
            over=ends & (~jnp.isfinite(size) | (failures > _FAILURES)),
        )

    def uncompared(self, size: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the estimated errors of forces and derivatives on a first mesh.

        They follow from those of the known orbit, or else from the roughness `size`."""
        known, (force, slope, least) = self.known, _UNCOMPARED
        growth, rough = jnp.maximum(size / known.roughness, 1.0) ** 2, jnp.maximum(size, least)
        known_errors = known.error * growth, known.drift * growth
        return choose(known.aligned, known_errors, (force * rough, slope * rough))

    def keep(self, now: Loop, new: Orbit, motion: Elements) -> Loop:
        """Return the loop's state with the `new` orbit, its corrected `motion` and errors."""
        size = roughness(motion)
        first = now.meshes == 0
        apart, turned = differences(now.orbit, new, self.frozen.force_scale)
        force, slope = gained(now.known.elements.mesh.used, now.elements.mesh.used)
        compared = apart / force, turned / slope + _ROUGH
        error, drift = choose(first, self.uncompared(size), compared)
        steep, least, most = _TURNING
        certain = drift <= jnp.clip(steep * self.tolerance, least, most)
        # Until two meshes have been compared, even a slightly finer mesh helps.
        full = jnp.where(first, 1.0, _LAST) * now.elements.mesh.used >= self.most(now)
        # Newton's method has converged, so the correction must be small. It is NaN where the time
        # derivative of a margin vanishes at its event. Derivatives are those before the correction:
        # if it is not yet negligible, they are computed once more.
        correction = new.residual
        good = correction < corrected(self.tolerance)
        falls = correction < _STALLED * now.size
        failures = now.failures + ~good
        negligible = _NEGLIGIBLE * jnp.maximum(self.tolerance / USUAL, 1.0)
        again = jnp.isfinite(correction) & falls & (correction > negligible)
        again &= failures <= _FAILURES
        least = jnp.where(first & self.known.aligned, self.known.roughness, 0.0)
        yes = jnp.ones((), bool)
        known = KnownOrbit(motion, jnp.maximum(size, least), error, drift, yes, yes)
        orbit, known = choose(good & ~again, (new, known), (now.orbit, now.known))
        reached = ((error <= self.tolerance) & certain) | full
        return now._replace(
            orbit=orbit,
            known=known,
            elements=motion,
            solved=good & ~again,
            size=correction,
            failures=failures,
            meshes=now.meshes + (good & ~again),
            over=~again & (reached | ~good),
        )
