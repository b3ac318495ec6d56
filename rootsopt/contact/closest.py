"""Closest approach of the two flanks of a meshing pair, from true geometry.

The pose is the pair of roll coordinate x and relative rotation ε = φ2 - φ1 (rad): with
the mean angle φ = (φ1 + φ2)/2, a *drive* flank of rotor 1 (the one that pushes rotor 2
forward) has x = -φ. At ε = 0 the pair touches at roll angle β = x, 0 ≤ x ≤ π/N.

Both flanks are described by the normal angle of an addendum point: ν1 on rotor 1 and ν2
for the dedendum point of rotor 2 that meshes with it in perfect rolling. Where the two
normals are parallel, ν1 = ν2 - 2(β(ν2) - x), and with the pressure angle λ of that
common direction

    T = E cos λ - q1(ν1) - q2(ν2)      tangential offset of the two points,
    G = E sin λ - h1(ν1) - h2(ν2)      normal gap (negative: penetration),

q the levers, h the support functions, E the centre distance. The closest approach is
the root of T, bracketed on a fixed set of nodes and refined inside its bracket, so that
it cannot be lost where curvature jumps or the flanks conform. A root at which T falls
with growing ν2 is a minimum of the gap. By the envelope theorem
∂G/∂φ1 = -q1 and ∂G/∂φ2 = q2, which is also the virtual work of a unit contact force.

Exchanging the rotors maps x to π/N - x, so only the half with rotor 1's addendum in
rotor 2's dedendum is searched. Coast flanks follow from mirror symmetry, x → -x, ε → -ε.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rootsopt.profiles.base import Profile

# Nodes per smooth segment; they only have to separate the roots of T.
_NODES_PER_SEGMENT = 32
# Illinois steps inside the bracket (T has a kink there when ν1 crosses a segment's end,
# so plain Newton is not safe), before one Newton step. The tests measure the error.
_REFINEMENTS = 5


class ClosestApproach(NamedTuple):
    """Result of one search.

    `gap` (m, negative when the flanks penetrate); `lever1`, `lever2` (m): moment arms of
    the common normal about rotor 1 and rotor 2, so that d gap = -lever1 dφ1 + lever2 dφ2;
    `normal1`, `normal2` (rad): ν1 and ν2; `found`: whether the flanks have a common
    normal at all (otherwise the gap is +inf-like and the levers are zero).
    """

    gap: Float[Array, ""]
    lever1: Float[Array, ""]
    lever2: Float[Array, ""]
    normal1: Float[Array, ""]
    normal2: Float[Array, ""]
    found: Bool[Array, ""]


class FlankNodes(NamedTuple):
    """Where T is sampled: normal angles ν2 with what does not depend on the pose."""

    normal: Float[Array, " n"]
    facing: Float[Array, " n"]
    lever: Float[Array, " n"]
    support: Float[Array, " n"]


class FlankPair(eqx.Module):
    """A flank of rotor 1 against its mate on rotor 2.

    `profile`: both rotors' profile; `nodes`: see `FlankNodes`. Build it with
    `FlankPair.of(profile)` outside any time loop.
    """

    profile: Profile
    nodes: FlankNodes

    @classmethod
    def of(cls, profile: Profile) -> "FlankPair":
        """Prepare the search for `profile`; the nodes carry no derivative."""
        frozen = lax.stop_gradient(profile)
        segments = [s for s in frozen.segments() if not s.land]
        fraction = jnp.arange(_NODES_PER_SEGMENT) / _NODES_PER_SEGMENT
        pieces = [s.start + (s.stop - s.start) * fraction for s in segments[:-1]]
        if not frozen.segments()[0].land:
            # A rounded tip: at the hand-over the contact slides over its top. (A land
            # carries no torque, and contact just ends where it begins.)
            first = segments[0]
            pieces.insert(0, first.start - 0.5 * (first.stop - first.start) * fraction[:0:-1])
        # Nodes crowd around the pitch point, where a family with ψ = 0 (EE) has zero
        # radius of curvature. Rotor 2 may touch beyond its pitch point by about ε, so a
        # piece of its addendum is searched too, reflected about the pitch normal.
        start, stop = segments[-1].start, segments[-1].stop
        crowd = 0.5 ** jnp.arange(1, 8) / _NODES_PER_SEGMENT
        near = jnp.concatenate([fraction, 1 - crowd, jnp.ones(1), 1 + crowd[::-1]])
        beyond = 1 + jnp.arange(1, 1 + _NODES_PER_SEGMENT // 2) / _NODES_PER_SEGMENT
        pieces.append(start + (stop - start) * jnp.concatenate([near, beyond]))
        normal = jnp.concatenate(pieces)
        beta, psi, s = _mate_point(frozen, normal)
        arm = frozen.pitch_radius * jnp.stack([jnp.cos(psi), jnp.sin(psi)])
        facing = jnp.pi / 2 - psi - beta
        return cls(profile, FlankNodes(normal, facing, arm[0], arm[1] + s))

    def __call__(self, roll: Float[Array, ""], relative: Float[Array, ""]) -> ClosestApproach:
        """Closest approach at roll coordinate x = `roll` and ε = `relative` (rad).

        `roll` is reduced to one mesh period around the middle of the flank, so any angle
        may be given. Differentiable to first order in both and in the profile; the
        search itself is never differentiated.
        """
        half = self.profile.half_pitch
        centered = roll - half
        centered = centered - 4 * half * jnp.round(centered / (4 * half))
        mirrored = centered > 0
        folded = half - jnp.abs(centered)
        found, normal2, slope = lax.stop_gradient(self._search(folded, relative))
        # One Newton step with a frozen slope: the exact derivative of ν2, and the last
        # digits of its value. The gap needs neither (envelope theorem).
        polished = normal2 - self._offset(normal2, folded, relative) / slope
        gap, normal1, _, _ = self._mesh(normal2, folded, relative)
        _, _, lever1, lever2 = self._mesh(polished, folded, relative)
        far = self.profile.pitch_radius
        zero = jnp.zeros_like(gap)
        return ClosestApproach(
            gap=jnp.where(found, gap, lax.stop_gradient(far)),
            lever1=jnp.where(found, jnp.where(mirrored, lever2, lever1), zero),
            lever2=jnp.where(found, jnp.where(mirrored, lever1, lever2), zero),
            normal1=lax.stop_gradient(normal1),
            normal2=lax.stop_gradient(polished),
            found=found,
        )

    def _mesh(self, normal2, roll, relative):
        """G, ν1, q1, q2 at `normal2`, from the definition."""
        profile = self.profile
        r = profile.pitch_radius
        beta, psi, s2 = _mate_point(profile, normal2)
        facing = jnp.pi / 2 - psi - beta
        normal1 = facing + 2 * roll
        support = profile.support(normal1) + r * jnp.sin(psi) + s2
        gap = 2 * r * jnp.cos(facing + roll - relative / 2) - support
        return gap, normal1, profile.lever(normal1), r * jnp.cos(psi)

    def _offset(self, normal2, roll, relative):
        """T alone, with as little work as possible."""
        beta, psi, _ = _mate_point(self.profile, normal2, distance=False)
        facing = jnp.pi / 2 - psi - beta
        reach = 2 * self.profile.pitch_radius * jnp.sin(facing + roll - relative / 2)
        arms = self.profile.lever(facing + 2 * roll) + self.profile.pitch_radius * jnp.cos(psi)
        return reach - arms

    def _search(self, roll, relative):
        """Bracket on the nodes, a secant and a Newton step: (found, ν2, dT/dν2)."""
        frozen, roll, relative = lax.stop_gradient((self, roll, relative))
        profile, nodes = frozen.profile, frozen.nodes
        normal1 = nodes.facing + 2 * roll
        turn = nodes.facing + roll - relative / 2
        reach = 2 * profile.pitch_radius
        offset = reach * jnp.sin(turn) - profile.lever(normal1) - nodes.lever
        gap = reach * jnp.cos(turn) - profile.support(normal1) - nodes.support
        # Where T falls through zero the gap has a minimum. A second one occurs near the
        # pitch point of EE and at penetrations far beyond the contact law: the deeper
        # counts, judged by dG/dλ = T, T being linear between nodes.
        # The tolerance is for a root on a node: a compiled program may round T[i] one way
        # as the end of one interval and another way as the start of the next.
        slack = 1e-13 * profile.pitch_radius
        falling = (offset[:-1] >= -slack) & (offset[1:] < slack)
        fall = offset[:-1] - offset[1:]
        share = jnp.clip(offset[:-1] / jnp.where(fall > 0, fall, 1.0), 0.0, 1.0)
        drop = 0.5 * offset[:-1] * share * (nodes.facing[:-1] - nodes.facing[1:])
        index = jnp.argmin(jnp.where(falling, gap[:-1] + drop, jnp.inf))
        low, high = nodes.normal[index], nodes.normal[index + 1]
        best = _illinois(
            lambda nu: frozen._offset(nu, roll, relative),
            (low, high, offset[index], offset[index + 1]),
        )
        _, slope = jax.jvp(
            lambda nu: frozen._offset(nu, roll, relative), (best,), (jnp.ones_like(best),)
        )
        # No step from a point that is no minimum (no root found, or flat conformity).
        return falling[index], best, jnp.where(slope < 0, slope, -jnp.inf)


def _illinois(function, bracket):
    """Root of a falling scalar function in (low, high, f(low) ≥ 0, f(high) < 0)."""
    low, high, f_low, f_high = bracket
    side = jnp.zeros_like(low)

    def secant():
        drop = f_low - f_high
        return low + (high - low) * jnp.clip(f_low / jnp.where(drop > 0, drop, 1.0), 0, 1)

    # Unrolled: a traced loop costs more than its body here.
    for _ in range(_REFINEMENTS):
        middle = secant()
        f = function(middle)
        above = f >= 0
        # An end that stays twice in a row has its value halved (Illinois).
        f_high = jnp.where(above, jnp.where(side > 0, f_high / 2, f_high), f)
        f_low = jnp.where(above, f, jnp.where(side < 0, f_low / 2, f_low))
        low, high = jnp.where(above, middle, low), jnp.where(above, high, middle)
        side = jnp.where(above, 1.0, -1.0)
    return secant()


def _mate_point(profile, normal, distance=True):
    """(β, ψ, s) of rotor 2's point for ν2, where ν2 beyond the pitch normal stands for
    rotor 2's addendum, reflected; β and s are those of the meshing addendum point, so
    the dedendum itself has π/N - β and -s. Returns -s as the third entry."""
    pitch = profile.pitch_normal
    beyond = normal > pitch
    nu = jnp.where(beyond, 2 * pitch - normal, normal)
    beta = profile.roll_angle(nu)
    psi = beta + jnp.pi / 2 - nu
    s = profile.contact_distance(nu) if distance else nu
    mate_beta = jnp.where(beyond, jnp.pi / profile.lobes - beta, beta)
    return mate_beta, psi, jnp.where(beyond, s, -s)
