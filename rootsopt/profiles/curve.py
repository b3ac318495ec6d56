"""Addenda given as curves, whose normals determine the roll angle by the law of gearing.

Families of this kind: ellipse, extended cycloid."""

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

from rootsopt.profiles import base as trig
from rootsopt.profiles.base import Profile, Quadrature, Segment

INTERVALS = 48
"""Number of intervals per piece of the addendum. With one quintic per interval, a smooth curve is
reproduced to about 1e-11 pitch radii."""
# Number of Newton steps in the search for the normal angle at a given roll angle. The search starts
# from a table accurate to about 1e-4 rad.
_STEPS = 4
# Gauss-Legendre nodes and weights for an interval or a part of it. The integral is exact to
# rounding error.
_GAUSS = np.polynomial.legendre.leggauss(4)


class Piece(NamedTuple):
    """A convex part of an addendum, given as a curve.

    `name`: name of the piece's segment; `position`: function from t to the point (2,) in m, where t
    rises from 0 to 1 towards the pitch crossing; `land`: as in `Segment`."""

    name: str
    position: Callable[[Float[Array, ""]], Float[Array, "2"]]
    land: bool = False


class RollPiece(NamedTuple):
    """A part of an addendum, given by its roll angle and pressure angle.

    `name`: name of the piece's segment; `roll`: function from t to (β, ψ) in rad, with t from 0 to
    1 as in `Piece`; `land`: as in `Segment`. Use this class for a part that ends in a cusp (ψ = 0),
    where a curve has no tangent."""

    name: str
    roll: Callable[[Float[Array, ""]], Float[Array, "2"]]
    land: bool = False


