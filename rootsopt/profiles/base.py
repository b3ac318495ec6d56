"""The roll-angle core: one description of a conjugate flank for every profile family.

Two identical rotors with `N` lobes roll 1:1 on pitch circles of radius `r`. A family
describes only the *addendum* of one flank, as a function of the normal angle `nu` (the
polar angle of the outward normal in the rotor frame, measured from the lobe's axis):

- `roll_angle(nu)` is β, the polar angle, on the rotor, of the pitch point at the moment
  the flank point is in contact;
- `contact_distance(nu)` is s, the signed distance from pitch point to contact point.

The pressure angle is then ψ = β + π/2 - ν, the flank point

    P = R(β) [r + s sin ψ, s cos ψ],      ds/dβ = -r cos ψ   (law of gearing),

and the dedendum follows by symmetry: β → π/N - β, ψ → ψ, s → -s. The normal angle is
used as parameter, rather than β, because a tip arc centred on the pitch circle keeps β
constant over the whole arc (all of it meshes at one instant), while ν stays regular.

Lengths are in metres, angles in radians. Everything is differentiable in the design.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

_BRACKETS = 16
"""Intervals of a segment between which the normal angle at a roll angle is searched."""
_STEPS = 10
"""Guarded Newton steps of this search; each at least halves the bracket where Newton's fails."""
_POLISH = 3
"""Plain Newton steps after these, with as many derivatives."""
_FLAT = 1e-9
"""Least dβ/dν in these steps: on an arc centred on the pitch circle it is 0."""


class RollPoint(NamedTuple):
    """A flank point in roll-angle form.

    `beta`: roll angle (rad); `psi`: pressure angle (rad); `s`: signed distance from the
    pitch point to the contact point (m), positive on the addendum.
    """

    beta: Float[Array, "*n"]
    psi: Float[Array, "*n"]
    s: Float[Array, "*n"]


class Segment(NamedTuple):
    """A stretch of the addendum between two normal angles, smooth inside.

    `land` marks a stretch concentric with the rotor (ψ = π/2), which carries no torque
    and therefore takes no part in the search for flank contact.
    """

    name: str
    start: Float[Array, ""]
    stop: Float[Array, ""]
    land: bool


class Quadrature(NamedTuple):
    """How integrals over a stretch of a profile are taken: `nodes` of Gauss and Legendre, on an
    even scale or (`graded`) crowding towards both ends, and how many further places `between` are
    looked at for undercut."""

    nodes: int
    graded: bool
    between: int


class Mate(NamedTuple):
    """A point of the partner's flank: `facing`, the direction (rad) of its outward normal from
    the axis of the valley; `lever` and `support` (m) of that normal."""

    facing: Float[Array, "*n"]
    lever: Float[Array, "*n"]
    support: Float[Array, "*n"]


