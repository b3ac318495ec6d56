"""Closest approach of the two flanks of a meshing pair, from true geometry.

The pose is the pair of roll coordinate x and relative rotation ε = φ2 - φ1 (rad). The *drive* flank
of rotor 1 pushes rotor 2 forward; it has x = -φ, where φ = (φ1 + φ2)/2 is the mean angle. At ε = 0
the pair touches at roll angle β = x, 0 ≤ x ≤ π/N.

The normal angle of an addendum point describes both flanks. On rotor 1 this angle is ν1. On
rotor 2, ν2 denotes the dedendum point that meshes with the addendum point ν2 in perfect rolling. If
the two normals are parallel, ν1 = ν2 - 2(β(ν2) - x), and with the pressure angle λ of their common
direction

    T = E cos λ - q1(ν1) - q2(ν2)      tangential offset of the two points,
    G = E sin λ - h1(ν1) - h2(ν2)      normal gap (negative: penetration),

where q are the levers, h the support functions and E is the centre distance. The closest approach
is the root of T. Newton's method searches for it from the point of perfect rolling. It may fail to
converge, or find another root. In these cases, the search brackets the root between two of a fixed
set of nodes and refines it inside this bracket. The search then cannot lose the root where
curvature jumps or the flanks conform. A root at which T falls with increasing ν2 is a minimum of
the gap. By the envelope theorem, ∂G/∂φ1 = -q1 and ∂G/∂φ2 = q2. These derivatives also give the
virtual work of a unit contact force.

Bracketing evaluates T at all nodes. A pose turns all nodes by the same angle. Their sines and
cosines therefore follow from the addition theorem, without a trigonometric function per node.

Exchanging the rotors maps x to π/N - x. The search therefore covers only the half of the mesh in
which rotor 1's addendum meets rotor 2's dedendum. Coast flanks follow from mirror symmetry, x → -x,
ε → -ε.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap, sequential_vmap
from jaxtyping import Array, Bool, Float

from rootsopt.contact.gap import DEEPEST, ClosestApproach, FlankNodes, bracket_of, root_in
from rootsopt.profiles import base as trig
from rootsopt.profiles.base import Profile
from rootsopt.runtime.compute_once import compute_once

# Least number of poses that are searched in groups (see `FlankPair.together`), and size of a group.
_MANY = 32
# Marks a finished search: this is added to the number of attempts.
_DONE = 16
# On a wavy flank: maximum number of minima of the gap that are compared, and number of jumps
# between neighbouring minima with separate flags.
_MINIMA = 8
RANKS = 3
# Distance of x (rad) from a joint's roll angle, in relative rotations |ε|, below which the gap of a
# forked flank may have two minima. On sound five arcs that almost carry over, 6 were needed.
_FORK = 30.0
# Distance of ν2 (rad) before the cusp at the pitch crossing, in penetrations (pitch radii), below
# which a contact counts as the minimum beyond the cusp. Both minima of the gap move in proportion
# to |ε|: on epicycloids, this one lies at most 0.6 |ε| before the cusp, the other one at least
# 5 |ε| where they are equally deep.
_NEAR_CUSP = 1.8
BEYOND = 0.05
"""Distance (rad) from the range of the search's nodes above which a root outside it is rejected.
The flanks then count as having no common normal."""
# Number of extra nodes between the edge of a land, or a joint of a forked flank, and the next node.
# Their distances from the edge double from one to the next.
_CROWD = 12


class FlankPair(eqx.Module):
    """A flank of rotor 1 and its mate on rotor 2.

    Build it with `FlankPair.of(profile)` outside any time loop.

    `profile`: both rotors' profile; `frozen`: the same profile without derivatives, for the search;
    `nodes`: see `FlankNodes`; `center_distance`: E (m); `rolling`: whether the flanks are conjugate
    and E is the distance of perfect rolling. Otherwise, a contact may be handed over: it slides
    over a lobe's axis, from one flank of the lobe to the other. `together`: whether many poses are
    searched in groups, which is faster, but takes longer to compile.
    """

    profile: Profile
    frozen: Profile
    nodes: FlankNodes
    center_distance: Float[Array, ""]
    rolling: bool = eqx.field(static=True)
    together: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(
        cls,
        profile: Profile,
        center_distance: Float[Array, ""] | None = None,
        two_sided: bool = False,
    ) -> "FlankPair":
        """Return the flank pair of `profile`, prepared for searches; its nodes have no derivatives.

        `center_distance`: E (m), by default the distance of perfect rolling, 2r. At other
        distances, drive and coast flanks can touch at the same time: set `two_sided` for these. The
        search then also covers the half of a land up to the lobe's axis. The other half belongs to
        the flank on the other side.
        """
        frozen = lax.stop_gradient(profile)
        segments = [s for s in frozen.segments() if two_sided or not s.land]
        count = frozen.search_nodes
        fraction = jnp.arange(count) / count
        pieces = [s.start + (s.stop - s.start) * fraction for s in segments[:-1]]
        if not (two_sided or frozen.segments()[0].land):
            # On a rounded tip, contact slides over the top when the next lobe takes over. (A land
            # carries no torque; contact ends at its edge.)
            first = segments[0]
            pieces.insert(0, first.start - 0.5 * (first.stop - first.start) * fraction[:0:-1])
        # Nodes crowd around the pitch crossing, where a family with ψ = 0 (EE) has zero
        # radius of curvature. Rotor 2 may touch beyond its pitch crossing by about ε. The search
        # therefore includes a piece of its addendum, reflected about the pitch normal.
        start, stop = segments[-1].start, segments[-1].stop
        crowd = 0.5 ** jnp.arange(1, 8) / count
        near = jnp.concatenate([fraction, 1 - crowd, jnp.ones(1), 1 + crowd[::-1]])
        beyond = 1 + jnp.arange(1, 1 + count // 2) / count
        pieces.append(start + (stop - start) * jnp.concatenate([near, beyond]))
        # Beside a land, contact starts on a part of the flank that grows from zero length. At the
        # ends of this part, the point of rotor 1 or of rotor 2 is at the land's edge. Beside a
        # joint, T may rise over a part of this kind, between two minima of the gap.
        tip, *others = frozen.segments()
        for after in others if frozen.forked else others[: tip.land]:
            step = (after.stop - after.start) / count
            pieces.append(after.start + step * 0.5 ** jnp.arange(_CROWD, 0, -1))
        normal = jnp.sort(jnp.concatenate(pieces))
        mate = frozen.mate(normal)
        rolling = center_distance is None and profile.conjugate
        nodes = FlankNodes(
            normal=normal,
            facing=mate.facing,
            direction=_circle(mate.facing),
            turned=_circle(frozen.turn_ratio * mate.facing),
            lever=mate.lever,
            support=None if rolling else mate.support,
        )
        distance = 2 * profile.pitch_radius if center_distance is None else center_distance
        dynamic, static = eqx.partition(frozen, eqx.is_inexact_array)
        # Otherwise, XLA would compute the sines of the nodes again at every pose.
        dynamic, nodes = compute_once((dynamic, nodes))
        return cls(profile, eqx.combine(dynamic, static), nodes, distance, rolling)

    def __call__(self, roll: Float[Array, ""], relative: Float[Array, ""]) -> ClosestApproach:
        """Return the closest approach at roll coordinate x = `roll` and ε = `relative` (rad).

        Any `roll` may be given: it is reduced to one mesh period around the middle of the flank.
        The result is differentiable to any order with respect to both angles, the profile and the
        centre distance. The search itself is never differentiated.
        """
        folded, mirrored = self.folded(roll)
        closest = self._closest(folded, relative)
        lever1, lever2 = closest.lever1, closest.lever2
        return closest._replace(
            lever1=jnp.where(mirrored, lever2, lever1), lever2=jnp.where(mirrored, lever1, lever2)
        )

    def folded(self, roll: Float[Array, ""]) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        """Return (x (rad) in the searched half of the mesh, whether the rotors are exchanged).

        `roll`: any x (rad)."""
        half = self.profile.half_pitch
        centered = roll - half
        centered = centered - 4 * half * jnp.round(centered / (4 * half))
        return half - jnp.abs(centered), centered > 0

    @property
    def jumps(self) -> bool:
        """Whether the contact may jump from one minimum of the gap to another one."""
        profile = self.profile
        return profile.cusp or profile.forked or profile.wavy or not self.rolling

    def _leap(self, closest: ClosestApproach) -> Float[Array, ""]:
        """Return a number that is positive if `closest` is the minimum of the gap beyond the cusp.

        That minimum lies beyond the cusp, or close before it (`_NEAR_CUSP`). Without a cusp, the
        number is 1: other flags then show that the contact may have jumped."""
        if not self.profile.cusp:
            return jnp.ones_like(closest.gap)
        depth = jnp.maximum(-closest.gap, 0.0) / self.frozen.pitch_radius
        return closest.normal2 - self.frozen.pitch_normal + _NEAR_CUSP * depth

    @property
    def edges(self) -> Float[Array, " k"]:
        """Normal angles (rad) at which a smooth piece of the flank ends (see `margins`).

        These are the ends of the segments, without the pitch crossing unless the curvature jumps
        there. On a wavy flank they are the knots, where higher derivatives jump, and the pitch
        crossing, where rotor 2's dedendum ends."""
        pieces = self.profile.stretches() if self.frozen.wavy else self.profile.segments()
        whole = self.frozen.wavy or self.profile.inflected
        pieces = pieces if whole else pieces[:-1]
        return jnp.stack([piece.stop for piece in pieces] or [jnp.zeros(())])

    def margins(
        self,
        roll: Float[Array, ""],
        closest: ClosestApproach,
        rival: Float[Array, ""] | None = None,
    ) -> Float[Array, " s"]:
        """Return numbers (s,) that change their signs where the closest approach changes its piece.

        Derivatives of the gap jump there: second derivatives with respect to the pose, and first
        derivatives of the levers with respect to the design. There is a number for each of `edges`
        and each rotor. The first number belongs to the common normal. If the contact may be handed
        over, it is the distance (rad) of the contact from the lobe's axis. Otherwise it is 1 or -1,
        because it changes only where the flanks are apart.

        `roll`: x (rad); `closest`: closest approach at this pose; `rival`: gap (m) of the minimum
        to which the contact jumps, if known. The number for the jump then passes smoothly through
        zero."""
        normals = jnp.stack([closest.normal1, closest.normal2])
        beyond = (normals[:, None] - self.edges).ravel()
        half = self.profile.half_pitch
        inside = 1.0 if self.rolling else closest.normal2 - self.nodes.normal[0]
        found = jnp.where(closest.found, inside, -1.0)
        numbers = [found, trig.sin(jnp.pi / 2 * (roll - half) / half)]
        if self.jumps:
            numbers.append(self._leap(closest) if rival is None else rival - closest.gap)
        if self.frozen.wavy:
            numbers += [closest.rank - 0.5 - number for number in range(RANKS)]
        return jnp.concatenate([jnp.stack(numbers), beyond])

    @eqx.filter_jit  # so that all its calls in one program are traced once
    def _closest(self, roll, relative) -> ClosestApproach:
        """Return the closest approach for a `roll` from `folded`, with rules for its derivatives.

        `relative`: ε (rad). G, T and ν2 are defined in the module's docstring. Let θ be the pose,
        the profile and the centre distance. Then dG = ∂G/∂θ dθ at constant ν2 (envelope theorem),
        and dν2 = -(∂T/∂θ dθ) / (∂T/∂ν2) (implicit function theorem). The rules are themselves
        differentiable, so that second derivatives are those of the true gap.
        """
        dynamic, static = eqx.partition(self, eqx.is_inexact_array)

        @jax.custom_jvp
        def closest(dynamic, roll, relative):
            return _searched(eqx.combine(dynamic, static), roll, relative)

        @closest.defjvp
        def _(primals, tangents):
            approach = closest(*primals)
            dynamic, *pose = primals
            by_dynamic, *by_pose = tangents
            here, normal2 = approach.found, approach.normal2
            still, unit = jnp.zeros_like(normal2), jnp.ones_like(normal2)

            def mesh(dynamic, normal2, roll, relative):
                return eqx.combine(dynamic, static)._mesh(normal2, roll, relative)

            _, turned = jax.jvp(lambda nu: mesh(dynamic, nu, *pose), (normal2,), (unit,))
            _, moved = jax.jvp(mesh, (dynamic, normal2, *pose), (by_dynamic, still, *by_pose))
            # At a point that is not a minimum (no root, or conforming flanks) ν2 does not move.
            falls = turned[0] < 0
            normal2_dot = jnp.where(falls, -moved[0] / jnp.where(falls, turned[0], -1.0), 0.0)
            normal1_dot, lever1_dot, lever2_dot = (
                moved[i] + turned[i] * normal2_dot for i in (2, 3, 4)
            )
            return approach, ClosestApproach(
                gap=jnp.where(here, moved[1], still),
                lever1=jnp.where(here, lever1_dot, still),
                lever2=jnp.where(here, lever2_dot, still),
                normal1=normal1_dot,
                normal2=normal2_dot,
                found=np.zeros(here.shape, jax.dtypes.float0),  # pyright: ignore[reportArgumentType]
                rank=still,
            )

        return closest(dynamic, roll, relative)

    def _mesh(self, normal2, roll, relative):
        """Return (T, G, ν1, q1, q2) at ν2 = `normal2`, as defined in the module's docstring.

        `roll`: x (rad) from `folded`; `relative`: ε (rad)."""
        profile = self.profile
        mate = profile.mate(normal2)
        normal1 = mate.facing + 2 * roll
        direction = mate.facing + roll - relative / 2
        lever1 = profile.lever(normal1)
        support = profile.support(normal1) + mate.support
        gap = self.center_distance * trig.cos(direction) - support
        offset = self.center_distance * trig.sin(direction) - lever1 - mate.lever
        return offset, gap, normal1, lever1, mate.lever

    def _search(self, roll, relative, attempt=0):
        """Return (number of attempts, closest approach) for a `roll` from `folded`.

        `relative`: ε (rad); `attempt`: number of the first attempt. Attempt 0 is Newton's method
        from the point of perfect rolling. If its result is not reliable, attempts 1 and 2 follow.
        They search the last and the first interval of nodes where T falls through zero. These
        intervals contain the two minima that the gap may have next to a cusp. The deeper minimum is
        returned. If the flanks are not conjugate, or not at the distance of perfect rolling, the
        gap may have more minima: on a land, on an involute and beside the pitch crossing, say. The
        attempts then search the two intervals with the least gap.
        On a wavy flank, Newton's method may find a minimum that is not the deepest. Attempts 1 to
        `_MINIMA` then search all intervals, one each. All attempts share one loop, which is
        compiled once.
        """
        none, nothing = self._missing(roll), jnp.zeros_like(roll)
        rolling, usual, absent = self._direct(roll, relative)

        def look(carry):
            attempt, best = carry
            direct = attempt == 0
            bracket, guess, present, single = lax.cond(
                direct, lambda: rolling, lambda: bracket_of(self, attempt, roll, relative)
            )
            root, converged = root_in(self, bracket, guess, ~direct, roll, relative)
            gap, normal1, lever1, lever2, normal2 = root
            if self.frozen.wavy:  # A pair this deep belongs to the other flank of the lobe.
                present &= gap > -DEEPEST * self.profile.pitch_radius
            rank = jnp.maximum(attempt - 1.0, 0.0) if self.frozen.wavy else nothing
            new = ClosestApproach(gap, lever1, lever2, normal1, normal2, present, rank)
            better = present & ((gap < best.gap) | (attempt < 2))
            best = jax.tree.map(lambda x, y: jnp.where(better, x, y), new, best)
            certain = usual & (converged | absent)
            done = jnp.where(direct, certain, single)
            best = jax.tree.map(lambda x, y: jnp.where(direct & ~done, x, y), none, best)
            return jnp.where(done, _DONE, 0) + attempt + 1, best

        start = jnp.asarray(attempt if self._trusted else max(attempt, 1)), none
        limit = 1 + _MINIMA if self.frozen.wavy else 3
        attempts, best = lax.while_loop(lambda carry: carry[0] < limit, look, start)
        return attempts % _DONE, best

    @property
    def _trusted(self) -> bool:
        """Whether a single minimum of the gap between two nodes is the closest approach."""
        return self.rolling and not self.frozen.wavy

    def _missing(self, roll) -> ClosestApproach:
        """Return the closest approach of flanks without a common normal, at a `roll` (rad).

        If the contact may be handed over, its normal angle lies beyond the lobe's axis by twice
        `BEYOND`. Next to the axis, a `NearContact` would find the contact of the other flank."""
        nothing = jnp.zeros_like(roll)
        normal2 = 0.0 if self.rolling else self.nodes.normal[0] - 2 * BEYOND
        return ClosestApproach(
            gap=jnp.full_like(roll, self.profile.pitch_radius),
            lever1=nothing,
            lever2=nothing,
            normal1=nothing,
            normal2=nothing + normal2,
            found=jnp.zeros(roll.shape, bool),
            rank=nothing,
        )

    def _direct(self, roll, relative):
        """Return the start of Newton's method at perfect rolling, and two flags.

        The first tells whether its result may be trusted, the second whether the flanks cannot
        touch yet. `roll`, `relative`: as in `_mesh`. The start has the form of the result of
        `bracket_of`."""
        low, high = self.nodes.normal[0], self.nodes.normal[-1]
        absent = roll < contact_begins(relative)
        start = (low, high), jnp.clip(self.profile.normal_at(roll), low, high), ~absent, ~absent
        usual = (relative <= 0) & (relative >= -self.profile.single_turn)
        if self.profile.cusp:
            usual &= roll < (1 - 5 * jnp.sqrt(jnp.abs(relative))) * self.profile.half_pitch
        if self.profile.forked:
            joints = jnp.stack([one.stop for one in self.profile.segments()[:-1]])
            beside = jnp.abs(roll - self.profile.roll_angle(joints)) < _FORK * jnp.abs(relative)
            usual &= ~jnp.any(beside)
        return start, usual, absent

    def _search_all(self, roll: Float[Array, " n"], relative: Float[Array, " n"]):
        """Return the closest approaches at many poses, as `_search` would find them.

        Attempt 1 is made for groups of poses, and `_search` only where attempt 1 does not find
        exactly one minimum. `roll`, `relative` (n,): as in `_mesh`."""
        count = roll.size

        def attempt(roll, relative):
            """Return the closest approach of attempt 1, and whether it is certain."""
            bracket, guess, present, single = bracket_of(self, 1, roll, relative)
            closest, _ = root_in(self, bracket, guess, jnp.ones((), bool), roll, relative)
            gap, normal1, lever1, lever2, normal2 = closest
            _, usual, absent = self._direct(roll, relative)
            absent &= usual
            present &= ~absent
            new = ClosestApproach(gap, lever1, lever2, normal1, normal2, present, 0.0 * gap)
            new = jax.tree.map(lambda x, y: jnp.where(present, x, y), new, self._missing(roll))
            return new, single & present | absent

        def one(k, closest):
            place = rest[k]
            new = self._search(roll[place], relative[place])[1]
            return jax.tree.map(lambda x, y: x.at[place].set(y), closest, new)

        poses = roll, relative
        with trig.computed_once():
            closest, certain = lax.map(lambda pose: attempt(*pose), poses, batch_size=_MANY)
        (rest,) = jnp.nonzero(~certain, size=count, fill_value=0)
        return lax.fori_loop(0, jnp.sum(~certain), one, closest)