class Curve(Profile):
    """An addendum of given curves, each tangent to the next.

    The profile stores the pressure angle ψ as a function of the normal angle ν: quintics between
    nodes, which match the given curve's ψ and two derivatives there. From ψ follow β = ν - π/2 + ψ,
    the lever r cos ψ, and the support function by quadrature from the pitch crossing. The law of
    gearing therefore holds for the quintics themselves, even where they deviate from the given
    curve.

    `names`, `lands`: as in `Piece`, one per piece; `sharp`: whether the last piece ends in a cusp;
    `node` (n,): normal angles (rad); `series` (n, 6): coefficients of ψ (rad) in powers of the
    distance from the node; `value` (n,): support function (m) at the node; `ends` (m,): joints
    (rad) between the pieces, from 0 to the pitch crossing. A joint has one node of each piece,
    because dψ/dν may jump there. Beyond the pitch crossing, ψ continues as a parabola; over the
    tip, it continues by symmetry.
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

    # Between two nodes ψ is a quintic.
    quadrature = Quadrature(6, False, 4)

    @classmethod
    def of(
        cls,
        lobes: int,
        pitch_radius: Float[ArrayLike, ""],
        pieces: Sequence[Piece | RollPiece],
        intervals: int = INTERVALS,
        sharp: bool = False,
    ) -> "Curve":
        """Return the addendum made of `pieces`, with `intervals` quintics each.

        The pieces extend from the lobe's axis to the pitch crossing and have the same normal where
        they meet. `lobes`: number of lobes N; `pitch_radius`: r (m). `sharp`: whether the last
        piece ends in a cusp."""
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
        # The nodes' support function is still 0 here, so this is its decrease over each interval.
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

    def _place(self, nu):
        """Return (index of the last node before `nu`, distance of `nu` from this node in rad).

        The end node of a piece is skipped, except that of the last piece."""
        last = self.node.shape[0] - 1
        count = (last + 1) // len(self.names)
        k = jnp.clip(jnp.searchsorted(self.node, nu, side="right") - 1, 0, last)
        k = jnp.where((k % count == count - 1) & (k < last), k - 1, k)
        return k, nu - self.node[k]

    def _psi(self, k, away):
        """Return ψ (rad) at `away` (rad) in normal angle from the node with index `k`."""
        series = self.series[k]
        psi = series[..., 5]
        for power in (4, 3, 2, 1, 0):
            psi = series[..., power] + away * psi
        return psi

    def _support(self, k, away):
        """Return the support function (m), with the same arguments as `_psi`.

        The slope -r cos ψ is integrated, starting with the node's value."""
        shares, weights = (jnp.asarray(part, away.dtype) for part in _GAUSS)
        inside = away[..., None] * (1 + shares) / 2
        mean = jnp.sum(jnp.cos(self._psi(k[..., None], inside)) * weights, axis=-1) / 2
        return self.value[k] - self.pitch_radius * mean * away

    def _mirrored(self, nu):
        """Return (|ν|, whether ν was negative): a point beyond the lobe's axis is mirrored.

        If the first piece is a land, ν is unchanged: the land itself continues over the tip."""
        over = jnp.zeros(nu.shape, bool) if self.lands[0] else nu < 0
        return jnp.where(over, -nu, nu), over

    def _pressure_angle(self, nu):
        here, over = self._mirrored(nu)
        psi = self._psi(*self._place(here))
        return jnp.where(over, jnp.pi - psi, psi)

    def support(self, nu):
        return self._support(*self._place(self._mirrored(nu)[0]))

    def lever(self, nu):
        return self.pitch_radius * trig.cos(self._pressure_angle(nu))

    def roll_angle(self, nu):
        return nu - jnp.pi / 2 + self._pressure_angle(nu)

    def contact_distance(self, nu):
        return self.support(nu) - self.pitch_radius * trig.sin(self._pressure_angle(nu))

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
    """Return coefficients (n, 6) of ψ (rad) in powers of the distance (rad) from each node.

    `node`, `psi`, `slope`, `bend` (n,): normal angle ν (rad), ψ (rad), dψ/dν and d²ψ/dν² at the
    nodes. At the last node of a piece, the coefficients are those of a parabola."""
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
    """Return the function from t to (β, ψ) in rad for a `Piece` or `RollPiece`.

    `pitch_radius`: r (m)."""
    if isinstance(piece, RollPiece):
        return piece.roll

    def roll(t):
        place, speed = jax.jvp(piece.position, (t,), (jnp.ones_like(t),))
        tangent = speed / jnp.sqrt(jnp.sum(speed**2))
        # The outward normal is the tangent from tip to pitch crossing, turned by -90°.
        lever = -jnp.dot(place, tangent)
        psi = jnp.arctan2(jnp.sqrt((pitch_radius - lever) * (pitch_radius + lever)), lever)
        nu = jnp.arctan2(-tangent[0], tangent[1])
        return jnp.stack([nu - jnp.pi / 2 + psi, psi])

    return roll


def _turning(roll, t):
    """Return (ν in rad, ψ in rad, dψ/dν, d²ψ/dν²) at t, from a piece's function `roll`."""
    one = jnp.ones_like(t)

    def angles(t):
        beta, psi = roll(t)
        return jnp.stack([beta + jnp.pi / 2 - psi, psi])

    def speed(t):
        return jax.jvp(angles, (t,), (one,))

    ((nu, psi), (nu_t, psi_t)), (_, (nu_tt, psi_tt)) = jax.jvp(speed, (t,), (one,))
    slope = psi_t / nu_t
    return nu, psi, slope, (psi_tt - slope * nu_tt) / nu_t**2


def ellipse(
    lobes: int,
    pitch_radius: Float[ArrayLike, ""],
    ellipse_center: Float[ArrayLike, ""],
    ellipse_height: Float[ArrayLike, ""],
) -> Curve:
    """Return a lobe formed by an arc of an ellipse through both pitch crossings.

    `lobes`: number of lobes N; `pitch_radius`: r (m). `ellipse_center`: b (m), distance of the
    ellipse's centre from the rotor's axis, along the lobe's axis. `ellipse_height`: A (m),
    semi-axis along the lobe's axis. The other semi-axis B follows from the pitch crossings:
    (r cos π/2N - b)² / A² + (r sin π/2N)² / B² = 1. If A = B, the lobe is a single circular arc."""
    center, height = ellipse_center, ellipse_height
    r, half = jnp.asarray(pitch_radius), jnp.pi / (2 * lobes)
    x, y = (r * jnp.cos(half) - center) / height, r * jnp.sin(half)
    stop = jnp.arccos(x)
    width = y / jnp.sin(stop)

    def position(t):
        angle = stop * t
        return jnp.stack([center + height * jnp.cos(angle), width * jnp.sin(angle)])

    return Curve.of(lobes, r, [Piece("ellipse", position)])


