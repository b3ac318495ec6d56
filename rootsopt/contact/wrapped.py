"""Contacts that modify the contact of a section: twisted rotors, and flanks worn where they slide.

Also finds how many slices of twisted rotors keep the error of the contact torque below a limit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.config.reading import Config
from rootsopt.config.study import TWIST
from rootsopt.contact.gap import Approach, Contact, Slices, WrappedContact
from rootsopt.contact.law import ContactLaw
from rootsopt.contact.search import SearchContact
from rootsopt.profiles import Profile
from rootsopt.runtime.programs import CachedFunction


class TwistedContact(WrappedContact):
    """The contact of a section, with the Gauss points along the length of twisted rotors.

    Gap, levers and point are those of the `section`, an untwisted contact; the rotor pair evaluates
    it once per slice. `twist` (rad): angle from the section at the near end of a rotor to that at
    the far end, positive in the rotor's own sense of rotation. `count`: number n of slices.

    Let u be the distance of a slice from the middle, as a share of the length, -1/2 ≤ u ≤ 1/2. Its
    pose is φ1 + Φ u, φ2 + Φ u, with the twist Φ. Gauss-Legendre quadrature integrates polynomials
    in u up to the degree 2n - 1 exactly."""

    section: Contact
    twist: Float[Array, ""]
    count: int = eqx.field(static=True)

    @property
    def sections(self) -> int:
        return self.count

    @property
    def slices(self) -> Slices:
        return slices_of(self.twist, self.count)


def slices_of(twist: Float[Array, ""], count: int) -> Slices:
    """Return `count` Gauss points along rotors with the `twist` (rad) over their length."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    places = jnp.asarray(nodes / 2, twist.dtype)
    return Slices(places, jnp.asarray(weights / 2, twist.dtype), twist * places, twist)


LINES = 12
"""Number of cosine terms in the series of the wear over the roll coordinate, without the mean."""
# Number of roll angles from which the coefficients of the series are computed.
_POSES = 512


class WornContact(WrappedContact):
    """The contact of flanks that are worn to a depth w, a function of the roll coordinate x.

    `section`: the contact of new flanks; `coefficients` (k,): of w(x) = Σ a_k cos(2 N k x) in m;
    `lobes`: N as an array. The gap grows by w. Lever 1 grows by w'/2 and lever 2 falls by w'/2,
    because x = -(φ1 + φ2)/2. The force therefore still has a potential."""

    section: Contact
    coefficients: Float[Array, " k"]
    lobes: Float[Array, ""]

    def approach(self, roll, relative) -> Approach:
        approach = self.section.approach(roll, relative)
        depth, rate = series_at(self.coefficients, self.lobes, roll)
        return approach._replace(
            gap=approach.gap + depth,
            lever1=approach.lever1 + rate / 2,
            lever2=approach.lever2 - rate / 2,
        )


