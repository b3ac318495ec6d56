"""Addenda given as a curve: the meshing condition by its normals, the conjugate by the core."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.profiles.base import Profile, Segment

INTERVALS = 48
"""Intervals of a piece: the quintic between their ends misses a smooth curve by some 1e-13 r."""
_STEPS = 4
"""Newton steps for the normal angle at a roll angle, from a table good to some 1e-4."""


class Piece(NamedTuple):
    """A stretch of an addendum as a curve: `position(t)` (2,) in m for t from 0 to 1, from the tip
    towards the pitch crossing, convex: the normal turns with t. `land` as in `Segment`."""

    name: str
    position: Callable[[Float[Array, ""]], Float[Array, "2"]]
    land: bool = False


class Curve(Profile):
    """An addendum of given curves, each tangent to the next.

    Stored is what its support function h is at nodes of the normal angle ν, with h′ (less the
    lever) and h″ (the radius of curvature is h + h″): quintics join them with two derivatives.
    From h follow lever -h′, sin(ν - β) = lever / r, s = h - r cos(ν - β), so that the law of
    gearing holds for the quintics themselves, whatever they miss of the curve.

    `node` (n,) in rad, `value`, `slope`, `bend` (n,) in m; `ends` (k + 1,): joints (rad) between the
    pieces, from 0 to the pitch crossing. Nodes of pieces follow each other; a joint has one node of
    either piece, as h″ may jump there.
    """

    lobes: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    lands: tuple[bool, ...] = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    node: Float[Array, " n"]
    value: Float[Array, " n"]
    slope: Float[Array, " n"]
    bend: Float[Array, " n"]
    ends: Float[Array, " k+1"]

    @classmethod
    def of(
        cls,
        lobes: int,
        pitch_radius: Float[Array, ""],
        pieces: Sequence[Piece],
        intervals: int = INTERVALS,
    ) -> "Curve":
        """The addendum made of `pieces`, which reach from the lobe's axis to the pitch crossing
        and have one normal where they meet."""
        t = jnp.arange(intervals + 1) / intervals
        rows = [jax.vmap(lambda x, p=piece.position: _support(p, x))(t) for piece in pieces]
        node, value, slope, bend = jnp.concatenate([jnp.stack(row) for row in rows], axis=1)
        ends = jnp.append(node[:: intervals + 1], node[-1])
        names, lands = (tuple(x) for x in zip(*((p.name, p.land) for p in pieces), strict=True))
        return cls(lobes, names, lands, jnp.asarray(pitch_radius), node, value, slope, bend, ends)

    def segments(self) -> tuple[Segment, ...]:
        stretches = zip(self.names, self.ends[:-1], self.ends[1:], self.lands, strict=True)
        return tuple(Segment(*stretch) for stretch in stretches)

    def _quintic(self, nu):
        """Coefficients of the quintic at `nu` in x = (ν - ν0) / width; x and width."""
        # The last node before it, and never the last of a piece.
        k = jnp.searchsorted(self.node, nu, side="right") - 1
        count = self.node.shape[0] // len(self.names)
        k = jnp.clip(k, 0, self.node.shape[0] - 2)
        k = jnp.where(k % count == count - 1, k - 1, k)
        width = self.node[k + 1] - self.node[k]
        x = (nu - self.node[k]) / width
        a, b = self.value[k], self.value[k + 1]
        da, db = self.slope[k] * width, self.slope[k + 1] * width
        dda, ddb = self.bend[k] * width**2, self.bend[k + 1] * width**2
        rise, fall = b - a - da - dda / 2, db - da - dda
        turn = ddb - dda
        coefficients = (
            a,
            da,
            dda / 2,
            10 * rise - 4 * fall + turn / 2,
            -15 * rise + 7 * fall - turn,
            6 * rise - 3 * fall + turn / 2,
        )
        return coefficients, x, width

    def support(self, nu):
        coefficients, x, _ = self._quintic(nu)
        total = coefficients[-1]
        for c in coefficients[-2::-1]:
            total = c + x * total
        return total

    def lever(self, nu):
        coefficients, x, width = self._quintic(nu)
        total = 5 * coefficients[-1]
        for order in (4, 3, 2, 1):
            total = order * coefficients[order] + x * total
        return -total / width

    def roll_angle(self, nu):
        return nu - jnp.arcsin(self.lever(nu) / self.pitch_radius)

    def contact_distance(self, nu):
        lever = self.lever(nu)
        return self.support(nu) - jnp.sqrt(
            (self.pitch_radius - lever) * (self.pitch_radius + lever)
        )

    def normal_at(self, roll_angle):
        begins = self.node - jnp.arcsin(-self.slope / self.pitch_radius)
        guess = jnp.interp(roll_angle, begins, self.node)
        one = jnp.ones_like(guess)
        for _ in range(_STEPS):
            beta, rate = jax.jvp(self.roll_angle, (guess,), (one,))
            guess = guess - (beta - roll_angle) / rate
        return guess

    @property
    def cusp(self) -> bool:
        return False


def _support(position, t):
    """ν, h, h′ and h″ of a convex curve at t."""
    one = jnp.ones_like(t)

    def velocity(t):
        return jax.jvp(position, (t,), (one,))

    (place, speed), (_, bend) = jax.jvp(velocity, (t,), (one,))
    length = jnp.sqrt(jnp.sum(speed**2))
    tangent = speed / length
    # The outward normal is a quarter turn behind the direction of travel from the tip.
    normal = jnp.stack([tangent[1], -tangent[0]])
    nu = jnp.arctan2(normal[1], normal[0])
    support = jnp.dot(place, normal)
    radius = length**3 / (speed[0] * bend[1] - speed[1] * bend[0])
    return nu, support, jnp.dot(place, tangent), radius - support