def extended_cycloid(
    lobes: int, pitch_radius: Float[ArrayLike, ""], trochoid_ratio: Float[ArrayLike, ""]
) -> Curve:
    """Return an epicycloid traced by a point at varying distance from the rolling circle's centre.

    `lobes`: number of lobes N; `pitch_radius`: r (m). With r_e = r / 2N the curve is P(θ) = e^{iθ}
    [r + r_e + λ(θ) r_e e^{2iNθ}]. It runs from the tip (θ = 0) to the pitch crossing (θ = π/2N).
    The ratio λ varies from `trochoid_ratio` λ0 at the tip to 1 at the crossing: λ = 1 + (λ0 - 1) u³
    (10 - 15 u + 6 u²) with u = 1 - 2Nθ/π. This quintic has zero first and second derivatives at
    both ends. The idea comes from Hsieh and Hwang (J. Mech. Des. 129 (2007) 1278), whose own
    formulas were not available. λ0 = 1 gives EE. The outer radius is r + (1 + λ0) r_e.

    The crossing is a cusp: dP/dθ vanishes in proportion to δ = π/2N - θ. The formula of the normal
    is therefore divided by δ. In the frame turned by θ, with w = e^{-2iNδ} and M = |X δ + iY|, the
    normal is (X δ + iY) / M. Here,

        X δ + iY = (r + r_e) (1 - λ w) / δ + i r_e w λ′ / δ.

    The normal makes the angle η = arctan(X δ / Y) with the tangent of the pitch circle at θ. For a
    constant λ the normal passes through the pitch point at θ, and ψ = η. Otherwise it misses this
    point by e, with e = r_e² λ′ (cos 2Nδ - λ) / (δ M). Then cos ψ = cos η + e / r. Hence
    sin²(ψ/2) = sin²(η/2) - e / 2r, of second order in δ, and β = θ - η + ψ. These formulas are
    derived here, not taken from a source."""
    r, ratio = jnp.asarray(pitch_radius), jnp.asarray(trochoid_ratio)
    half, n = jnp.pi / (2 * lobes), lobes
    rolling = r / (2 * lobes)

    def roll(t):
        u = 1 - t
        delta = half * u
        # (λ - 1) / δ² and λ′ / δ.
        beyond = (ratio - 1) * u * (10 - 15 * u + 6 * u**2) / half**2
        steepness = -(ratio - 1) * 30 * u * t**2 / half**2
        here = 1 + beyond * delta**2
        # sin(Nδ) / δ and sin(2Nδ) / δ, and (1 - λ cos 2Nδ) / δ².
        single, double = n * jnp.sinc(u / 2), 2 * n * jnp.sinc(u)
        open_ = 2 * single**2 - beyond * jnp.cos(2 * n * delta)
        x = (r + rolling) * open_ + rolling * steepness * double
        y = (r + rolling) * here * double + rolling * steepness * jnp.cos(2 * n * delta)
        length = jnp.sqrt(y**2 + (x * delta) ** 2)
        miss = -(rolling**2) * steepness * (2 * single**2 + beyond) / length
        square = x**2 / (2 * length * (length + y)) - miss / (2 * r)
        psi = 2 * jnp.arcsin(delta * jnp.sqrt(square))
        return jnp.stack([half * t - jnp.arctan2(x * delta, y) + psi, psi])

    return Curve.of(lobes, r, [RollPiece("extended cycloid", roll)], sharp=True)
