"""Addenda given as a curve: the meshing condition by its normals, the conjugate by the core."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rootsopt.profiles.base import Profile, Quadrature, Segment

INTERVALS = 48
"""Intervals of a piece: the quintic between their ends misses a smooth curve by some 1e-11 r."""
_STEPS = 4
"""Newton steps for the normal angle at a roll angle, from a table good to some 1e-4."""
_GAUSS = np.polynomial.legendre.leggauss(4)
"""Quadrature over an interval at most, to rounding."""


class Piece(NamedTuple):
    """A stretch of an addendum as a curve: `position(t)` (2,) in m for t from 0 to 1, from the tip
    towards the pitch crossing, convex: the normal turns with t. `land` as in `Segment`."""

    name: str
    position: Callable[[Float[Array, ""]], Float[Array, "2"]]
    land: bool = False


class RollPiece(NamedTuple):
    """A stretch of an addendum by roll and pressure angle: `roll(t)` gives (β, ψ) in rad for t from
    0 to 1, as `Piece` does. It may end in a cusp (ψ = 0), where a curve has no tangent."""

    name: str
    roll: Callable[[Float[Array, ""]], Float[Array, "2"]]
    land: bool = False


class Curve(Profile):
    """An addendum of given curves, each tangent to the next.

    Stored is the pressure angle ψ by the normal angle ν: quintics between nodes, which join its
    values and two derivatives there. From it follow β = ν - π/2 + ψ, the lever r cos ψ, and the
    support function by quadrature from the pitch crossing, so that the law of gearing holds for
    the quintics themselves, whatever they miss of the curve.

    `node` (n,) in rad; `series` (n, 6): coefficients of ψ (rad) by powers of the distance from the
    last node; `value` (n,): the support function (m); `ends` (m,): joints (rad) between the pieces,
    from 0 to the pitch crossing. Nodes of pieces follow each other; a joint has one node of either
    piece, as dψ/dν may jump there. Beyond the pitch crossing ψ goes on as a parabola, over the tip
    by symmetry.
    """

    lobes: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    lands: tuple[bool, ...] = eqx.field(static=True)
    sharp: bool = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    node: Float[Array, " n"]
    series: Float[Array, "n 6"]
    value: Float[Array, " n"]
    ends: Float[Array, " m"]

    @classmethod
    def of(
        cls,
        lobes: int,
        pitch_radius: Float[ArrayLike, ""],
        pieces: Sequence[Piece | RollPiece],
        intervals: int = INTERVALS,
        sharp: bool = False,
    ) -> "Curve":
        """The addendum made of `pieces`, which reach from the lobe's axis to the pitch crossing
        and have one normal where they meet. `sharp`: the last ends in a cusp."""
        r = jnp.asarray(pitch_radius)
        t = jnp.arange(intervals + 1, dtype=r.dtype) / intervals
        turning = [functools.partial(_turning, _rolling(piece, r)) for piece in pieces]
        rows = [lax.map(turn, t) for turn in turning]
        node, psi, slope, bend = jnp.concatenate([jnp.stack(row) for row in rows], axis=1)
        curve = cls(
            lobes=lobes,
            names=tuple(piece.name for piece in pieces),
            lands=tuple(piece.land for piece in pieces),
            sharp=sharp,
            pitch_radius=r,
            node=node,
            series=_quintics(node, psi, slope, bend),
            value=jnp.zeros_like(node),
            ends=jnp.append(node[:: intervals + 1], node[-1]),
        )
        # With zeros for the support function at the nodes: what it falls by over each interval.
        start = jnp.arange(node.shape[0] - 1)
        fall = -curve._support(start, jnp.diff(node))
        value = r * jnp.sin(psi[-1]) + jnp.cumsum(fall[::-1])[::-1]
        return eqx.tree_at(lambda c: c.value, curve, jnp.append(value, r * jnp.sin(psi[-1])))

    def segments(self) -> tuple[Segment, ...]:
        stretches = zip(self.names, self.ends[:-1], self.ends[1:], self.lands, strict=True)
        return tuple(Segment(*stretch) for stretch in stretches)

    def stretches(self) -> tuple[Segment, ...]:
        count = self.node.shape[0] // len(self.names)
        return tuple(
            Segment(self.names[k // count], self.node[k], self.node[k + 1], self.lands[k // count])
            for k in range(self.node.shape[0] - 1)
            if k % count < count - 1
        )

    @property
    def quadrature(self) -> Quadrature:
        # Between two nodes ψ is a quintic.
        return Quadrature(6, False, 4)

    def _place(self, nu):
        """The last node before `nu`, which is none at the end of a piece but the last, and the
        distance from it."""
        last = self.node.shape[0] - 1
        count = (last + 1) // len(self.names)
        k = jnp.clip(jnp.searchsorted(self.node, nu, side="right") - 1, 0, last)
        k = jnp.where((k % count == count - 1) & (k < last), k - 1, k)
        return k, nu - self.node[k]

    def _psi(self, k, away):
        """ψ at a distance `away` from node k."""
        series = self.series[k]
        psi = series[..., 5]
        for power in (4, 3, 2, 1, 0):
            psi = series[..., power] + away * psi
        return psi

    def _support(self, k, away):
        """Support function (m) at a distance `away` from node k: its slope is -r cos ψ."""
        shares, weights = (jnp.asarray(part, away.dtype) for part in _GAUSS)
        inside = away[..., None] * (1 + shares) / 2
        mean = jnp.sum(jnp.cos(self._psi(k[..., None], inside)) * weights, axis=-1) / 2
        return self.value[k] - self.pitch_radius * mean * away

    def _mirrored(self, nu):
        """ν on this side of the lobe's axis, and which side it was. (A land goes on itself.)"""
        over = jnp.zeros(nu.shape, bool) if self.lands[0] else nu < 0
        return jnp.where(over, -nu, nu), over

    def _pressure_angle(self, nu):
        here, over = self._mirrored(nu)
        psi = self._psi(*self._place(here))
        return jnp.where(over, jnp.pi - psi, psi)

    def support(self, nu):
        return self._support(*self._place(self._mirrored(nu)[0]))

    def lever(self, nu):
        return self.pitch_radius * jnp.cos(self._pressure_angle(nu))

    def roll_angle(self, nu):
        return nu - jnp.pi / 2 + self._pressure_angle(nu)

    def contact_distance(self, nu):
        return self.support(nu) - self.pitch_radius * jnp.sin(self._pressure_angle(nu))

    def normal_at(self, roll_angle):
        begins = self.node - jnp.pi / 2 + self.series[:, 0]
        guess = jnp.interp(roll_angle, begins, self.node)
        one = jnp.ones_like(guess)
        for _ in range(_STEPS):
            beta, rate = jax.jvp(self.roll_angle, (guess,), (one,))
            guess = guess - (beta - roll_angle) / rate
        return guess

    @property
    def cusp(self) -> bool:
        return self.sharp


