"""A motion as polynomials on elements. Every event is the end of an element.

Events are instants at which the equation of motion is not smooth. They divide the period into
*intervals*. Each interval consists of one or more elements, at fixed fractions of its length. All
elements therefore move when the events at the ends of their interval move.

On an element of length h, the state is z(σ) = z(0) + h Σ a_j(σ) k_j for 0 ≤ σ ≤ 1. The k_j are the
slopes at the s Gauss points c_j, and a_j is the integral of the j-th Lagrange polynomial. The error
is of order 2s at the end of the element, and of order s + 1 inside the element. See de Boor and
Swartz, SIAM J. Numer. Anal. 10 (1973) 582-606.

The arrays of a mesh have room for more elements than the mesh uses. Blocks of unused elements are
not evaluated. `zero_of` locates an event inside an element.
"""

import functools
import operator
from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

POINTS = 4
"""Number s of Gauss points per element."""

# Greatest error (mesh periods) of a located event. The second number determines how far beyond the
# chord's root the next instant is, so that both ends of the range approach the event.
_LOCATED, _STEEP = 3e-10, 0.2


class Gauss(NamedTuple):
    """Gauss-Legendre rule with s points on the interval from 0 to 1.

    `nodes` (s,): points c_i; `weights` (s,); `integral` (s, s): a_j(c_i), the matrix of the
    Runge-Kutta method; `powers` (s, s): matrix that converts values at the points to coefficients
    of powers of σ.
    """

    nodes: NDArray[np.float64]
    weights: NDArray[np.float64]
    integral: NDArray[np.float64]
    powers: NDArray[np.float64]

    @classmethod
    def of(cls, count: int) -> "Gauss":
        """Return the rule with `count` points."""
        node, weight = np.polynomial.legendre.leggauss(count)
        node, weight = (node + 1) / 2, weight / 2
        powers = np.asarray(np.linalg.inv(np.vander(node, count, increasing=True)), np.float64)
        order = np.arange(1, count + 1)
        integral = (node[:, None] ** order / order) @ powers
        return cls(node, weight, integral, powers)

    def lagrange(self, share: Float[Array, "*m"]) -> Float[Array, "*m s"]:
        """Return the s Lagrange polynomials at σ = `share`."""
        return _polynomials(self.powers, share)

    def integrated(self, share: Float[Array, "*m"]) -> Float[Array, "*m s"]:
        """Return the integrals a_j of the s Lagrange polynomials from 0 to σ = `share`."""
        order = np.arange(1, len(self.nodes) + 1)
        return share[..., None] * _polynomials(self.powers / order[:, None], share)

    def derivative(self, share: Float[Array, "*m"]) -> Float[Array, "*m s"]:
        """Return the derivatives of the s Lagrange polynomials at σ = `share`."""
        order = np.arange(1, len(self.nodes))
        return _polynomials(order[:, None] * self.powers[1:], share)

    def inside(self, slopes: Float[Array, "e s *c"]) -> Float[Array, "e s *c"]:
        """Return the integrals of `slopes` (values at the s points) from 0 to each of the points.

        The integrals are those over elements of length 1."""
        rows = self.integral.T.reshape(*self.integral.shape, *(1,) * (slopes.ndim - 2))
        return summed(row * slopes[:, j, None] for j, row in enumerate(rows))

    def whole(self, slopes: Float[Array, "e s *c"]) -> Float[Array, "e ..."]:
        """Return the integrals of `slopes` (values at the s points) over elements of length 1."""
        return summed(weight * slopes[:, j] for j, weight in enumerate(self.weights))


def _polynomials(powers: NDArray[np.float64], share: Float[Array, "*m"]) -> Float[Array, "*m s"]:
    """Return s polynomials at σ = `share`; `powers` (p, s): coefficients, constants first."""
    share = share[..., None]
    values = jnp.broadcast_to(jnp.asarray(powers[-1]), (*share.shape[:-1], powers.shape[1]))
    for row in powers[-2::-1]:
        values = values * share + row
    return values


def summed(terms: Iterable[Array]) -> Array:
    """Return the sum of a few arrays of equal shape.

    XLA computes this in one loop over their entries. A reduction over a short axis is slower."""
    return functools.reduce(operator.add, terms)


GAUSS = Gauss.of(POINTS)


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
    def filled(self) -> Bool[Array, " e"]:
        """Whether each element is in use."""
        return jnp.arange(self.interval.shape[0]) < self.used

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
        k = jnp.sum(mesh.filled & (begin <= tau[..., None]), axis=-1) - 1
        return jnp.maximum(k, 0), tau

    def place_of(self, tau: Float[Array, "*m"]) -> tuple[Int[Array, "*m"], Float[Array, "*m"]]:
        """Return the index of the element that contains each of the times `tau` (mesh periods),
        and the times as fractions of it.

        The search is a bisection; `holding` compares every time with all elements."""
        mesh = self.mesh
        tau = mesh.times[0] + jnp.mod(tau - mesh.times[0], mesh.period)
        k = jnp.searchsorted(mesh.ends[0], tau, side="right") - 1
        k = jnp.clip(k, 0, mesh.used - 1)
        return k, self.share(k, tau)

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


