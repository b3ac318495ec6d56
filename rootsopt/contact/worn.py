"""Contact of worn flanks: the gap grows where they slide under load."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.contact.gap import Approach, Contact
from rootsopt.contact.wrapped import WrappedContact
from rootsopt.profiles import Profile

LINES = 12
"""Number of cosine terms in the series of the wear over the roll coordinate, without the mean."""
# Number of roll angles from which the coefficients of the series are computed.
_POSES = 512


class WornContact(WrappedContact):
    """The contact of flanks that are worn by a depth w which follows the roll coordinate x.

    `section`: the contact of new flanks; `coefficients` (k,): of w(x) = Σ a_k cos(2 N k x) in m;
    `lobes`: N as an array. The gap grows by w. So that the force still has a potential, lever 1
    grows by w'/2 and lever 2 falls by w'/2, because x = -(φ1 + φ2)/2."""

    section: Contact
    coefficients: Float[Array, " k"]
    lobes: Float[Array, ""]

    def approach(self, roll, relative) -> Approach:
        found = self.section.approach(roll, relative)
        depth, rate = series_at(self.coefficients, self.lobes, roll)
        return found._replace(
            gap=found.gap + depth, lever1=found.lever1 + rate / 2, lever2=found.lever2 - rate / 2
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

    Archard's law: a line contact wears off a depth proportional to F' u / v. F' is the force per
    length, v the speed of the contact over the surface, and u the sliding speed. Here u = 2 ω s,
    and v = ω dl/dβ on each flank: 2 |s| (dβ/dl1 + dβ/dl2), without unit. F' is taken as constant.
    """
    half = profile.half_pitch
    nu = profile.normal_at(half - jnp.abs(roll - half))
    point, addendum, dedendum = profile.speeds(nu)
    lengths = 1 / jnp.abs(addendum) + 1 / jnp.abs(dedendum)
    return 2 * jnp.abs(point.s) * profile.roll_rate(nu) * lengths


def wear_series(profile: Profile, depth: Float[Array, ""]) -> Float[Array, " k"]:
    """Return the coefficients (k,) of the wear in m whose greatest value is `depth` (m).

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
