"""The roll-angle form: one description of a conjugate flank for all profile families.

Two identical rotors with `N` lobes roll 1:1 on pitch circles of radius `r`. A family
describes only the *addendum* of one flank, as a function of the normal angle `nu`. The normal
angle is the polar angle of the outward normal in the rotor frame, measured from the lobe's axis.
The family defines two functions:

- `roll_angle(nu)` is β, the polar angle, on the rotor, of the pitch point at the moment
  the flank point is in contact;
- `contact_distance(nu)` is s, the signed distance from pitch point to contact point.

The pressure angle is then ψ = β + π/2 - ν, the flank point

    P = R(β) [r + s sin ψ, s cos ψ],      ds/dβ = -r cos ψ   (law of gearing),

and the dedendum follows by symmetry: β → π/N - β, ψ → ψ, s → -s. The parameter is the normal
angle and not β, because all of a tip arc centred on the pitch circle meshes at one instant. β is
constant over such an arc, while ν stays regular.

Words used for all profiles: the *pitch crossing* is the flank point on the pitch circle; the
*lever* is the moment arm of a contact normal about the rotor's axis; the *support function* is the
distance of a point's tangent from that axis; a *land* is an arc centred on that axis.

Lengths are in metres, angles in radians. Everything is differentiable with respect to the design.

Cosine and sine are computed once where this pays (`rootsopt.runtime.compute_once`)."""

import abc
import contextlib
import functools
from collections.abc import Iterator
from contextvars import ContextVar
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rootsopt.runtime.compute_once import compute_once

_keeping = ContextVar("_keeping", default=False)


@contextlib.contextmanager
def computed_once() -> Iterator[None]:
    """Compute cosines and sines that are traced inside this context only once.

    A program that evaluates many points with derivatives runs faster, but takes longer to
    compile."""
    token = _keeping.set(True)
    try:
        yield
    finally:
        _keeping.reset(token)


def cos(angle: Float[ArrayLike, "*n"]) -> Float[Array, "*n"]:
    """Return the cosine of an `angle` (rad)."""
    return _circle(_keeping.get(), angle)[0]


def sin(angle: Float[ArrayLike, "*n"]) -> Float[Array, "*n"]:
    """Return the sine of an `angle` (rad)."""
    return _circle(_keeping.get(), angle)[1]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _circle(keep, angle):
    """Return cosine and sine of an `angle` (rad); `keep`: whether to `compute_once`."""
    angle = jnp.asarray(angle)
    values = lax.cos(angle), lax.sin(angle)
    return compute_once(values) if keep else values


@_circle.defjvp
def _(keep, primals, tangents):
    (cos, sin), (turned,) = _circle(keep, *primals), tangents
    return (cos, sin), (-sin * turned, cos * turned)


# Number of equal intervals into which a segment is divided. The search for the normal angle at a
# given roll angle starts in one of these intervals.
_BRACKETS = 16
# Number of safeguarded Newton steps in the search for the normal angle at a given roll angle. A
# step that leaves the bracket is replaced by a bisection.
_STEPS = 10
# Distance (rad) from the bracket above which a Newton step counts as leaving it. Without slack,
# rounding at the root could send the search back to the middle of a wide bracket.
_SLACK = 1e-9
# Number of plain Newton steps after the safeguarded ones. Derivatives of the result are correct up
# to this order.
_POLISH = 3
# Value of dβ/dν below which a Newton step divides by this constant instead of by dβ/dν. The
# derivative is 0 on an arc centred on the pitch circle.
_FLAT = 1e-9


class RollPoint(NamedTuple):
    """A flank point in roll-angle form.

    `beta`: roll angle (rad); `psi`: pressure angle (rad); `s`: signed distance from the
    pitch point to the contact point (m), positive on the addendum.
    """

    beta: Float[Array, "*n"]
    psi: Float[Array, "*n"]
    s: Float[Array, "*n"]