def _quintics(node, psi, slope, bend):
    """Coefficients (n, 6) by powers of the distance from each node; a parabola at the last of a
    piece."""
    here = node, psi, slope, bend
    following = (jnp.append(row[1:], row[-1:]) for row in here)

    def between(ends):
        (node, psi, slope, bend), (far, b, db, ddb) = ends
        inside = far > node
        width = jnp.where(inside, far - node, 1.0)
        rise = (b - psi) / width**3 - slope / width**2 - bend / (2 * width)
        fall = (db - slope) / width**2 - bend / width
        turn = (ddb - bend) / width
        rest = (
            10 * rise - 4 * fall + turn / 2,
            (-15 * rise + 7 * fall - turn) / width,
            (6 * rise - 3 * fall + turn / 2) / width**2,
        )
        return jnp.stack([psi, slope, bend / 2, *(jnp.where(inside, c, 0.0) for c in rest)])

    return lax.map(between, (here, tuple(following)))


def _rolling(piece, pitch_radius):
    """t → (β, ψ) of a piece."""
    if isinstance(piece, RollPiece):
        return piece.roll

    def roll(t):
        place, speed = jax.jvp(piece.position, (t,), (jnp.ones_like(t),))
        tangent = speed / jnp.sqrt(jnp.sum(speed**2))
        # The outward normal is a quarter turn behind the direction of travel from the tip.
        lever = -jnp.dot(place, tangent)
        psi = jnp.arctan2(jnp.sqrt((pitch_radius - lever) * (pitch_radius + lever)), lever)
        nu = jnp.arctan2(-tangent[0], tangent[1])
        return jnp.stack([nu - jnp.pi / 2 + psi, psi])

    return roll


def _turning(roll, t):
    """ν, ψ, dψ/dν and d²ψ/dν² at t."""
    one = jnp.ones_like(t)

    def angles(t):
        beta, psi = roll(t)
        return jnp.stack([beta + jnp.pi / 2 - psi, psi])

    def speed(t):
        return jax.jvp(angles, (t,), (one,))

    ((nu, psi), (nu_t, psi_t)), (_, (nu_tt, psi_tt)) = jax.jvp(speed, (t,), (one,))
    slope = psi_t / nu_t
    return nu, psi, slope, (psi_tt - slope * nu_tt) / nu_t**2
