"""EE: epicycloid addendum, hypocycloid dedendum."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rootsopt.profiles import trigonometry as trig
from rootsopt.profiles.base import Profile, Segment


class EE(Profile):
    """The EE rotor: rolling radius r/2N, ψ = N |π/2N - β|, s = (r/N) sin(N(π/2N - β)).

    These are the paper's Eqs. 7 and 8 with two misprints corrected: sine and cosine of Eq. 7 are
    swapped, and the undefined τ of Eq. 8 is γ. Apart from the number of lobes, the pitch radius is
    the only parameter.
    """

    lobes: int = eqx.field(static=True)
    pitch_radius: Float[Array, ""]

    def __init__(self, lobes, pitch_radius):
        """Build the rotor with `lobes` N lobes and the scalar `pitch_radius` r (m)."""
        self.lobes = lobes
        self.pitch_radius = jnp.asarray(pitch_radius)

    def segments(self) -> tuple[Segment, ...]:
        zero = jnp.zeros_like(self.pitch_radius)
        stop = zero + (1 + self.lobes) * self.half_pitch
        return (Segment("epicycloid", zero, stop, False),)

    def roll_angle(self, nu):
        return nu / (1 + self.lobes)

    def normal_at(self, roll_angle):
        return roll_angle * (1 + self.lobes)

    def contact_distance(self, nu):
        beyond_pitch = self.lobes * (self.half_pitch - self.roll_angle(nu))
        return self.pitch_radius / self.lobes * trig.sin(beyond_pitch)

    @property
    def single_turn(self) -> float:
        return 5e-3

    @property
    def turn_ratio(self) -> float:
        return self.lobes / (1 + self.lobes)

    def lever_from(self, nu, cos, sin):
        # ψ = π/2 - κν.
        return self.pitch_radius * sin
