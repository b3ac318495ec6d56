"""The equation of motion at one instant, with its derivatives, next to a known contact."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rootsopt.contact.near import NearContact
from rootsopt.contact.search import SearchContact
from rootsopt.dynamics.measures import Measures
from rootsopt.dynamics.pair import RotorPair


class Point(NamedTuple):
    """The equation at an instant.

    `values` (r,): slope of the state (n,), integrands of the measures (see `Equation`) and the
    margin asked for; `slopes` (r, 1 + n): their derivatives with respect to time and state;
    `roots` (sides, 2): see `NearContact`; `force`: contact force (N); `depth`: penetration (m).
    """

    values: Float[Array, " r"]
    slopes: Float[Array, "r c"]
    roots: Float[Array, "sides 2"]
    force: Float[Array, ""]
    depth: Float[Array, ""]


class Equation(eqx.Module):
    """The equation of motion of a pair with the integrands of the measures.

    The integrands are those of `measures`, in the solver's unit of force. Where rotor 1 is free
    they are times the lapse of time, which is then the last integrand. `top` (N): roughly the
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
        """Number of sides of the flanks that can touch at once."""
        return 1 + self.pair.two_sided

    def near(self, dynamic: Any, static: Any, roots: Float[Array, "sides 2"]) -> RotorPair:
        """Return the pair with a contact that starts from known roots."""
        pair: RotorPair = eqx.combine(dynamic, static)
        assert isinstance(pair.contact, SearchContact)
        return eqx.tree_at(lambda p: p.contact, pair, NearContact(pair.contact.pair, roots))

    def evaluated(self, dynamic, static, tau, state, roots, which):
        """Return `Point.values`, and its roots, force and depth."""
        near = self.near(dynamic, static, roots)
        slope, contact = near.derivative(tau, state)
        unit = jax.lax.stop_gradient(self.pair.force_scale)
        top = jax.lax.stop_gradient(self.top) / unit
        rates = self.measures.rates(tau, contact.total / unit, top)
        if near.free:
            rates = near.lapse(state) * jnp.append(rates, jnp.ones_like(unit))
        found = near.margins(tau, state)
        values = jnp.concatenate([slope, rates, found.values[which][None]])
        return values, (_roots(found.places), contact.total, contact.depth)

    def force(
        self, tau: Float[Array, ""], state: Float[Array, " n"], roots: Float[Array, "sides 2"]
    ) -> tuple[Float[Array, ""], Float[Array, "sides 2"]]:
        """Return the contact force (N) and the roots there."""
        near = self.near(*eqx.partition(self.pair, eqx.is_inexact_array), roots)
        places = near.margins(tau, state).places
        return near.contact_at(tau, state).total, _roots(places)

    def point(
        self,
        tau: Float[Array, ""],
        state: Float[Array, " n"],
        roots: Float[Array, "sides 2"],
        which: Int[Array, ""],
    ) -> Point:
        """Return the equation at `tau` (mesh periods) and the scaled `state`, with the margin of
        number `which`."""
        dynamic, static = eqx.partition(self.pair, eqx.is_inexact_array)

        def value(place):
            return self.evaluated(dynamic, static, place[0], place[1:], roots, which)

        place = jnp.append(tau, state)
        values, linear, rest = jax.linearize(value, place, has_aux=True)
        slopes = jax.vmap(linear)(jnp.eye(place.shape[0], dtype=place.dtype))
        return Point(values, slopes.T, *rest)

    def along(
        self,
        tau: Float[Array, ""],
        state: Float[Array, " n"],
        roots: Float[Array, "sides 2"],
        which: Int[Array, ""],
        tangents: Any,
    ) -> tuple[Point, Float[Array, "r d"]]:
        """Return `point`, and the derivatives of its values along `tangents` (d, …) of the pair."""
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
        slopes = jax.vmap(linear)(moved, unit).T
        return Point(values, slopes[:, :size], *rest), slopes[:, size:]


def _roots(places: list[Any]) -> Float[Array, "sides 2"]:
    """Return the roots that a `NearContact` has found."""
    moved = [
        jnp.stack([own.normal2, own.normal2 if rival is None else rival.normal2])
        for own, rival in places
    ]
    return jnp.stack(moved)