def series_at(
    coefficients: Float[Array, " k"], lobes: Float[Array, ""], roll: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return w (m) and dw/dx (m/rad) at x = `roll` (rad); see `WornContact`."""
    order = 2 * lobes * jnp.arange(coefficients.shape[0])
    depth = jnp.dot(coefficients, jnp.cos(order * roll))
    return depth, -jnp.dot(coefficients * order, jnp.sin(order * roll))


def wear_shape(profile: Profile, roll: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the relative wear of both flanks together at the roll angle `roll` (rad).

    Archard's law: the depth worn by a line contact is proportional to F' u / v. F' is the force per
    length, v the speed of the contact over the surface, and u the sliding speed. Here u = 2 ω s,
    and v = ω dl/dβ on each flank: 2 |s| (dβ/dl1 + dβ/dl2), without unit. F' is taken as constant.
    """
    half = profile.half_pitch
    nu = profile.normal_at(half - jnp.abs(roll - half))
    point, addendum, dedendum = profile.speeds(nu)
    lengths = 1 / jnp.abs(addendum) + 1 / jnp.abs(dedendum)
    return 2 * jnp.abs(point.s) * profile.roll_rate(nu) * lengths


def wear_series(profile: Profile, depth: Float[Array, ""]) -> Float[Array, " k"]:
    """Return the coefficients (k,) in m of a wear whose greatest value is `depth` (m).

    They are those of the Fourier series of `wear_shape`, damped after Fejér, so that the series has
    no ripples and is never negative."""
    lobes = profile.lobes
    roll = jnp.pi / lobes * (jnp.arange(_POSES) + 0.5) / _POSES
    shape = wear_shape(profile, roll)
    shape = jnp.where(jnp.isfinite(shape), shape, 0.0)
    order = jnp.arange(LINES + 1)
    waves = jnp.cos(2 * lobes * order[:, None] * roll)
    means = waves @ shape / _POSES * jnp.where(order > 0, 2.0, 1.0) * (1 - order / (LINES + 1))
    values = means @ waves
    most = values[jnp.argmax(lax.stop_gradient(values))]
    return depth * means / most


MOST = 32
"""Maximum number of slices that is chosen automatically."""
# Numbers of slices that are tried, in ascending order.
_COUNTS = (*range(2, 13), 14, 16, 20, 24, 28, MOST)
# Number of angles of rotor 1, evenly spaced over a mesh period, at which torques are computed.
_TORQUES = 720
# Number of evenly spaced slices of the reference.
_REFERENCE = 400


def greatest_twist(config: Config) -> float:
    """Return the greatest magnitude (°) of the twist of a `config`, within its bounds if free."""
    bounds = config.optimizer.bounds[TWIST] if config.twist_free else None
    return max(map(abs, (config.rotor.helix_deg, *(bounds or ()))))


def slices_needed(
    profile: Profile,
    law: ContactLaw,
    clearance: Float[Array, ""],
    depth: Float[Array, ""],
    twist: float,
    error: float,
) -> int:
    """Return the least number of Gauss points with an error of the contact torque below `error`.

    The torque is that at rest. The rotors are turned towards each other, through the `clearance`
    (m), until the penetration at the pitch radius is the static one, `depth` (m). The error is the
    mean magnitude over a mesh period, as a fraction of the greatest torque. The greatest error is
    not used: where a whole arc touches at once, the torque of a slice jumps, and no number of
    slices makes this error small. `twist` (rad): over the rotor's length. The result is at most
    `MOST`."""
    torque = np.asarray(_torques(profile, law, clearance, depth))
    wanted = sliced_mean(torque, twist * (np.arange(_REFERENCE) + 0.5) / _REFERENCE, profile.lobes)
    for count in _COUNTS:
        places, weights = np.polynomial.legendre.leggauss(count)
        mean = sliced_mean(torque, twist * places / 2, profile.lobes, weights / 2)
        # The reference covers 0 … Φ, the Gauss points -Φ/2 … Φ/2.
        shifted = sliced_mean(mean, np.array([twist / 2]), profile.lobes)
        if np.mean(np.abs(shifted - wanted)) <= error * np.max(np.abs(wanted)):
            return count
    return MOST


def sliced_mean(
    values: NDArray[np.float64],
    offsets: NDArray[np.float64],
    lobes: int,
    weights: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return the mean (n,) over slices of `values` (n,), which are evenly spaced over a mesh
    period.

    `offsets` (s,): angles of the slices (rad); `weights` (s,): by default equal ones; `lobes`: N.
    Values between those given are interpolated linearly."""
    count = len(values)
    weights = np.full(len(offsets), 1 / len(offsets)) if weights is None else weights
    place = np.arange(count)[:, None] + offsets * lobes * count / (2 * np.pi)
    whole = np.floor(place).astype(int)
    share = place - whole
    between = (1 - share) * values[whole % count] + share * values[(whole + 1) % count]
    return between @ weights


@CachedFunction
def _torques(profile: Profile, law: ContactLaw, clearance, depth) -> Float[Array, " n"]:
    """Return the contact torques (n,) in N·m on rotor 2 at `_TORQUES` angles of rotor 1.

    `clearance`, `depth`: clearance and static penetration (m)."""
    contact = SearchContact.of(profile)
    relative = -(clearance + depth) / profile.pitch_radius
    phi = 2 * jnp.pi / profile.lobes * jnp.arange(_TORQUES) / _TORQUES

    def torque(phi):
        gap, _, lever = contact(-phi - relative / 2, relative)
        return lever * law(-gap - clearance, jnp.zeros_like(gap))

    return jax.vmap(torque)(phi)
