"""Gauss points of an element, and the polynomial through the slopes at these points.

On an element of length h, the state is z(σ) = z(0) + h Σ a_j(σ) k_j for 0 ≤ σ ≤ 1. The k_j are the
slopes at the s Gauss points c_j, and a_j is the integral of the j-th Lagrange polynomial.

The error is of order 2s at the end of the element, and of order s + 1 inside the element. See de
Boor and Swartz, SIAM J. Numer. Anal. 10 (1973) 582-606.
"""

import functools
import operator
from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

POINTS = 4
"""Number s of Gauss points per element."""


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
    found = jnp.broadcast_to(jnp.asarray(powers[-1]), (*share.shape[:-1], powers.shape[1]))
    for row in powers[-2::-1]:
        found = found * share + row
    return found


def summed(terms: Iterable[Array]) -> Array:
    """Return the sum of a few arrays of equal shape.

    XLA computes this in one loop over their entries. A reduction over a short axis is slower."""
    return functools.reduce(operator.add, terms)


GAUSS = Gauss.of(POINTS)