class Profile(eqx.Module):
    """One flank of a conjugate Roots rotor; see the module's docstring.

    Subclasses give `segments`, `roll_angle` and `contact_distance` on 0 ≤ ν ≤ `pitch_normal`,
    continued analytically beyond the pitch point and, unless the first segment is a land, over
    the tip (β odd and s even in ν). All else follows. `normal_at`, `lever` and `support` may be
    given where there is a closed form, which is quicker and more exact.
    """

    lobes: eqx.AbstractVar[int]
    pitch_radius: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def segments(self) -> tuple[Segment, ...]:
        """The smooth stretches of the addendum, from the tip to the pitch point."""

    def stretches(self) -> tuple[Segment, ...]:
        """The segments, cut for quadrature: where they are smooth to a few derivatives only, and
        where the pressure angle is least inside of one.

        There a normal may all but touch the pitch circle, where ψ has a root."""
        return self.segments()

    @property
    def quadrature(self) -> Quadrature:
        """How integrals over each of the `stretches` are taken.

        By default nodes crowd towards the ends, and resolve a root of ψ there to rounding even if
        it lies 1e-4 of the stretch beyond."""
        return Quadrature(64, True, 128)

    def _cut(self, segment: Segment, place: Float[Array, ""]) -> tuple[Segment, Segment]:
        """A segment in two parts; one of them is empty if `place` lies outside."""
        name, start, stop, land = segment
        middle = jnp.clip(lax.stop_gradient(place), start, stop)
        return Segment(name, start, middle, land), Segment(name, middle, stop, land)

    @abc.abstractmethod
    def roll_angle(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """β(ν) in rad, non-decreasing for a profile free of interference."""

    @abc.abstractmethod
    def contact_distance(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """s(ν) in m."""

    def normal_at(self, roll_angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """ν(β) in rad: the inverse of `roll_angle` up to the pitch point.

        Where several points mesh at one instant, or the roll angle turns back, it is the
        one nearest to the pitch point. By default it is searched, with the derivatives of the
        implicit function; a closed form is quicker.
        """
        return _inverse(self, roll_angle)

    def lever(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Moment arm r cos ψ (m) of the contact normal about the rotor's axis."""
        return self.pitch_radius * jnp.sin(nu - self.roll_angle(nu))

    def support(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Support function P·n = r sin ψ + s (m) of the addendum; its slope is -lever."""
        arm = self.pitch_radius * jnp.cos(nu - self.roll_angle(nu))
        return arm + self.contact_distance(nu)

    def mate(self, nu: Float[Array, "*n"], support: bool = True) -> Mate:
        """The partner's point that meshes with the addendum point `nu`; beyond the pitch normal
        that of the partner's addendum, reflected there. Without `support` that is not computed
        (and 0)."""
        pitch = self.pitch_normal
        beyond = nu > pitch
        nu = jnp.where(beyond, 2 * pitch - nu, nu)
        beta = self.roll_angle(nu)
        psi = beta + jnp.pi / 2 - nu
        mate_beta = jnp.where(beyond, jnp.pi / self.lobes - beta, beta)
        facing = jnp.pi / 2 - psi - mate_beta
        lever = self.pitch_radius * jnp.cos(psi)
        if not support:
            return Mate(facing, lever, jnp.zeros_like(lever))
        s = self.contact_distance(nu)
        arm = self.pitch_radius * jnp.sin(psi)
        return Mate(facing, lever, arm + jnp.where(beyond, s, -s))

    @property
    def conjugate(self) -> bool:
        """Whether the flanks touch all through the mesh in perfect rolling, by construction."""
        return True

    @property
    def search_nodes(self) -> int:
        """Nodes per segment that the closest approach is bracketed with; they only have to
        separate its candidates."""
        return 32

    @property
    def turn_ratio(self) -> float:
        """κ: `arms` may use the cosine and sine of κ ν, which a search over many poses
        has at no cost."""
        return 1.0

    @property
    def cusp(self) -> bool:
        """Whether the flank's radius of curvature vanishes at the pitch crossing (ψ = 0),
        where two minima of the gap may then be almost equally deep."""
        return True

    def lever_from(
        self, nu: Float[Array, "*n"], cos: Float[Array, "*n"], sin: Float[Array, "*n"]
    ) -> Float[Array, "*n"]:
        """`lever` (m) at `nu`, given cos κν and sin κν."""
        del cos, sin
        return self.lever(nu)

    @property
    def half_pitch(self) -> float:
        """π/2N: the polar angle between a lobe's axis and its pitch crossing (rad)."""
        return jnp.pi / (2 * self.lobes)

    @property
    def pitch_normal(self) -> Float[Array, ""]:
        """Normal angle at the pitch crossing (rad)."""
        return self.segments()[-1].stop

    def addendum(self, nu: Float[Array, "*n"]) -> RollPoint:
        """The addendum point with normal angle `nu`."""
        beta = self.roll_angle(nu)
        return RollPoint(beta, beta + jnp.pi / 2 - nu, self.contact_distance(nu))

    def dedendum(self, nu: Float[Array, "*n"]) -> RollPoint:
        """The dedendum point that meshes with the partner's addendum point `nu`."""
        point = self.addendum(nu)
        return RollPoint(jnp.pi / self.lobes - point.beta, point.psi, -point.s)

    def position(self, point: RollPoint) -> Float[Array, "*n 2"]:
        """Cartesian coordinates (m) in the rotor frame, lobe tip on +x."""
        beta, psi, s = point
        radial = self.pitch_radius + s * jnp.sin(psi)
        tangential = s * jnp.cos(psi)
        cos, sin = jnp.cos(beta), jnp.sin(beta)
        return jnp.stack(
            [radial * cos - tangential * sin, radial * sin + tangential * cos], axis=-1
        )

    def roll_rate(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """dβ/dν, between 0 (tip arc centred on the pitch circle) and 1 (involute)."""
        return jax.jvp(self.roll_angle, (nu,), (jnp.ones_like(nu),))[1]

    def speeds(
        self, nu: Float[Array, "*n"]
    ) -> tuple[RollPoint, Float[Array, "*n"], Float[Array, "*n"]]:
        """The addendum's point, and arc length per normal angle (m/rad) on the addendum and on
        the dedendum that meshes with it."""
        point, rate = self.addendum(nu), self.roll_rate(nu)
        sliding = self.pitch_radius * jnp.sin(point.psi)
        return point, sliding * rate + point.s, (sliding - 2 * point.s) * rate + point.s

    def addendum_speed(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Arc length per normal angle (m/rad) on the addendum: its radius of curvature."""
        return self.speeds(nu)[1]

    def dedendum_speed(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Arc length on the dedendum per normal angle of the partner (m/rad).

        On an involute or land this is the tangential speed r sin ψ + s (1 - ψ′) of the
        contact point per roll angle; zero is a cusp and a negative value is undercut.
        """
        return self.speeds(nu)[2]

    def dedendum_curvature_radius(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Signed radius of curvature of the dedendum (m): positive convex, negative concave."""
        turning = 2 * self.roll_rate(nu) - 1
        return self.dedendum_speed(nu) / turning


def _inverse(profile: Profile, roll_angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The greatest normal angle (rad) at which `profile` has a roll angle, by safeguarded Newton.

    The search is not differentiated. Plain Newton steps at its end carry the derivatives with
    respect to roll angle and design, and continue the flank analytically beyond its ends."""
    fixed, want = jax.tree.map(lax.stop_gradient, (profile, roll_angle))

    def rolled(profile, nu):
        beta, rate = jax.jvp(profile.roll_angle, (nu,), (jnp.ones_like(nu),))
        return beta, jnp.maximum(rate, _FLAT)

    shares = jnp.arange(_BRACKETS) / _BRACKETS
    nodes = [one.start + (one.stop - one.start) * shares for one in fixed.segments()]
    nodes = jnp.append(jnp.concatenate(nodes), fixed.pitch_normal)
    begun = fixed.roll_angle(nodes[:-1]) <= want[..., None]
    last = jnp.max(jnp.where(begun, jnp.arange(len(nodes) - 1), 0), axis=-1)
    low, high = nodes[last], nodes[last + 1]
    nu = (low + high) / 2
    for _ in range(_STEPS):
        beta, rate = rolled(fixed, nu)
        low, high = jnp.where(beta <= want, nu, low), jnp.where(beta > want, nu, high)
        step = nu - (beta - want) / rate
        nu = jnp.where((step >= low) & (step <= high), step, (low + high) / 2)
    nu = lax.stop_gradient(nu)
    for _ in range(_POLISH):
        beta, rate = rolled(profile, nu)
        nu = nu - (beta - roll_angle) / rate
    return nu
