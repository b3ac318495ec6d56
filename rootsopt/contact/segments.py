"""Contact gap between two flanks as polylines: nodes against straight segments (paper, Eq. 9).

Each flank is a polyline from tip to root. The gap is the least (p - q) · n. Here, p is a node of
one flank, and (q, n) the segment of the other flank that faces it. The paper tests the nodes of
rotor 2 only. Here, the nodes of each flank are tested against the segments of the other. The result
therefore does not change when the rotors are exchanged.

A segment faces the nodes between the bisectors at its two ends. On a bisector, the distances to
both segments agree, so the gap is continuous over the pose. Its derivatives with respect to the
rotations are the levers of the contact force, so elastic forces come from a potential. The levers
jump from segment to segment: their error is of first order in the node spacing, that of the gap of
second order.

Let N be the number of lobes, x the roll coordinate and ε the relative rotation (see `Contact`). Let
E be the vector between the axes, and R(a) the rotation by a. The angle a is x + ε/2 for rotor 1 and
π/N - x + ε/2 for rotor 2. Let z be a point of a flank in the frame of its own rotor, with a tip on
+x. In the frame of the other rotor, it lies at R(a) (E - R(-a′) z). Here, a is the angle of the
other rotor and a′ that of its own. Exchanging the rotors only exchanges a and a′."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.contact.gap import Contact
from rootsopt.profiles.base import Profile

# Fractions of the addendum's nodes by which a flank is continued. Beyond the pitch crossing, the
# other half of the flank touches near the middle of the mesh. Over the top of a rounded tip, the
# continuation keeps the first contact away from an end. A longer continuation would bend the flank
# of EE too far for the bisection in `_facing`.
_BEYOND_PITCH = 0.15
_OVER_TIP = 0.03
# Points per segment in the table from which the nodes are spaced.
_TABLE = 64
# Penetration (pitch radii) above which a node belongs to the other flank of its lobe and is
# ignored.
_DEEPEST = 0.1


class NodeContact(Contact):
    """Gap and levers of a flank pair at a pose, from two polylines.

    Call an instance with the roll coordinate x and the relative rotation ε (rad), which `Contact`
    defines. The first axis of each array is the rotor (1, 2); coordinates are in that rotor's
    frame. `nodes` (2, n, 2): nodes (m); `tangent` (2, n, 2): unit tangents at the nodes, normal to
    the bisectors; `normal` (2, n - 1, 2): outward unit normals of the segments; `pitch_radius`: r
    (m); `half_pitch`: π/2N (rad).

    Tip lands carry no torque and have no nodes. The flank of rotor 1 is its addendum, extended a
    little beyond the pitch crossing and, unless there is a land, over the tip. The flank of rotor 2
    is its mate. The rest of the mesh follows by exchange of the rotors.
    """

    nodes: Float[Array, "2 n 2"]
    tangent: Float[Array, "2 n 2"]
    normal: Float[Array, "2 n-1 2"]
    pitch_radius: Float[Array, ""]
    half_pitch: float = eqx.field(static=True)

    @property
    def smooth(self) -> bool:
        """False: the levers jump without a change of `switches`."""
        return False

    @classmethod
    def of(cls, profile: Profile, nodes: int) -> "NodeContact":
        """Return the contact of `profile` with `nodes` per flank, half of them on the addendum.

        The density of nodes is the longer of the two mating arc elements plus a constant. The
        constant ensures enough nodes at the pitch crossing of EE, where the flank is sharp. Raises
        `ValueError` for fewer than 16 nodes.
        """
        if nodes < 16:
            raise ValueError(f"Argument `nodes` must be at least 16, but is {nodes}.")
        normal = _spread(profile, nodes // 2)
        count = len(normal)
        near = normal[-1 - round(_BEYOND_PITCH * count) : -1]
        top = normal[:0]
        if not profile.segments()[0].land:
            top = -normal[1 : 2 + round(_OVER_TIP * count)][::-1]
        own = jnp.concatenate([top, normal])
        addendum, dedendum = profile.addendum, profile.dedendum
        # From tip to root, on both rotors; node i of one meshes with node -1 - i of the other.
        first = [profile.position(addendum(own)), profile.position(dedendum(near[::-1]))]
        second = [profile.position(addendum(near)), profile.position(dedendum(own[::-1]))]
        points = jnp.stack([jnp.concatenate(first), jnp.concatenate(second)])
        chord = _unit(points[:, 1:] - points[:, :-1])
        bisector = _unit(chord[:, 1:] + chord[:, :-1])
        tangent = jnp.concatenate([chord[:, :1], bisector, chord[:, -1:]], axis=1)
        outward = jnp.stack([chord[..., 1], -chord[..., 0]], axis=-1)
        return cls(points, tangent, outward, profile.pitch_radius, profile.half_pitch)

    def __call__(
        self, roll: Float[Array, ""], relative: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """Return gap and levers (m) of rotor 1 and rotor 2 at x = `roll`, ε = `relative` (rad).

        Derivatives are those of the deepest pair of node and segment. Where no node faces a
        segment, the gap is the pitch radius and the levers are zero.
        """
        half = self.half_pitch
        centered = roll - half
        centered = centered - 4 * half * jnp.round(centered / (4 * half))
        mirrored = centered > 0
        folded = half - jnp.abs(centered)
        angles = jnp.stack([folded, 2 * half - folded]) + relative / 2
        rotor, node, segment, found = lax.stop_gradient(self)._search(lax.stop_gradient(angles))
        center = self._center(angles[rotor])
        p = self._transfer(self.nodes[1 - rotor, node], angles[rotor], angles[1 - rotor])
        n = self.normal[rotor, segment]
        gap = (p - self.nodes[rotor, segment]) @ n
        # Moment arms of the line through p along n about the two axes.
        own, other = _cross(p, n), _cross(center - p, n)
        swapped = mirrored != (rotor == 1)
        zero = jnp.zeros_like(gap)
        return (
            jnp.where(found, gap, lax.stop_gradient(self.pitch_radius)),
            jnp.where(found, jnp.where(swapped, other, own), zero),
            jnp.where(found, jnp.where(swapped, own, other), zero),
        )

    def _center(self, angle):
        """Return the other rotor's axis (2,) in m, in the frame of a rotor at `angle` a (rad)."""
        return 2 * self.pitch_radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    def _transfer(self, points, angle, other_angle):
        """Return the other rotor's `points` (..., 2) in the frame of a rotor at `angle` a (rad).

        `other_angle`: angle a (rad) of the other rotor."""
        turn = angle - other_angle
        cos, sin = jnp.cos(turn), jnp.sin(turn)
        return self._center(angle) - points @ jnp.array([[cos, sin], [-sin, cos]])

    def _search(
        self, angles: Float[Array, " 2"]
    ) -> tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""], Bool[Array, ""]]:
        """Return the deepest pair of node and segment at `angles` a (rad) of the two rotors.

        The result is (index of the segment's rotor, of the node, of the segment, whether a pair
        exists)."""
        points = jax.vmap(self._transfer)(self.nodes[::-1], angles, angles[::-1])
        gap, segment = jax.vmap(_facing)(points, self.nodes, self.tangent, self.normal)
        gap = jnp.where(gap > -_DEEPEST * self.pitch_radius, gap, jnp.inf)
        best = jnp.argmin(gap)
        rotor, node = jnp.divmod(best, gap.shape[1])
        return rotor, node, segment[rotor, node], jnp.isfinite(gap.ravel()[best])