def _searched(pair: FlankPair, roll, relative):
    """Return the closest approach, without derivatives, for a `roll` from `FlankPair.folded`.

    `relative`: ε (rad). On a CPU, the poses of a batch are searched one at a time, unless the pair
    is to search them `together`. If the flanks are `rolling`, one pose rarely needs the bracketing
    on all nodes (`bracket_of`). A batch searched as a whole would do it for every pose.
    Batches of pairs are always searched one pair at a time."""
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)

    def search(dynamic, roll, relative):
        pair = eqx.combine(dynamic, static)
        searcher = eqx.tree_at(lambda pair: pair.profile, pair, pair.frozen)
        if roll.ndim == 0:
            return searcher._search(roll, relative)[1]
        poses = roll.ravel(), relative.ravel()
        if pair.together and searcher._trusted and roll.size >= _MANY:
            closest = searcher._search_all(*poses)
        else:
            closest = lax.map(lambda pose: searcher._search(*pose)[1], poses)
        return jax.tree.map(lambda x: x.reshape(roll.shape), closest)

    if jax.default_backend() != "cpu":
        return search(dynamic, roll, relative)
    poses = custom_vmap(search)

    @poses.def_vmap
    def _(size, batched, dynamic, *pose):
        if any(jax.tree.leaves(batched[0])):
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
            closest = jax.vmap(sequential_vmap(poses), axes)(dynamic, *pose)
        else:
            pose = (
                x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
                for x, is_batched in zip(pose, batched[1:], strict=True)
            )
            closest = poses(dynamic, *pose)
        return closest, jax.tree.map(lambda _: True, closest)

    return poses(dynamic, roll, relative)


def contact_begins(relative: Float[Array, ""]) -> Float[Array, ""]:
    """Return the roll coordinate (rad) below which flanks cannot touch at ε = `relative` ≤ 0 (rad).

    Contact starts about √|ε| (rad) before the tip passes the line of centres."""
    return -(2 * jnp.sqrt(jnp.maximum(-relative, 0.0)) + 0.02)


def _circle(angle):
    """Return cosine and sine of an `angle` (rad), stacked along a new first axis."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])
