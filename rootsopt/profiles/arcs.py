"""Addenda of circular arcs, each tangent to the next."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rootsopt.profiles import trigonometry as trig
from rootsopt.profiles.base import Profile, Segment


class Arcs(Profile):
    """An addendum of n circular arcs, with its envelope on the partner as the conjugate dedendum.

    On the arc with centre C and radius ρ, the point with normal direction ν is C + ρ n(ν). Its
    support function is C·n + ρ, and the lever of its normal is C × n. The normal meets the pitch
    circle where sin(ν - β) = lever / r, and s = support - r cos(ν - β).

    `center` (n, 2) and `radius` (n,): centres and radii of the arcs (m), in the rotor frame with
    the lobe's axis on +x. `joints` (n + 1,): normal angles (rad) from the tip, 0, to the pitch
    crossing. `names`: names of the arcs. `land`: whether the first arc is centred on the rotor's
    axis. `lobes`: number of lobes N; `pitch_radius`: r (m).
    """

    lobes: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    land: bool = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    center: Float[Array, "n 2"]
    radius: Float[Array, " n"]
    joints: Float[Array, " n+1"]

    @classmethod
    def chain(
        cls,
        lobes: int,
        pitch_radius: Float[ArrayLike, ""],
        center: Float[ArrayLike, ""] | None,
        radii: Sequence[Float[ArrayLike, ""]],
        joints: Sequence[Float[ArrayLike, ""]],
        names: Sequence[str],
    ) -> "Arcs":
        """Return n tangent arcs from the tip to the pitch crossing.

        `lobes`: number of lobes N; `pitch_radius`: r (m). `center`: distance (m) of the first arc's
        centre from the rotor's axis, along the lobe's axis; `None`: the first arc is a land.
        `radii` (n - 1,): radii (m) of all arcs except the last. `joints` (n - 1,): normal angles
        (rad) at which these arcs end. The last arc's radius follows from the pitch crossing.
        `names` (n,): names of the arcs."""
        r = jnp.asarray(pitch_radius)
        half = jnp.pi / (2 * lobes)
        crossing = r * jnp.stack([jnp.cos(half), jnp.sin(half)])
        place = jnp.stack([jnp.asarray(0.0 if center is None else center), jnp.zeros_like(r)])
        centers, found = [place], list(map(jnp.asarray, radii))
        for k, joint in enumerate(joints):
            normal = jnp.stack([jnp.cos(joint), jnp.sin(joint)])
            if k + 1 == len(radii):
                # The last arc: |X - C| = ρ at the crossing X, with C on the normal of the joint.
                to = crossing - centers[-1] - found[-1] * normal
                found.append(-jnp.dot(to, to) / (2 * jnp.dot(to, normal)))
            centers.append(centers[-1] + (found[k] - found[k + 1]) * normal)
        if not radii:
            found.append(jnp.linalg.norm(crossing - place))
        x, y = crossing - centers[-1]
        stop = jnp.arctan2(y, x)
        return cls(
            lobes=lobes,
            names=tuple(names),
            land=center is None,
            pitch_radius=r,
            center=jnp.stack(centers),
            radius=jnp.stack(found),
            joints=jnp.stack([jnp.zeros_like(r), *map(jnp.asarray, joints), stop]),
        )

    def segments(self) -> tuple[Segment, ...]:
        ends = zip(self.names, self.joints[:-1], self.joints[1:], strict=True)
        return tuple(
            Segment(name, start, stop, self.land and place == 0)
            for place, (name, start, stop) in enumerate(ends)
        )

    def stretches(self) -> tuple[Segment, ...]:
        parts: list[Segment] = []
        for segment, (x, y) in zip(self.segments(), self.center, strict=True):
            # The lever C × n is greatest where n is perpendicular to C.
            place = jnp.arctan2(lax.stop_gradient(x), -lax.stop_gradient(y)) % jnp.pi
            parts += (segment,) if segment.land else self._cut(segment, place)
        return tuple(parts)

    def _arc(self, nu):
        """Return the index of the arc that has the normal angle `nu` (rad).

        Below the first joint and above the last, return the index of the first or the last arc."""
        return jnp.sum(nu[..., None] > self.joints[1:-1], axis=-1)

    def lever(self, nu):
        return self.lever_from(nu, trig.cos(nu), trig.sin(nu))

    def lever_from(self, nu, cos, sin):
        x, y = jnp.moveaxis(self.center[self._arc(nu)], -1, 0)
        return x * sin - y * cos

    def support(self, nu):
        arc = self._arc(nu)
        x, y = jnp.moveaxis(self.center[arc], -1, 0)
        return x * trig.cos(nu) + y * trig.sin(nu) + self.radius[arc]

    def roll_angle(self, nu):
        return nu - jnp.arcsin(self.lever(nu) / self.pitch_radius)

    def contact_distance(self, nu):
        lever = self.lever(nu)
        return self.support(nu) - jnp.sqrt(
            (self.pitch_radius - lever) * (self.pitch_radius + lever)
        )

    def normal_at(self, roll_angle):
        # The normals of an arc pass through its centre and the pitch point. Where the roll angle
        # turns back, the last arc that starts before `roll_angle` is nearest to the pitch point.
        begins = self.roll_angle(self.joints[1:-1])
        places = jnp.arange(1, begins.shape[0] + 1)
        begun = roll_angle[..., None] > begins
        arc = jnp.max(jnp.where(begun, places, 0), axis=-1, initial=0)
        r = self.pitch_radius
        pitch = r * jnp.stack([jnp.cos(roll_angle), jnp.sin(roll_angle)], axis=-1)
        reach = pitch - self.center[arc]
        # If the arc's centre is outside the pitch circle, the normal points away from the pitch
        # point.
        outside = jnp.sum(self.center[arc] ** 2, axis=-1) > r**2
        reach = jnp.where(outside[..., None], -reach, reach)
        x, y = jnp.moveaxis(reach, -1, 0)
        return jnp.arctan2(y, x)

    @property
    def cusp(self) -> bool:
        return False
