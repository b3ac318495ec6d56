"""A motion as polynomials on elements. Every event is the end of an element.

Events are instants at which the equation of motion is not smooth. They divide the period into
*intervals*. Each interval consists of one or more elements, at fixed fractions of its length. All
elements therefore move when the events at the ends of their interval move.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.gauss import GAUSS


class Mesh(NamedTuple):
    """Elements of one period of an orbit: m times, room for e elements.

    `times` (m,) in mesh periods: start of the period, events in ascending order, then the end of
    the period, repeated; `which` (m,): index of the margin (`Margins.values`) that is zero at each
    time, negative where the time stays (`events.FIXED`, `UNSAID`); `interval` (e,): index in
    `times` of the start of the interval that contains the element; `left`, `right` (e,): start and
    end of the element, as fractions of its interval; `used`: number of elements in use. The unused
    elements come last and have length 0.
    """

    times: Float[Array, " m"]
    which: Int[Array, " m"]
    interval: Int[Array, " e"]
    left: Float[Array, " e"]
    right: Float[Array, " e"]
    used: Int[Array, ""]

    @property
    def ends(self) -> tuple[Float[Array, " e"], Float[Array, " e"]]:
        """Start and end of each element (mesh periods)."""
        begin, end = self.times[self.interval], self.times[self.interval + 1]
        return begin + self.left * (end - begin), begin + self.right * (end - begin)

    @property
    def lengths(self) -> Float[Array, " e"]:
        """Length of each element (mesh periods)."""
        room = self.times[self.interval + 1] - self.times[self.interval]
        return (self.right - self.left) * room

    @property
    def last(self) -> Bool[Array, " e"]:
        """Whether each element is the last of its interval."""
        following = jnp.append(self.interval[1:], -1)
        number = jnp.arange(self.interval.shape[0])
        return (self.interval != following) | (number >= self.used - 1)

    @property
    def finals(self) -> Int[Array, " i"]:
        """Index of the last element of each of the m - 1 intervals."""
        number = jnp.arange(self.times.shape[0] - 1)
        after = jnp.searchsorted(self.interval, number, side="right")
        return jnp.minimum(after, self.used) - 1

    @property
    def period(self) -> Float[Array, ""]:
        """Length of the period (mesh periods)."""
        return self.times[-1] - self.times[0]


class Elements(NamedTuple):
    """A motion on a `mesh` of e elements with s Gauss points each.

    `state` (e, n): scaled state at the start of each element; `slopes` (e, s, n): derivative of the
    state with respect to time (mesh periods) at the Gauss points; `roots` (e, s + 1, flanks, 2):
    `NearContact.roots` at the Gauss points and at the end of each element.
    """

    mesh: Mesh
    state: Float[Array, "e n"]
    slopes: Float[Array, "e s n"]
    roots: Float[Array, "e p flanks 2"]

    @property
    def places(self) -> tuple[Float[Array, "e p"], Float[Array, "e p n"]]:
        """Times (e, s + 1) and scaled states (e, s + 1, n) at the Gauss points and the end of each
        element.

        Times are in mesh periods. The state at the end is the state at which the next element
        starts."""
        begin, end = self.mesh.ends
        length = self.mesh.lengths
        tau = jnp.append(begin[:, None] + length[:, None] * GAUSS.nodes, end[:, None], axis=1)
        inside = self.state[:, None] + length[:, None, None] * GAUSS.inside(self.slopes)
        return tau, jnp.concatenate([inside, self.following[:, None]], axis=1)

    @property
    def following(self) -> Float[Array, "e n"]:
        """Scaled state at the start of the next element; for the last element, at the start of the
        first."""
        number = jnp.arange(self.state.shape[0])
        return self.state[jnp.where(number + 1 < self.mesh.used, number + 1, 0)]

    def motion(self, tau: Float[Array, "*m"]) -> Float[Array, "*m n"]:
        """Return the scaled state at the times `tau` (mesh periods), continued periodically."""
        return self.inside(*self.holding(tau))

    def holding(self, tau: Float[Array, "*m"]) -> tuple[Int[Array, "*m"], Float[Array, "*m"]]:
        """Return the index of the element that contains each of the times `tau` (mesh periods),
        and the times, moved into the period of the mesh."""
        mesh = self.mesh
        begin = mesh.ends[0]
        tau = mesh.times[0] + jnp.mod(tau - mesh.times[0], mesh.period)
        used = jnp.arange(begin.shape[0]) < mesh.used
        k = jnp.sum(used & (begin <= tau[..., None]), axis=-1) - 1
        return jnp.maximum(k, 0), tau

    def share(self, k: Int[Array, "*m"], tau: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Return the times `tau` (mesh periods) as fractions of the elements `k`."""
        length = self.mesh.lengths[k]
        return (tau - self.mesh.ends[0][k]) / jnp.where(length > 0, length, 1.0)

    def inside(self, k: Int[Array, "*m"], tau: Float[Array, "*m"]) -> Float[Array, "*m n"]:
        """Return the scaled state at the times `tau` (mesh periods), from the polynomials of the
        elements `k`."""
        weights = GAUSS.integrated(self.share(k, tau))
        rise = jnp.sum(weights[..., None] * self.slopes[k], axis=-2)
        return self.state[k] + self.mesh.lengths[k][..., None] * rise
