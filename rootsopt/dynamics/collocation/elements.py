"""An orbit as polynomials on elements, some of which end at events.

The period is cut into *intervals* by events, instants at which the equation of motion is not
smooth. An interval has one or more elements, at fixed shares of its length, so that all elements
move when the events at its ends do.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.gauss import GAUSS


class Mesh(NamedTuple):
    """Elements of one period of an orbit.

    `times` (m,): start of the period, its events, and from the last event on the end of the period
    (mesh periods); `which` (m,): number of the margin that is zero at each of these times, -1 where
    the time is fixed; `interval` (e,): index of the time at which an element's interval begins;
    `left`, `right` (e,): shares of the interval at which the element begins and ends; `used`:
    number of elements; all others have no length and lie at the end.
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
        """Whether an element is the last one of its interval."""
        following = jnp.append(self.interval[1:], -1)
        number = jnp.arange(self.interval.shape[0])
        return (self.interval != following) | (number >= self.used - 1)

    @property
    def period(self) -> Float[Array, ""]:
        """Length of the orbit (mesh periods)."""
        return self.times[-1] - self.times[0]


class Elements(NamedTuple):
    """A motion on a mesh.

    `state` (e, n): scaled state at the start of each element; `slopes` (e, s, n): its derivative at
    the Gauss points; `roots` (e, s + 1, sides, 2): see `NearContact`, at the Gauss points and at
    the element's end.
    """

    mesh: Mesh
    state: Float[Array, "e n"]
    slopes: Float[Array, "e s n"]
    roots: Float[Array, "e p sides 2"]

    @property
    def places(self) -> tuple[Float[Array, "e p"], Float[Array, "e p n"]]:
        """Times (mesh periods) and scaled states at the Gauss points and the end of each element.

        The state at the end is the one at which the next element starts."""
        begin, end = self.mesh.ends
        length = self.mesh.lengths
        tau = jnp.append(begin[:, None] + length[:, None] * GAUSS.nodes, end[:, None], axis=1)
        rise = jnp.sum(GAUSS.integral[:, :, None] * self.slopes[:, None], axis=2)
        inside = self.state[:, None] + length[:, None, None] * rise
        return tau, jnp.concatenate([inside, self.following[:, None]], axis=1)

    @property
    def following(self) -> Float[Array, "e n"]:
        """State at the start of the next element; of the first one, for the last."""
        number = jnp.arange(self.state.shape[0])
        return self.state[jnp.where(number + 1 < self.mesh.used, number + 1, 0)]

    def motion(self, tau: Float[Array, ""]) -> Float[Array, " n"]:
        """Return the scaled state at the time `tau` (mesh periods)."""
        mesh = self.mesh
        begin = mesh.ends[0]
        tau = mesh.times[0] + jnp.mod(tau - mesh.times[0], mesh.period)
        k = jnp.clip(jnp.searchsorted(begin, tau, side="right") - 1, 0, mesh.used - 1)
        return self.inside(k, tau)

    def inside(self, k: Int[Array, ""], tau: Float[Array, ""]) -> Float[Array, " n"]:
        """Return the scaled state at `tau` (mesh periods) by the polynomial of element `k`."""
        length = self.mesh.lengths[k]
        share = (tau - self.mesh.ends[0][k]) / jnp.where(length > 0, length, 1.0)
        rise = jnp.sum(GAUSS.integrated(share)[:, None] * self.slopes[k], axis=0)
        return self.state[k] + length * rise
