"""A flank given by both its addendum and its dedendum, which need not be conjugate."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.profiles import base as trig
from rootsopt.profiles.base import Mate, Profile, RollPoint, Segment


class Table(eqx.Module):
    """k functions of x as cubic Hermite interpolants.

    `node` (n,): values of x, not decreasing; `value`, `slope` (n, k): values and derivatives of the
    functions at the nodes. Slopes may jump at a node that occurs twice. Beyond the ends, the first
    and the last cubic are continued.
    """

    node: Float[Array, " n"]
    value: Float[Array, "n k"]
    slope: Float[Array, "n k"]

    def __call__(self, x: Float[Array, "*m"]) -> tuple[Float[Array, "*m"], ...]:
        """Return the values of the k functions at `x`, each in the shape of `x`."""
        index = jnp.searchsorted(self.node, x, side="right") - 1
        index = jnp.clip(index, 0, self.node.shape[0] - 2)
        start, stop = self.node[index], self.node[index + 1]
        width = stop - start
        t = (x - start) / width
        before, after = self.value[index], self.value[index + 1]
        rise = after - before
        width, t = width[..., None], t[..., None]
        first, last = self.slope[index] * width, self.slope[index + 1] * width
        bend = 3 * rise - 2 * first - last
        values = before + t * (first + t * (bend + t * (first + last - 2 * rise)))
        return tuple(jnp.moveaxis(values, -1, 0))


class Outline(Profile):
    """A flank from a drawing or a measurement.

    `crown`: support function h (m) and lever q (m) of the addendum as functions of its normal angle
    ν, from the tip to the pitch circle. The addendum is convex, so that ν identifies its points.
    `valley`: F (rad), h and q (m) of the dedendum, where F is the direction of the normal from the
    valley's axis. The table's parameter runs from 0 at the root to `pitch_normal` at the pitch
    circle. F cannot replace this parameter, because a dedendum may have convex and concave parts.
    dh = -q dF, and dq = h dF minus the arc length element along the tangent.

    Beyond its ends, the addendum is continued by its circles of curvature; over the tip, by its
    mirror image. The law of gearing is not assumed: `mate` returns points of the given dedendum.
    Roll angle and contact distance of a point follow from where its own normal meets the pitch
    circle.

    `lobes`: number of lobes N; `pitch_radius`: r (m). `area`, `polar_area_moment`, `outer_radius`,
    `root_radius`, `seal_width`: see `Geometry`.
    """

    lobes: int = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    crown: Table
    valley: Table
    area: Float[Array, ""]
    polar_area_moment: Float[Array, ""]
    outer_radius: Float[Array, ""]
    root_radius: Float[Array, ""]
    seal_width: Float[Array, ""]

    conjugate = False
    search_nodes = 192
    cusp = False

    def segments(self) -> tuple[Segment, ...]:
        stop = self.crown.node[-1]
        return (Segment("flank", jnp.zeros_like(stop), stop, False),)

    def _crown(self, nu):
        """Return (support function, lever) of the addendum (m) at any normal angle `nu` (rad)."""
        inside = jnp.clip(jnp.abs(nu), self.crown.node[0], self.crown.node[-1])
        beyond = jnp.abs(nu) - inside
        support, lever = self.crown(inside)
        # Distance of the centre of curvature from the axis, along the normal.
        along = jnp.where(beyond > 0, self.crown.slope[-1, 1], self.crown.slope[0, 1])
        cos, sin = trig.cos(beyond), trig.sin(beyond)
        support = support + along * (cos - 1) - lever * sin
        return support, jnp.where(nu < 0, -1.0, 1.0) * (along * sin + lever * cos)

    def support(self, nu):
        return self._crown(nu)[0]

    def lever(self, nu):
        return self._crown(nu)[1]

    def _valley(self, nu):
        """Return the dedendum's point at the table's parameter `nu` (rad), clamped to the table."""
        return Mate(*self.valley(jnp.clip(nu, self.valley.node[0], self.valley.node[-1])))

    def mate(self, nu, support=True):
        pitch = self.pitch_normal
        beyond = nu > pitch
        reflected = jnp.where(beyond, 2 * pitch - nu, pitch)
        height, lever = self._crown(reflected)
        across = Mate(reflected - jnp.pi / self.lobes, lever, height)
        return jax.tree.map(lambda a, b: jnp.where(beyond, a, b), across, self._valley(nu))

    def _rolled(self, direction, mate):
        """Return the point of the outline whose outward normal has the given direction, as a
        `RollPoint`.

        `direction`: polar angle of the normal (rad) from the lobe's axis; `mate`: lever and support
        function of the point (`facing` is not used). If the normal misses the pitch circle, the
        point of the normal nearest to the circle replaces the pitch point."""
        psi = jnp.arccos(jnp.clip(mate.lever / self.pitch_radius, -1.0, 1.0))
        s = mate.support - self.pitch_radius * trig.sin(psi)
        return RollPoint(direction + psi - jnp.pi / 2, psi, s)

    def addendum(self, nu):
        support, lever = self._crown(nu)
        return self._rolled(nu, Mate(nu, lever, support))

    def dedendum(self, nu):
        mate = self._valley(nu)
        return self._rolled(mate.facing + jnp.pi / self.lobes, mate)

    def roll_angle(self, nu):
        return self.addendum(nu).beta

    def contact_distance(self, nu):
        return self.addendum(nu).s

    def normal_at(self, roll_angle):
        nodes = self.crown.node
        return jnp.interp(roll_angle, self.roll_angle(nodes), nodes)

    def speeds(self, nu):
        one = jnp.ones_like(nu)
        (height, _), (_, turned) = jax.jvp(self._crown, (nu,), (one,))
        mate, moved = jax.jvp(self._valley, (nu,), (one,))
        point = self.addendum(nu)
        return point, height - turned, -(mate.support * moved.facing - moved.lever)