BLOCK = 48
"""Number of elements evaluated together. The arrays of a mesh have room for a multiple of this
number."""


@custom_vmap
def greatest(count: Int[Array, ""]) -> Int[Array, ""]:
    """Return `count` or, in a batch, the greatest of the batch.

    If all motions of a batch have the same number of iterations, a loop writes only new values.
    Otherwise, every iteration would copy all arrays, to keep those of finished motions."""
    return count


@greatest.def_vmap
def _(size, batched, count):
    return jnp.max(count), False


def whole_blocks(*arrays: Array) -> list[Array]:
    """Return `arrays`, padded with zeros to a whole number of blocks."""
    spare = -arrays[0].shape[0] % BLOCK
    return [jnp.pad(x, ((0, spare), *((0, 0),) * (x.ndim - 1))) for x in arrays]


def in_blocks(function: Any, used: Int[Array, ""], *arrays: Any) -> Any:
    """Return `function(*arrays)`, evaluated block by block along the leading axis of elements.

    `function` maps arrays (e, …) of e elements to arrays (e, …); `used`: number of elements in use.
    Blocks without such elements are not evaluated, except in a batch, where another motion uses
    them; their results have no meaning."""
    count = jax.tree.leaves(arrays)[0].shape[0]
    size = min(BLOCK, count)

    def sliced(begin):
        return jax.tree.map(lambda x: lax.dynamic_slice_in_dim(x, begin, size), arrays)

    function = eqx.filter_closure_convert(function, *sliced(0))  # traced once
    shapes = function.out_struct
    nothing = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), shapes)
    # The numbers of a pair enter the loop as one vector. XLA would copy each of them.
    numbers, rest = eqx.partition(function, eqx.is_inexact_array)
    vector, back = ravel_pytree(numbers)

    def block(number, results):
        begin = number * size
        new = eqx.combine(back(vector), rest)(*sliced(begin))
        return jax.tree.map(
            lambda old, x: lax.dynamic_update_slice_in_dim(old, x, begin, 0), results, new
        )

    return lax.fori_loop(0, greatest((used + size - 1) // size), block, nothing)


def zero_of(margin, low, high, positive):
    """Return the instant between `low` and `high` at which the sign of `margin` changes. Also
    return the second result of `margin` just before and just after this instant.

    `margin`: function of time (mesh periods), which returns the margin and another number;
    `positive`: whether the margin is positive at `low`. Chord and bisection are combined by the ITP
    method (Oliveira and Takahashi, ACM Trans. Math. Softw. 47 (2021) 5): a smooth margin takes
    about ten evaluations, any other margin hardly more than bisection."""
    width = high - low
    most = jnp.ceil(jnp.log2(jnp.maximum(width / (2 * _LOCATED), 1.0))) + 1

    def closer(ends):
        low, high, at_low, at_high, before, after, count = ends
        size, middle = high - low, (low + high) / 2
        spare = _LOCATED * 2 ** (most - count) - size / 2
        drop = at_low - at_high
        chord = low + size * at_low / drop
        chord = jnp.where((chord > low) & (chord < high), chord, middle)
        inwards = jnp.sign(middle - chord)
        beyond = _STEEP * size**2 / width
        near = jnp.where(beyond <= jnp.abs(middle - chord), chord + inwards * beyond, middle)
        inside = jnp.abs(near - middle) <= spare
        place = jnp.where(inside, near, middle - inwards * spare)
        # The first two iterations evaluate both ends, so that the margin is compiled once.
        place = jnp.where(count == -2, low, jnp.where(count == -1, high, place))
        here, beside = margin(place)
        lower = jnp.where(count < 0, count == -2, (here > 0) == positive)
        return (
            jnp.where(lower, place, low),
            jnp.where(lower, high, place),
            jnp.where(lower, here, at_low),
            jnp.where(lower, at_high, here),
            jnp.where(lower, beside, before),
            jnp.where(lower, after, beside),
            count + 1,
        )

    def wide(ends):
        return (ends[1] - ends[0] > 2 * _LOCATED) & (ends[-1] <= most)

    start = low, high, *[jnp.zeros_like(low)] * 4, jnp.full_like(most, -2)
    low, high, _, _, before, after, _ = lax.while_loop(wide, closer, start)
    return (low + high) / 2, before, after
