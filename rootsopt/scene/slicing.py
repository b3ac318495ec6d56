"""Number of slices along twisted rotors that keep the error of the contact torque below a limit."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.config import TWIST, Config
from rootsopt.contact.law import ContactLaw
from rootsopt.contact.search import SearchContact
from rootsopt.profiles import Profile
from rootsopt.runtime.programs import CachedFunction

MOST = 32
"""Maximum number of slices that is chosen automatically."""
# Numbers of slices that are tried, in ascending order.
_COUNTS = (*range(2, 13), 14, 16, 20, 24, 28, MOST)
# Number of angles of rotor 1, evenly spaced over a mesh period, at which torques are computed.
_POSES = 720
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
    """Return the least number of Gauss points with which the contact torque errs less than `error`.

    The torque is that at rest. The rotors are turned towards each other until the `clearance` (m)
    is closed and the penetration at the pitch radius is the static one, `depth` (m). The error is
    the mean magnitude over a mesh period, as a fraction of the greatest torque. The greatest error
    is not used: where a whole arc touches at once, the torque of a slice jumps, and no number of
    slices makes this error small. `twist` (rad): over the rotor's length. The result is at most
    `MOST`."""
    torque = np.asarray(_torques(profile, law, clearance, depth))
    wanted = sliced_mean(torque, twist * (np.arange(_REFERENCE) + 0.5) / _REFERENCE, profile.lobes)
    for count in _COUNTS:
        places, weights = np.polynomial.legendre.leggauss(count)
        found = sliced_mean(torque, twist * places / 2, profile.lobes, weights / 2)
        # The reference covers 0 … Φ, the Gauss points -Φ/2 … Φ/2.
        shifted = sliced_mean(found, np.array([twist / 2]), profile.lobes)
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
    """Return the contact torques (n,) in N·m on rotor 2 at `_POSES` angles of rotor 1."""
    contact = SearchContact.of(profile)
    relative = -(clearance + depth) / profile.pitch_radius
    phi = 2 * jnp.pi / profile.lobes * jnp.arange(_POSES) / _POSES

    def torque(phi):
        gap, _, lever = contact(-phi - relative / 2, relative)
        return lever * law(-gap - clearance, jnp.zeros_like(gap))

    return jax.vmap(torque)(phi)
