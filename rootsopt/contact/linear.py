"""Contact to first order in the relative rotation, in closed form: the cheapest fidelity.

In perfect rolling (ε = 0) the pair touches at roll angle β = x, where the common normal
has the moment arm r cos ψ(x) about both axes. To first order in ε the gap is therefore

    G = r cos ψ(x) · ε,

which is exact where an involute meets an involute. Levers are the derivatives of this gap, so that
forces come from a potential. The error is of second order in ε on smooth segments. It
grows towards a tip arc centred on the pitch circle, because all of that arc meshes at one instant.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.contact.gap import Contact
from rootsopt.profiles.base import Profile


class LinearContact(Contact):
    """Gap and levers of a flank pair at a pose, to first order in ε.

    Call an instance with the roll coordinate x and the relative rotation ε (rad), which `Contact`
    defines. `profile`: both rotors' profile.
    """

    profile: Profile

    @property
    def smooth(self) -> bool:
        """False: the levers jump without a change of `switches`."""
        return False

    @classmethod
    def of(cls, profile: Profile) -> "LinearContact":
        """Return the contact of `profile`. Nothing is computed in advance."""
        return cls(profile)

    def __call__(
        self, roll: Float[Array, ""], relative: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """Return gap and levers (m) of rotor 1 and rotor 2 at x = `roll`, ε = `relative` (rad).

        Contact starts with the first point of the flank that can carry torque (the end of the tip
        land). Before that point, there is no contact: the gap is the pitch radius and the levers
        are zero. The penetration starts at zero, unless the whole tip arc meshes at once.
        """
        profile = self.profile
        half = profile.half_pitch
        centered = roll - half
        centered = centered - 4 * half * jnp.round(centered / (4 * half))
        # Beyond the pitch crossing the rotors are exchanged; the lever, r cos ψ, is even.
        mirror = jnp.where(centered > 0, -1.0, 1.0)
        folded = half - jnp.abs(centered)
        first = profile.segments()[0]
        touching = profile.normal_at(folded) > (first.stop if first.land else first.start)

        def arm(x):
            return profile.lever(profile.normal_at(x))

        lever, slope = jax.jvp(arm, (folded,), (jnp.ones_like(folded),))
        # φ̄ = -x: ∂G/∂φ1 = -∂G/∂x / 2 - ∂G/∂ε = -lever1, ∂G/∂φ2 = lever2.
        by_roll = mirror * slope * relative
        zero = jnp.zeros_like(lever)
        return (
            jnp.where(touching, lever * relative, lax.stop_gradient(profile.pitch_radius)),
            jnp.where(touching, lever + by_roll / 2, zero),
            jnp.where(touching, lever - by_roll / 2, zero),
        )
