"""The IMPACT contact law, smoothed to be continuously differentiable.

The law behind the paper's Table 2 (the solver's IMPACT function; the paper's linear
Eq. 10 cannot have exponent 2.2) is

    F = max(0, K δ^e + C · step(δ; 0, 0, d, 1) · dδ/dt),   step = 3 x² - 2 x³, x = δ/d.

Two corners are rounded over the smoothing length h: the onset of contact, where δ is
replaced by a ramp that is zero up to δ = 0 and exactly δ from δ = h, and the release,
where max(0, ·) becomes the same ramp over the force h/d · K δ^e. The law is untouched
outside these two zones, never adhesive, and exactly zero without penetration.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rootsopt.contact.law import ContactLaw


def ramp(x: Float[Array, "*n"], width: Float[Array, "*#n"]) -> Float[Array, "*n"]:
    """max(0, x) with its corner rounded on 0 < x < width: 2 x²/w - x³/w², C¹ throughout."""
    safe = jnp.where(width > 0, width, 1.0)
    t = jnp.clip(x / safe, 0.0, 1.0)
    rounded = safe * t**2 * (2 - t)
    # At x = 0 the rounded branch decides, so that the derivative there is 0, not 1/2.
    return jnp.where(x < width, rounded, jnp.maximum(x, 0.0))


def smooth_step(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The cubic step 3x² - 2x³, clamped to 0 … 1."""
    t = jnp.clip(x, 0.0, 1.0)
    return t**2 * (3 - 2 * t)


def balanced_ramp(x: Float[Array, "*n"], width: Float[Array, "*#n"]) -> Float[Array, "*n"]:
    """max(0, x) with its corner rounded on 0 < x < width, C¹, and with the same integral.

    A spring rounded so stores the same energy beyond the zone as the sharp one. It is `ramp` plus
    the multiple of t² (1 - t)² that makes up for what `ramp` lacks: w (9 t² - 12 t³ + 5 t⁴) / 2.
    """
    safe = jnp.where(width > 0, width, 1.0)
    t = jnp.clip(x / safe, 0.0, 1.0)
    rounded = safe * t**2 * (9 - 12 * t + 5 * t**2) / 2
    return jnp.where(x < width, rounded, jnp.maximum(x, 0.0))


def balanced_step(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Step from 0 to 1 on 0 < x < 1, C¹, with the integral of a sharp step at 0.

    A damper that sets in so takes the same momentum out of a motion that crosses the zone as one
    that sets in at once. For that it exceeds 1 inside, by up to half; it is never negative.
    `smooth_step` in its place takes half a width of damping away on every crossing.
    """
    t = jnp.clip(x, 0.0, 1.0)
    return t**2 * (18 - 32 * t + 15 * t**2)


def force_rounding(
    depth: Float[Array, ""], exponent: Float[Array, ""], radius: Float[Array, ""]
) -> Float[Array, ""]:
    """Relative error by rounding alone of the force at a `depth` (m); 0 without contact.

    The gap is the difference of lengths of the size of the pitch `radius` (m), so it is known to
    a rounding of that, and the force is a power of it with the law's `exponent`.
    """
    deep = jnp.where(depth > 0, depth, jnp.inf)
    return exponent * float(jnp.finfo(depth.dtype).eps) * radius / deep


class ImpactLaw(ContactLaw):
    """IMPACT contact force between two flanks (SI units).

    `stiffness` K (N/m^e), `exponent` e ≥ 1, `damping` C (N·s/m) reached at the depth
    `full_damping_depth` d (m), `smoothing` h (m, 0 for the law as it stands).
    """

    stiffness: Float[Array, ""]
    exponent: Float[Array, ""]
    damping: Float[Array, ""]
    full_damping_depth: Float[Array, ""]
    smoothing: Float[Array, ""]

    def __call__(
        self, depth: Float[Array, "*n"], rate: Float[Array, "*#n"] | float
    ) -> Float[Array, "*n"]:
        """Normal force (N), ≥ 0, for penetration `depth` (m) growing at `rate` (m/s)."""
        positive, elastic, total, width = self._parts(depth, rate)
        large = elastic > float(jnp.finfo(elastic.dtype).tiny) ** 0.5
        releasing = positive & large & (total > 0) & (total < width * elastic)
        share = jnp.where(releasing, total, 1.0) / jnp.where(releasing, elastic, 1.0)
        rounded = elastic * ramp(share, width)
        return jnp.where(positive, jnp.where(releasing, rounded, jnp.maximum(total, 0.0)), 0.0)

    def switches(self, depth: Float[Array, ""], rate: Float[Array, ""]) -> Bool[Array, "5"]:
        """On which of its smooth pieces the law is: in contact, beyond the rounding of the
        onset, fully damped, not released, beyond the rounding of the release."""
        positive, elastic, total, width = self._parts(depth, rate)
        depths = jnp.stack([jnp.zeros_like(depth), self.smoothing, self.full_damping_depth])
        limits = jnp.stack([jnp.zeros_like(elastic), width * elastic])
        return jnp.concatenate([depth > depths, positive & (total > limits)])

    def _parts(self, depth, rate):
        """Whether there is contact, the elastic force, that with the damping force before its
        release, and over which share of the elastic force it is rounded there.

        The damping force is added to the elastic one, and divided by it only where it is no
        greater: near the onset both are so small that the derivative of their quotient would
        overflow in single precision. (An elastic force whose square is out of range is not
        rounded at its release.)
        """
        delta = ramp(depth, self.smoothing)
        safe = jnp.where(delta > 0, delta, self.full_damping_depth)
        # Not K δ^e, of which either factor may be out of range.
        elastic = (self.stiffness ** (1 / self.exponent) * safe) ** self.exponent
        positive = delta > 0
        damping = self.damping * smooth_step(safe / self.full_damping_depth)
        width = jnp.minimum(self.smoothing / self.full_damping_depth, 1.0)
        return positive, elastic, elastic + damping * rate, width

    def depth_at(self, force: Float[Array, ""]) -> Float[Array, ""]:
        return (force / self.stiffness) ** (1 / self.exponent)

    def stiffness_at(self, depth: Float[Array, ""]) -> Float[Array, ""]:
        # Not that of the rounded onset, which an impact leaves at once.
        return self.exponent * self.stiffness * depth ** (self.exponent - 1)

    def depth_absorbing(self, work: Float[Array, ""]) -> Float[Array, ""]:
        e = self.exponent
        return ((e + 1) * work / self.stiffness) ** (1 / (e + 1))