def _facing(
    points: Float[Array, "n 2"],
    nodes: Float[Array, "n 2"],
    tangent: Float[Array, "n 2"],
    normal: Float[Array, "n-1 2"],
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """Return (signed distance (m), segment index) of each point from the segment that faces it.

    `nodes`, `tangent`, `normal`: as in `NodeContact`, for one rotor. Where no segment faces a
    point, the distance is inf. The segment is found by bisection over the nodes. Bisection works
    because a point near the flank is ahead of all bisectors on the tip's side of its segment, and
    behind all others. This holds if the chord between any two nodes of a flank makes an angle below
    90° with the tangents at both.
    """
    x, y = points[:, 0], points[:, 1]
    offset = jnp.sum(nodes * tangent, axis=1)
    base = jnp.sum(nodes[:-1] * normal, axis=1)

    def ahead(index):
        return x * tangent[index, 0] + y * tangent[index, 1] >= offset[index]

    last = len(nodes) - 1
    low = jnp.zeros(len(nodes), dtype=jnp.int32)

    # Use a traced loop. Unrolled, the compiler fuses and repeats the steps, which doubles the time.
    def halve(step, low):
        middle = low + jnp.left_shift(1, last.bit_length() - 1 - step).astype(low.dtype)
        passed = (middle < last) & ahead(jnp.minimum(middle, last))
        return jnp.where(passed, middle, low)

    low = lax.fori_loop(0, last.bit_length(), halve, low)
    gap = x * normal[low, 0] + y * normal[low, 1] - base[low]
    return jnp.where(ahead(0) & ~ahead(last), gap, jnp.inf), low


def _spread(profile: Profile, count: int) -> Float[Array, " n"]:
    """Return normal angles (n,) in rad of `count` nodes on the addendum.

    The nodes run from the tip (or the land's end) to the pitch crossing."""
    segments = [s for s in profile.segments() if not s.land]
    share = jnp.arange(_TABLE, dtype=profile.pitch_radius.dtype) / _TABLE
    ends = [s.start + (s.stop - s.start) * share for s in segments]
    table = jnp.concatenate([*ends, segments[-1].stop[None]])
    middle = (table[1:] + table[:-1]) / 2
    speeds = profile.addendum_speed(middle), profile.dedendum_speed(middle)
    speed = jnp.maximum(jnp.abs(speeds[0]), jnp.abs(speeds[1])) + 0.3 * profile.pitch_radius
    measure = jnp.cumsum(jnp.append(jnp.zeros_like(speed[:1]), speed * jnp.diff(table)))
    even = jnp.linspace(0, 1, count, dtype=measure.dtype)
    return jnp.interp(even * measure[-1], measure, table)


def _unit(vectors):
    return vectors / jnp.sqrt(jnp.sum(vectors**2, axis=-1, keepdims=True))


def _cross(a, b):
    return a[0] * b[1] - a[1] * b[0]