class Segment(NamedTuple):
    """A smooth part of the addendum between two normal angles.

    `name`: name in figures and messages; `start`, `stop`: normal angles (rad) at its ends; `land`:
    whether the segment is an arc centred on the rotor's axis (ψ = π/2). A land transmits no torque,
    so the search for flank contact usually skips it.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic")
    >>> design = jax.numpy.asarray(config.design)
    >>> profile = rootsopt.Scene.from_config(config).profile(design)
    >>> [(one.name, one.land) for one in profile.segments()]
    [('tip land', True), ('tip arc', False), ('involute', False)]
    """

    name: str
    start: Float[Array, ""]
    stop: Float[Array, ""]
    land: bool


class Quadrature(NamedTuple):
    """Rule for integrals over one smooth part of a profile (see `Profile.stretches`).

    `nodes`: number of Gauss-Legendre nodes; `graded`: whether the nodes are denser near both ends;
    `between`: number of equal intervals; undercut is also checked at their ends."""

    nodes: int
    graded: bool
    between: int


class Mate(NamedTuple):
    """A point of the partner's flank.

    `facing`: direction (rad) of the point's outward normal, measured from the axis of the valley
    between two lobes; `lever`: moment arm (m) of this normal about the partner's axis; `support`:
    support function (m) of the point."""

    facing: Float[Array, "*n"]
    lever: Float[Array, "*n"]
    support: Float[Array, "*n"]


