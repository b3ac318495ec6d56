"""The equation of motion at one instant, and its derivatives, for a contact known approximately."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rootsopt.contact.near import NearContact
from rootsopt.contact.search import SearchContact
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.pair import RotorPair
from rootsopt.runtime.kept import kept


class Point(NamedTuple):
    """The equation of motion at one instant, as r = n + q + 1 values.

    `values` (r,): derivatives of the n scaled states with respect to time (mesh periods), q
    integrands (see `CollocatedEquation`), and one margin (see `Margins`); `slopes` (r, 1 + n):
    derivatives of `values` with respect to time and state; `roots` (sides, 2): improved
    `NearContact.roots`; `force`: contact force (N); `depth`: penetration (m).
    """

    values: Float[Array, " r"]
    slopes: Float[Array, "r c"]
    roots: Float[Array, "sides 2"]
    force: Float[Array, ""]
    depth: Float[Array, ""]


class CollocatedEquation(eqx.Module):
    """The equation of motion of a `pair`, together with the integrands of `measures`.

    Forces in the integrands are in units of `pair.force_scale`. If rotor 1 is free, the integrands
    are multiplied by `RotorPair.lapse`, which is also the last integrand. `top` (N): roughly the
    greatest force.
    """

    pair: RotorPair
    measures: Measures
    top: Float[Array, ""]

    @property
    def rates(self) -> int:
        """Number of integrands."""
        return self.measures.count + self.pair.free

    @property
    def sides(self) -> int:
        """Number of flank sides (drive, coast) that can touch at once."""
        return 1 + self.pair.two_sided

    def near(self, dynamic: Any, static: Any, roots: Float[Array, "sides 2"]) -> RotorPair:
        """Return the pair with a contact evaluated near known `roots` (see `NearContact`).

        `dynamic`, `static`: the pair's floating-point arrays, and the rest of the pair."""
        pair: RotorPair = eqx.combine(dynamic, static)
        assert isinstance(pair.contact, SearchContact)
        return eqx.tree_at(lambda p: p.contact, pair, NearContact(pair.contact.pair, roots))

    def evaluated(self, dynamic, static, tau, state, roots, which):
        """Return the list of `Point.values`, and the tuple (roots, force, depth) of other fields.

        `dynamic`, `static`: the pair's floating-point arrays, and the rest of the pair. For the
        other arguments, see `point`."""
        near = self.near(dynamic, static, roots)
        slope, contact, found = near.derivative_and_margins(tau, state)
        unit = jax.lax.stop_gradient(self.pair.force_scale)
        top = jax.lax.stop_gradient(self.top) / unit
        rates = self.measures.rates(tau, contact.total / unit, top)
        if near.free:
            rates = near.lapse(state) * jnp.append(rates, jnp.ones_like(unit))
        values = [*slope, *rates, found.values[which]]
        return values, (_roots(found.places), contact.total, contact.depth)

    def force(
        self, tau: Float[Array, ""], state: Float[Array, " n"], roots: Float[Array, "sides 2"]
    ) -> tuple[Float[Array, ""], Float[Array, "sides 2"]]:
        """Return the contact force (N), and the improved `roots`.

        `tau`: time (mesh periods); `state` (n,): scaled; `roots` (sides, 2):
        `NearContact.roots`."""
        near = self.near(*eqx.partition(self.pair, eqx.is_inexact_array), roots)
        contact, margins = near.contact_and_margins(tau, state)
        return contact.total, _roots(margins.places)

    def point(
        self,
        tau: Float[Array, ""],
        state: Float[Array, " n"],
        roots: Float[Array, "sides 2"],
        which: Int[Array, ""],
    ) -> Point:
        """Return the equation and its derivatives at one instant.

        `tau`: time (mesh periods); `state` (n,): scaled; `roots` (sides, 2): `NearContact.roots`;
        `which`: index of the margin to evaluate."""
        dynamic, static = eqx.partition(self.pair, eqx.is_inexact_array)

        def value(place):
            return self.evaluated(dynamic, static, place[0], place[1:], roots, which)

        place = jnp.append(tau, state)
        values, linear, rest = jax.linearize(value, place, has_aux=True)
        slopes = jax.vmap(kept(linear))(jnp.eye(place.shape[0], dtype=place.dtype))
        return Point(jnp.stack(values), jnp.stack(kept(slopes)), *rest)

    def along(
        self,
        tau: Float[Array, ""],
        state: Float[Array, " n"],
        roots: Float[Array, "sides 2"],
        which: Int[Array, ""],
        tangents: Any,
    ) -> tuple[Point, Float[Array, "r d"]]:
        """Return the result of `point`, and derivatives of `Point.values` along d directions.

        `tangents`: directions of the pair's parameters, stacked along a leading axis. For the other
        arguments, see `point`."""
        dynamic, static = eqx.partition(self.pair, eqx.is_inexact_array)
        moved = eqx.filter(tangents, eqx.is_inexact_array)

        def value(dynamic, place):
            return self.evaluated(dynamic, static, place[0], place[1:], roots, which)

        place = jnp.append(tau, state)
        size, count = place.shape[0], jax.tree.leaves(moved)[0].shape[0]
        values, linear, rest = jax.linearize(value, dynamic, place, has_aux=True)
        # All directions at once: first those of time and state, then those of the pair.
        moved = jax.tree.map(lambda x: jnp.pad(x, [(size, 0)] + [(0, 0)] * (x.ndim - 1)), moved)
        unit = jnp.eye(size + count, size, dtype=place.dtype)
        slopes = jnp.stack(kept(jax.vmap(kept(linear))(moved, unit)))
        return Point(jnp.stack(values), slopes[:, :size], *rest), slopes[:, size:]


def _roots(places: list[Any]) -> Float[Array, "sides 2"]:
    """Return the `NearContact.roots` improved by an evaluation.

    `places`: for each side, the closest approaches found (`Approach.place`)."""
    moved = [
        jnp.stack([own.normal2, own.normal2 if rival is None else rival.normal2])
        for own, rival in places
    ]
    return jnp.stack(moved)
