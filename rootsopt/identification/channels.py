"""Sampled quantities along a closed orbit, with their derivatives along directions of the pair."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.dynamics.collocation.elements import BLOCK
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import VariedOrbit
from rootsopt.runtime.programs import CachedFunction

CHANNELS = (
    "relative_rotation_rad", "relative_speed_rad_s", "drive_flank_force_N", "coast_flank_force_N",
    "contact_force_N", "penetration_m", "gear_torque_N_m", "shaft_torque_N_m",
)  # fmt: skip
"""Names of the sampled quantities: the columns of a response, then the torque of the timing gear on
rotor 1 and that of the shaft that drives rotor 1."""

# Number of samples computed by one call of the program: a record of any length needs one only.
_TOGETHER = 8 * BLOCK


def channels_at(
    pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit, tau: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the `CHANNELS` (n, c) at the times `tau` (n,), in mesh periods, and their derivatives.

    The derivatives (n, c, d + 1) are those along the directions to which the variation of the
    `orbit` belongs (`tangents`), then that with respect to time."""
    # The orbit and the rotors repeat together after this time; a late time would be rounded more.
    times = orbit.elements.mesh.times
    tau = np.mod(tau, pair.lobes * np.round(float(times[-1] - times[0])))
    padded = np.pad(tau, (0, -len(tau) % _TOGETHER))
    found = [_channels(pair, tangents, orbit, some) for some in padded.reshape(-1, _TOGETHER)]
    values, slopes = zip(*jax.device_get(found), strict=True)
    return np.concatenate(values)[: len(tau)], np.concatenate(slopes)[: len(tau)]


@CachedFunction
def _channels(pair: RotorPair, tangents: RotorPair, orbit: VariedOrbit, tau: Any):
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)
    directions = eqx.filter(tangents, eqx.is_inexact_array)
    still = jax.tree.map(lambda x: jnp.pad(x, ((0, 1),) + ((0, 0),) * (x.ndim - 1)), directions)

    def values(tau, state, dynamic):
        return _values(eqx.combine(dynamic, static), tau, state)

    def at(tau):
        state, rate, along = orbit.at(tau)
        times = jnp.append(jnp.zeros(along.shape[-1]), 1.0)
        changes = jnp.concatenate([along, rate[:, None]], axis=1)

        def push(time, change, moved):
            return jax.jvp(values, (tau, state, dynamic), (time, change, moved))

        return jax.vmap(push, (0, 1, 0), (None, -1))(times, changes, still)

    return lax.map(at, tau, batch_size=BLOCK)


def _values(pair: RotorPair, tau, state) -> Float[Array, " c"]:
    """Return the `CHANNELS` at a time (mesh periods) and scaled state."""
    motion, contact = pair.motion(tau, state), pair.contact_at(tau, state)
    nothing = jnp.zeros_like(motion.relative)
    gear = nothing if pair.gear is None else pair.gear.torque_on_1(motion, np.zeros(0))
    if pair.free:
        shaft = pair.drive.torque_on_1(motion, np.zeros(0))
    else:  # Rotor 1 turns uniformly: the shaft balances all other torques on it.
        each = zip(pair.all_parts, pair.own_states(state), strict=True)
        torques = [part.torque_on_1(motion, own) for part, own in each]
        shaft = -functools.reduce(jnp.add, [x for x in torques if x is not None], contact.torque1)
    assert gear is not None
    assert shaft is not None
    forces = contact.drive, contact.coast, contact.total
    return jnp.stack([motion.relative, motion.rate, *forces, contact.depth, gear, shaft])
