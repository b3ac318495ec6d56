"""Contact to first order in the relative rotation, in closed form: the cheapest fidelity.

In perfect rolling (ε = 0) the pair touches at roll angle β = x. There the common normal has the
moment arm r cos ψ(x) about both axes. To first order in ε the gap is therefore

    G = r cos ψ(x) · ε,

which is exact where an involute meets an involute. Levers are the derivatives of this gap, so that
forces come from a potential. The error is of second order in ε on smooth segments. It
grows towards a tip arc centred on the pitch circle, because all of that arc meshes at one instant.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.contact.gap import Approach, Contact, Edges
from rootsopt.profiles.base import Profile


class LinearContact(Contact):
    """Gap and levers of a flank pair at a pose, to first order in ε.

    Call an instance with the roll coordinate x and the relative rotation ε (rad), which `Contact`
    defines. `profile`: both rotors' profile.
    """

    profile: Profile

    @property
    def jumps(self) -> bool:
        """True: gap and levers jump where contact begins or ends, or an arc meshes at once."""
        return True

    @property
    def lever_scale(self) -> Float[Array, ""]:
        return self.profile.pitch_radius

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
        return self.approach(roll, relative)[:3]

    def approach(self, roll, relative) -> Approach:
        profile = self.profile
        folded, mirrored = _folded(profile, roll)
        # Beyond the pitch crossing the rotors are exchanged; the lever, r cos ψ, is even.
        mirror = jnp.where(mirrored, -1.0, 1.0)
        normal = profile.normal_at(folded)
        touching = normal > _first(profile)

        def arm(x):
            return profile.lever(profile.normal_at(x))

        lever, slope = jax.jvp(arm, (folded,), (jnp.ones_like(folded),))
        # φ̄ = -x: ∂G/∂φ1 = -∂G/∂x / 2 - ∂G/∂ε = -lever1, ∂G/∂φ2 = lever2.
        by_roll = mirror * slope * relative
        zero = jnp.zeros_like(lever)
        # The gap may jump at the ends of segments and, slightly, at the pitch crossing. Where the
        # roll angle turns back, the contact skips an end together with the next one.
        ends = jnp.stack([end for one in profile.segments() for end in (one.start, one.stop)])
        places = profile.roll_angle(ends).at[-1].set(profile.half_pitch)
        places = lax.cummin(places, reverse=True)
        # Compare normal angles, from which gap and levers follow as well: the roll angles of the
        # ends have a different rounding error.
        sides = jnp.where(normal > ends, 1, -1).at[-1].set(-1).astype(folded.dtype)
        return Approach(
            gap=jnp.where(touching, lever * relative, lax.stop_gradient(profile.pitch_radius)),
            lever1=jnp.where(touching, lever + by_roll / 2, zero),
            lever2=jnp.where(touching, lever - by_roll / 2, zero),
            place=normal,
            edges=Edges(jnp.sum(sides * (folded - places)), mirror * jnp.sum(sides)),
        )

    def switches(self, roll, approach: Approach):
        normal, profile = approach.place, lax.stop_gradient(self.profile)
        ends = jnp.stack([_first(profile), *(one.stop for one in profile.segments()[:-1])])
        return jnp.append(normal > ends, _folded(profile, roll)[1])


def _folded(profile: Profile, roll: Float[Array, ""]):
    """Return (x (rad) before the pitch crossing, whether the rotors are exchanged).

    `roll`: any x (rad). Symmetry maps it to the half of the mesh before the pitch crossing."""
    half = profile.half_pitch
    centered = roll - half
    centered = centered - 4 * half * jnp.round(centered / (4 * half))
    return half - jnp.abs(centered), centered > 0


def _first(profile: Profile) -> Float[Array, ""]:
    """Return the normal angle (rad) of the first point of a flank that can carry torque."""
    first = profile.segments()[0]
    return first.stop if first.land else first.start
