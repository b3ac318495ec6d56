"""The equation of motion at one instant, and its derivatives, for a contact known approximately."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.contact.gap import innermost
from rootsopt.contact.search import NearContact, SearchContact
from rootsopt.dynamics.collocation.elements import greatest
from rootsopt.dynamics.orbit import Measures
from rootsopt.dynamics.pair import RotorPair
from rootsopt.runtime.compute_once import compute_once


class Points(NamedTuple):
    """The equation of motion at p instants on each of e elements, as r = n + q + 1 values.

    `values` (e, p, r): derivatives of the n scaled states with respect to time (mesh periods), q
    integrands (see `CollocatedEquation`), and one margin (see `Margins`); `slopes` (e, p, r, 1 +
    n): derivatives of `values` with respect to time and state; `roots` (e, p, flanks, 2): improved
    `NearContact.roots`; `depth` (e, p): penetration (m).
    """

    values: Float[Array, "e p r"]
    slopes: Float[Array, "e p r c"]
    roots: Float[Array, "e p flanks 2"]
    depth: Float[Array, "e p"]


class CollocatedEquation(eqx.Module):
    """The equation of motion of a `pair`, together with the integrands of `measures`.

    Forces in the integrands are in units of `pair.force_scale`, which is roughly the greatest
    force. If rotor 1 is free, the integrands are multiplied by `RotorPair.lapse`, which is also the
    last integrand. `variation`: whether a closed orbit has its `Orbit.variation`.
    """

    pair: RotorPair
    measures: Measures
    variation: bool = eqx.field(static=True, default=False)

    @property
    def rates(self) -> int:
        """Number of integrands."""
        return self.measures.count + self.pair.free

    def near(self, dynamic: Any, static: Any, roots: Float[Array, "flanks 2"]) -> RotorPair:
        """Return the pair with a contact evaluated near known `roots` (see `NearContact`).

        `dynamic`, `static`: the pair's floating-point arrays, and the rest of the pair. Any contact
        other than a `SearchContact` is evaluated unchanged."""
        pair: RotorPair = eqx.combine(dynamic, static)
        searched = innermost(pair.contact)
        if type(searched) is not SearchContact:  # A subclass may search differently.
            return pair
        if pair.contact.slices is not None:
            roots = roots.reshape(pair.contact.sections, -1, 2)
        return eqx.tree_at(
            lambda pair: innermost(pair.contact), pair, NearContact(searched.pair, roots)
        )

    def evaluated(self, dynamic, static, tau, state, roots, which):
        """Return the equation at one instant: a list of values, and the tuple (roots, depth).

        `dynamic`, `static`: the pair's floating-point arrays, and the rest of the pair; `tau`: time
        (mesh periods); `state` (n,): scaled; `roots` (flanks, 2): `NearContact.roots`; `which`:
        index of the margin to evaluate. For the results, see `Points`."""
        near = self.near(dynamic, static, roots)
        slope, contact, margins = near.derivative_and_margins(tau, state)
        unit = jax.lax.stop_gradient(self.pair.force_scale)
        rates = self.measures.rates(tau, contact.total / unit)
        if near.free:
            rates = near.lapse(state) * jnp.append(rates, jnp.ones_like(unit))
        values = [*slope, *rates, margins.values[which]]
        if isinstance(innermost(near.contact), NearContact):
            roots = _roots(margins.places)
        return values, (roots, contact.depth)

    def along(
        self,
        tau: Float[Array, "e p"],
        state: Float[Array, "e p n"],
        roots: Float[Array, "e p flanks 2"],
        which: Int[Array, " e"],
        tangents: Any,
        whole: Bool[Array, ""],
    ) -> tuple[Points, Float[Array, "e p r d"]]:
        """Return the equation at p instants on each of e elements, and derivatives of its values
        along d directions.

        `tau`: times (mesh periods); `state`: scaled; `roots`: `NearContact.roots`; `which`: index
        of the margin to evaluate on each element; `tangents`: directions of the pair's parameters,
        stacked along a leading axis; `whole`: whether derivatives along them are needed. Otherwise
        they have no meaning. The instants are the last axis of all intermediate arrays, so that
        inner loops are long."""
        shape, size = tau.shape, 1 + state.shape[-1]
        dynamic, static = eqx.partition(self.pair, eqx.is_inexact_array)
        place = jnp.concatenate([tau.reshape(1, -1), state.reshape(-1, size - 1).T])
        rest = roots.reshape(-1, *roots.shape[2:]), jnp.repeat(which, shape[1])

        def value(dynamic, place):
            def one(place, roots, which):
                return self.evaluated(dynamic, static, place[0], place[1:], roots, which)

            return jax.vmap(one, (1, 0, 0))(place, *rest)

        values, linear, others = jax.linearize(value, dynamic, place, has_aux=True)
        moved = eqx.filter(tangents, eqx.is_inexact_array)
        count = jax.tree.leaves(moved)[0].shape[0]
        # Derivatives along as many directions at once as time and state have. Those along the
        # parameters come in further passes of the same code, since most steps do not need them.
        passes = 1 - (-count // size)

        def by_pass(rows):
            more = [(size, (passes - 1) * size - count)]
            rows = jnp.pad(rows, more + [(0, 0)] * (rows.ndim - 1))
            return rows.reshape(passes, size, *rows.shape[1:])

        moved = jax.tree.map(by_pass, moved)
        unit = jnp.eye(size, dtype=place.dtype)
        unit = jnp.zeros((passes, *unit.shape), place.dtype).at[0].set(unit)
        units = jnp.broadcast_to(unit[..., None], (*unit.shape, place.shape[1]))

        def derivatives(k, partials):
            own = jax.tree.map(lambda x: x[k], (moved, units))
            return partials.at[k].set(
                jnp.stack(compute_once(jax.vmap(compute_once(linear))(*own)), axis=1)
            )

        slopes = jnp.zeros((passes, size, len(values), place.shape[1]), place.dtype)
        slopes = lax.fori_loop(0, greatest(jnp.where(whole, passes, 1)), derivatives, slopes)
        slopes = jnp.moveaxis(slopes.reshape(passes * size, *slopes.shape[2:]), 0, 1)

        def back(x):
            """Move the last axis, that of the instants, to the front and split it."""
            return jnp.moveaxis(x, -1, 0).reshape(*shape, *x.shape[:-1])

        others = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), others)
        points = Points(back(jnp.stack(values)), back(slopes[:, :size]), *others)
        return points, back(slopes[:, size : size + count])


def _roots(places: Any) -> Float[Array, "flanks 2"]:
    """Return the `NearContact.roots` improved by an evaluation.

    `places`: the closest approaches found (`Margins.places`)."""
    own, rival = places
    return jnp.stack([own.normal2, own.normal2 if rival is None else rival.normal2], axis=-1)
