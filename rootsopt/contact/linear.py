"""First order in the relative rotation, in closed form: the cheapest rung.

In perfect rolling (ε = 0) the pair touches at roll angle β = x, where the common normal
has the moment arm r cos ψ(x) about both axes. To first order in ε the gap is therefore

    G = r cos ψ(x) · ε,

exact for involute on involute. Levers are the derivatives of this very gap, so forces
come from a potential. The error is of second order in ε over the smooth stretches; it
grows towards a tip arc centred on the pitch circle, which all meshes at one instant.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.contact.gap import Contact
from rootsopt.profiles.base import Profile


class LinearContact(Contact):
    """Gap and levers of a flank pair at a pose, to first order in ε.

    Call it with roll coordinate and ε (rad); see `FlankPair` for their meaning. `profile`:
    both rotors' profile.
    """

    profile: Profile

    @property
    def smooth(self) -> bool:
        """False: its levers jump, which no switch tells."""
        return False

    @classmethod
    def of(cls, profile: Profile) -> "LinearContact":
        """The contact of `profile`; there is nothing to prepare."""
        return cls(profile)

    def __call__(
        self, roll: Float[Array, ""], relative: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """Gap (m) and the levers about rotor 1 and rotor 2 (m).

        Contact begins with the first point of the flank that can carry torque (the end of
        the tip land): before it there is none, the gap is the pitch radius and the levers
        are zero. The depth starts from zero there, unless the whole tip arc meshes at once.
        """
        profile = self.profile
        half = profile.half_pitch
        centered = roll - half
        centered = centered - 4 * half * jnp.round(centered / (4 * half))
        # Beyond the pitch point the rotors have changed places; the lever, r cos ψ, is even.
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
