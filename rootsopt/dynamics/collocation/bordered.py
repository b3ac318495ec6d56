"""Periodic orbits along a curve: Newton's method for the orbit and for a parameter.

In addition to the motion and the times of the events, a parameter of the pair is unknown here. One
further equation closes the system: the orbit's place (the state at φ1 = 0 and the parameter) lies
in a plane. The matrix with this border is also regular at folds, where the matrix for a fixed
parameter is singular (Keller 1977). Mesh and events are found as for single orbits (`closing`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.dynamics.collocation.closing import Closer, Loop
from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.collocation.equation import CollocatedEquation, Points
from rootsopt.dynamics.collocation.events import look, rooted
from rootsopt.dynamics.collocation.mesh import KnownOrbit, ordered
from rootsopt.dynamics.collocation.newton import (
    advanced,
    columns_of,
    evaluated,
    lines,
    numbers,
    origin,
)
from rootsopt.dynamics.collocation.system import (
    Chain,
    Step,
    condensed,
    opened,
    spread,
    unchanged,
)
from rootsopt.dynamics.linear import solved
from rootsopt.dynamics.orbit import Measures, Orbit, choose
from rootsopt.dynamics.pair import RotorPair

# Maximum number of Newton steps.
_TURNS = 12
# Newton step (scaled) below which Newton's method stops.
_SMALL = 1e-10

Family = Callable[[Float[Array, ""]], tuple[RotorPair, RotorPair]]
"""Type of a function that maps a parameter to (pair, its derivative with respect to the parameter).
The derivative has a leading axis of length 1."""


class Plane(NamedTuple):
    """The plane in which an orbit's place must lie.

    A place (n + 1,) consists of the scaled state at φ1 = 0, divided by `span`, and the parameter.
    `through` (n + 1,): a place in the plane; `normal` (n + 1,): direction normal to the plane.
    """

    through: Float[Array, " m"]
    normal: Float[Array, " m"]
    span: Float[Array, ""]


class Line(NamedTuple):
    """The solution curve at an orbit, linearised.

    `share`: the parameter; `residual`: greatest difference between the start and the end of the
    open motion (scaled); `monodromy` (n, n) and `by_share` (n,): derivatives of the end of the
    motion with respect to the state at the start of the mesh, and to the parameter; `to_state` (n,
    n): derivative of the state at φ1 = 0 with respect to that at the start of the mesh; `inner` (n
    + 1,): direction of the curve, as a change of the state at the start of the mesh and of the
    parameter; `tangent` (n + 1,): the same direction as a unit vector of places; `motion`: change
    of the whole motion along it.
    """

    share: Float[Array, ""]
    residual: Float[Array, ""]
    monodromy: Float[Array, "n n"]
    by_share: Float[Array, " n"]
    to_state: Float[Array, "n n"]
    inner: Float[Array, " m"]
    tangent: Float[Array, " m"]
    motion: Step


class Followed(NamedTuple):
    """An orbit on a curve.

    `orbit`: its forces, without derivatives; `line`: the curve there; `known`: its motion, from
    which the next one can be computed. It is `sound` if Newton's method has converged on a mesh
    that ends at the orbit's events.
    """

    orbit: Orbit
    line: Line
    known: KnownOrbit


def moved_along(
    known: KnownOrbit, motion: Step, distance: Float[Array, ""]
) -> tuple[KnownOrbit, Bool[Array, ""]]:
    """Return the orbit `known`, moved by a `distance` along the curve; `motion`: `Line.motion`.

    Its `Elements.roots` are not valid any more. Also return whether all events keep their order."""
    old = known.elements
    times = old.mesh.times + distance * motion.times[:, 0]
    mesh, rising = ordered(old.mesh._replace(times=times))
    elements = Elements(
        mesh,
        old.state + distance * motion.state[..., 0],
        old.slopes + distance * motion.slopes[..., 0],
        old.roots,
    )
    return known._replace(elements=elements), rising


class _Follower(Closer):
    """The loop of `followed`.

    `family`: pairs of the curve; `plane`: see `Plane`; `rising`: whether all events of the known
    orbit have kept their order (`moved_along`). The other fields are those of `Closer`, for the
    parameter at the start."""

    family: Family = eqx.field(kw_only=True)
    plane: Plane = eqx.field(kw_only=True)
    rising: Bool[Array, ""] = eqx.field(kw_only=True)

    def start(self) -> Loop:
        loop, share = super().start(), self.plane.through[-1]
        count, motion = loop.elements.state.shape[1], unchanged(loop.elements, 1)
        square, row, place = jnp.zeros((count, count)), jnp.zeros(count), jnp.zeros(count + 1)
        line = Line(share, jnp.asarray(jnp.inf), square, row, square, place, place, motion)
        trusted = loop.trusted & self.rising
        return loop._replace(looks=~trusted, trusted=trusted, line=line)

    def frozen_at(self, now: Loop) -> RotorPair:
        return lax.stop_gradient(self.family(now.line.share)[0])

    @property
    def limit(self) -> Float[Array, ""]:
        return jnp.asarray(_SMALL)

    def judged(self, now: Loop, after: Loop, size: Float[Array, ""], found: Any) -> Loop:
        """Return the loop's state `after` a step of the given size.

        If events of the known orbit are missing on the new one, their equations have no solution.
        The flags along the motion at the start then show the events."""
        size = jnp.maximum(size, jnp.abs(after.line.share - now.line.share))
        new = super().judged(now, after, size, found)
        lost = now.trusted & new.looks & ~new.solved
        restarted = self.start()._replace(
            looks=lost,
            trusted=~lost,
            orbit=new.orbit,
            known=new.known,
            turns=new.turns,
            steps=new.steps,
            failures=new.failures,
        )
        return choose(lost, restarted, new)

    def step(self, now: Loop) -> tuple[CollocatedEquation, Points, Array, Step, Line]:
        """Solve the linearised equation together with that of the plane, as `Closer.step`."""
        at, line = now.elements, now.line
        pair, tangent = self.family(line.share)
        equation = CollocatedEquation(pair, self.equation.measures)
        count, yes = at.state.shape[1], jnp.ones((), bool)
        points, along = evaluated(equation, numbers(pair), at, now.rivals, tangent, yes)
        linearised = lines(at, points)
        columns = columns_of(at, linearised, along)
        parts = condensed(at, linearised, columns)
        chain = opened(at, linearised, columns, parts)
        change, inner, to_state, tangent = self._bordered(at, chain, line.share)
        step = spread(at, parts, chain, change[:count, None], _mixed(1.0, change[-1]))
        motion = spread(at, parts, chain, inner[:count, None], _mixed(0.0, inner[-1]))
        share = advanced(at, step, at.roots)[2]
        new = Line(
            share=line.share + share * change[-1],
            residual=jnp.max(jnp.abs(chain.end[:, count])),
            monodromy=chain.monodromy,
            by_share=chain.end[:, count + 1],
            to_state=to_state,
            inner=inner,
            tangent=tangent,
            motion=motion,
        )
        return equation, points, along * change[-1], step, new

    def _bordered(self, elements: Elements, chain: Chain, share: Float[Array, ""]):
        """Solve the closing equations together with that of the plane.

        `chain`: solution of the open equations, with one column for Newton's step and one for the
        parameter. Return the change of the state at the start of the mesh and of the parameter (n +
        1,), and `Line.inner`, `Line.to_state`, `Line.tangent`."""
        count = elements.state.shape[1]
        through, normal, span = self.plane
        at = origin(elements)
        rows, state = chain.state[at] / span, elements.state[at] / span
        border = normal[:count] @ rows
        last = jnp.append(border[:count], border[count + 1] + normal[-1])
        first = jnp.column_stack([jnp.eye(count) - chain.monodromy, -chain.end[:, count + 1]])
        miss = normal @ (jnp.append(state, share) - through) + border[count]
        right = jnp.stack([jnp.append(chain.end[:, count], -miss), jnp.eye(count + 1)[-1]], axis=1)
        change, inner = solved(jnp.concatenate([first, last[None]]), right).T
        moved = rows[:, :count] @ inner[:count] + rows[:, count + 1] * inner[-1]
        place = jnp.append(moved, inner[-1])
        length = jnp.linalg.norm(place)
        return change, inner / length, chain.state[at][:, :count], place / length


def _mixed(own: float, by_share: Float[Array, ""]) -> Float[Array, "2 1"]:
    """Return factors of the two right-hand sides: that of Newton's step, and the parameter's."""
    return jnp.stack([jnp.full_like(by_share, own), by_share])[:, None]


def followed(
    family: Family,
    measures: Measures,
    start: tuple[KnownOrbit, Step, Float[Array, ""]],
    plane: Plane,
    tolerance: Float[Array, ""],
) -> Followed:
    """Return the orbit near a known motion whose place lies in a `plane`.

    `family`: pairs along the curve; `measures`: averages of the force; `start`: arguments of
    `moved_along`, which returns the known motion; `tolerance`: relative error of the forces to
    reach. The first parameter is that of `Plane.through`."""
    known, rising = moved_along(*start)
    pair, _ = family(plane.through[-1])
    frozen = lax.stop_gradient(pair)
    equation = CollocatedEquation(pair, measures)
    nothing = jax.tree.map(
        lambda x: jnp.zeros((0, *x.shape)), eqx.filter(pair, eqx.is_inexact_array)
    )
    searched = rooted(frozen, known.elements, look(frozen, known.elements))
    known = known._replace(elements=searched)
    loop = _Follower(
        equation, frozen, nothing, known, numbers(frozen), tolerance,
        family=family, plane=plane, rising=rising,
    ).run()  # fmt: skip
    return Followed(loop.orbit, loop.line, loop.known)