class Profile(eqx.Module):
    """Base class of all profiles: one flank of a Roots rotor in roll-angle form.

    `lobes`: number of lobes N; `pitch_radius`: r (m). A subclass defines `segments`, `roll_angle`
    and `contact_distance` for normal angles 0 ≤ ν ≤ `pitch_normal`. The subclass continues both
    functions analytically beyond the pitch crossing. Unless the first segment is a land, it also
    continues them over the tip (β odd and s even in ν). This class derives everything else. A
    subclass may override `normal_at`, `lever` and `support` with a closed form, which is faster and
    more exact.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic")
    >>> design = jax.numpy.asarray(config.design)
    >>> profile = rootsopt.Scene.from_config(config).profile(design)
    >>> print(f"{1e3 * float(profile.contact_distance(0.0)):.2f} mm from pitch point to tip")
    12.10 mm from pitch point to tip
    """

    lobes: eqx.AbstractVar[int]
    pitch_radius: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def segments(self) -> tuple[Segment, ...]:
        """Return the smooth segments of the addendum, from the tip to the pitch crossing."""

    def stretches(self) -> tuple[Segment, ...]:
        """Return the parts of the addendum on which integrals are computed separately.

        The parts are the segments, split at two kinds of points. The first are points at which only
        a few derivatives are continuous. The second are minima of the pressure angle. There, a
        normal may almost touch the pitch circle, where ψ has a square-root singularity. By default,
        no segment is split."""
        return self.segments()

    quadrature: ClassVar[Quadrature] = Quadrature(64, True, 128)
    """Rule for integrals over each part in `stretches`.

    By default, nodes are denser near the ends. The rule integrates a square-root singularity of ψ
    to rounding error, even if the singularity lies only 1e-4 of the part's length beyond an end."""

    def _cut(self, segment: Segment, place: Float[Array, ""]) -> tuple[Segment, Segment]:
        """Return the two parts of a segment split at the normal angle `place` (rad).

        A `place` outside the segment is moved to the segment's nearest end."""
        name, start, stop, land = segment
        middle = jnp.clip(lax.stop_gradient(place), start, stop)
        return Segment(name, start, middle, land), Segment(name, middle, stop, land)

    @abc.abstractmethod
    def roll_angle(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the roll angle β(ν) (rad) of an addendum point.

        `nu`: normal angle (rad). In a profile free of interference, β does not decrease with ν."""

    @abc.abstractmethod
    def contact_distance(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the signed distance s(ν) (m) from the pitch point to the contact point.

        `nu`: normal angle (rad).
        """

    def normal_at(self, roll_angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the normal angle ν (rad) at a `roll_angle` β (rad) between tip and pitch crossing.

        Where several points mesh at one instant, or the roll angle turns back, return the normal
        angle of the point nearest to the pitch crossing. The default is a numerical search with the
        derivatives of the implicit function; a closed form is faster.
        """
        # The safeguarded Newton steps are not differentiated. The plain Newton steps after them
        # carry the derivatives with respect to roll angle and design. They also continue the flank
        # analytically beyond its ends.
        fixed, want = jax.tree.map(lax.stop_gradient, (self, roll_angle))

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
            inside = (step >= low - _SLACK) & (step <= high + _SLACK)
            nu = jnp.where(inside, step, (low + high) / 2)
        nu = lax.stop_gradient(nu)
        for _ in range(_POLISH):
            beta, rate = rolled(self, nu)
            nu = nu - (beta - roll_angle) / rate
        return nu

    def lever(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the moment arm r cos ψ (m) of the contact normal about the rotor's axis.

        `nu`: normal angle (rad)."""
        return self.pitch_radius * sin(nu - self.roll_angle(nu))

    def support(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the support function P·n = r sin ψ + s (m) of the addendum at `nu` (rad).

        Its derivative with respect to ν is -lever."""
        arm = self.pitch_radius * cos(nu - self.roll_angle(nu))
        return arm + self.contact_distance(nu)

    def mate(self, nu: Float[Array, "*n"], support: bool = True) -> Mate:
        """Return the point of the partner that meshes with an addendum point.

        `nu`: normal angle (rad) of the addendum point. If `nu` exceeds `pitch_normal`, the result
        is a point of the partner's addendum, with normal angle 2 `pitch_normal` - `nu`. `support`:
        whether to compute the support function, which is otherwise 0."""
        pitch = self.pitch_normal
        beyond = nu > pitch
        nu = jnp.where(beyond, 2 * pitch - nu, nu)
        beta = self.roll_angle(nu)
        psi = beta + jnp.pi / 2 - nu
        mate_beta = jnp.where(beyond, jnp.pi / self.lobes - beta, beta)
        facing = jnp.pi / 2 - psi - mate_beta
        # On rotor and partner the lever is r cos ψ. `lever` may know it without a roll angle.
        lever = self.lever(nu)
        if not support:
            return Mate(facing, lever, jnp.zeros_like(lever))
        s = self.contact_distance(nu)
        reach = self.support(nu)
        return Mate(facing, lever, jnp.where(beyond, reach, reach - 2 * s))

    def limit_margin(self) -> Float[Array, ""] | float:
        """Return the least distance of a ratio of the family from its limits in closed form.

        It is negative beyond a limit, and inf (the default) without such limits."""
        return float("inf")

    conjugate: ClassVar[bool] = True
    """Whether the flanks are designed to touch throughout the mesh in perfect rolling."""
    search_nodes: ClassVar[int] = 32
    """Number of nodes per segment on which the contact search brackets the closest approach.

    The nodes must be dense enough to separate the minima of the gap."""
    turn_ratio: ClassVar[float] = 1.0
    """Factor κ of the angle κν whose cosine and sine `lever_from` receives.

    The contact search computes this cosine and sine by the addition theorem, and thus evaluates no
    trigonometric function at the nodes."""
    cusp: ClassVar[bool] = True
    """Whether the flank's radius of curvature vanishes at the pitch crossing (ψ = 0).

    Two minima of the gap may then be almost equally deep there."""

    @property
    def inflected(self) -> bool:
        """Whether the curvature jumps at the pitch crossing, where the addendum ends.

        It is continuous there if the pressure angle is stationary, as on an involute. A `cusp` has
        no curvature; the contact jumps over it."""
        return not self.cusp

    @property
    def forked(self) -> bool:
        """Whether the gap may have two minima beside a joint of the flank.

        Where the curvature jumps, one rotor passes the joint before the other does. In between, the
        flanks may conform so closely that the contact jumps over this part. By default, any
        conjugate flank of several segments beside its land is forked, unless it is `wavy`."""
        if self.wavy or not self.conjugate:
            return False
        return sum(not one.land for one in self.segments()) > 1

    single_turn: ClassVar[float] = 1e-3
    """Relative rotation (rad) below which the gap is trusted to have no second, deeper minimum.

    The contact search accepts the minimum near the point of perfect rolling if Newton's method
    converges to it. This holds down to ε = -`single_turn`, at the nominal centre distance. Excluded
    are a fraction of the flank next to a cusp, about √|ε|, and one next to the joints of a `forked`
    flank, proportional to ε. Tests confirm the value."""
    wavy: ClassVar[bool] = False
    """Whether the gap may have any number of minima, because the curvature may rise and fall.

    The contact search then compares all minima at every pose. Otherwise, it relies on at most two:
    one near the point of perfect rolling, and one beside a cusp or a land."""

    def lever_from(
        self, nu: Float[Array, "*n"], cos: Float[Array, "*n"], sin: Float[Array, "*n"]
    ) -> Float[Array, "*n"]:
        """Return the lever (m) at the normal angle `nu` (rad), given two trigonometric functions.

        `cos`, `sin`: cosine and sine of κν, with the factor κ = `turn_ratio`."""
        return self.lever(nu)

    @property
    def half_pitch(self) -> float:
        """Polar angle π/2N (rad) between a lobe's axis and the pitch crossing of its flank."""
        return jnp.pi / (2 * self.lobes)

    @property
    def pitch_normal(self) -> Float[Array, ""]:
        """Normal angle (rad) at the pitch crossing."""
        return self.segments()[-1].stop

    def addendum(self, nu: Float[Array, "*n"]) -> RollPoint:
        """Return the addendum point at the normal angle `nu` (rad)."""
        beta = self.roll_angle(nu)
        return RollPoint(beta, beta + jnp.pi / 2 - nu, self.contact_distance(nu))

    def dedendum(self, nu: Float[Array, "*n"]) -> RollPoint:
        """Return the dedendum point that meshes with the partner's addendum point at `nu` (rad)."""
        point = self.addendum(nu)
        return RollPoint(jnp.pi / self.lobes - point.beta, point.psi, -point.s)

    def position(self, point: RollPoint) -> Float[Array, "*n 2"]:
        """Return the coordinates (m) of a `point` in the rotor frame, with a lobe tip on +x."""
        beta, psi, s = point
        radial = self.pitch_radius + s * jnp.sin(psi)
        tangential = s * jnp.cos(psi)
        cos, sin = jnp.cos(beta), jnp.sin(beta)
        return jnp.stack(
            [radial * cos - tangential * sin, radial * sin + tangential * cos], axis=-1
        )

    def roll_rate(self, nu: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return dβ/dν at the normal angle `nu` (rad).

        The value is 0 on a tip arc centred on the pitch circle, and 1 on an involute.
        """
        return jax.jvp(self.roll_angle, (nu,), (jnp.ones_like(nu),))[1]

    def speeds(
        self, nu: Float[Array, "*n"]
    ) -> tuple[RollPoint, Float[Array, "*n"], Float[Array, "*n"]]:
        """Return (addendum point, speed of the addendum, speed of the dedendum) at `nu` (rad).

        A speed is the arc length per normal angle `nu` (m/rad). That of the addendum is its radius
        of curvature. The dedendum is the partner's curve that meshes with the addendum; its speed
        is 0 at a cusp, and negative where it is undercut."""
        point, rate = self.addendum(nu), self.roll_rate(nu)
        sliding = self.pitch_radius * jnp.sin(point.psi)
        return point, sliding * rate + point.s, (sliding - 2 * point.s) * rate + point.s
