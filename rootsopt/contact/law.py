"""Contact laws: normal force as a function of penetration and its rate.

The law behind the paper's Table 2 (the solver's IMPACT function; the paper's linear
Eq. 10 cannot have exponent 2.2) is

    F = max(0, K δ^e + C · step(δ; 0, 0, d, 1) · dδ/dt),   step = 3 x² - 2 x³, x = δ/d.

`ImpactLaw` smooths it to be continuously differentiable. Two corners are rounded over the smoothing
length h. At the onset of contact, a ramp replaces δ; it is zero up to δ = 0 and exactly δ from
δ = h. At the release, the same ramp replaces max(0, ·); its width is the force h/d · K δ^e. Outside
these two zones the law is unchanged. The force is never adhesive, and is exactly zero without
penetration.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class ContactLaw(eqx.Module):
    """Normal force between two flanks (SI units).

    The force must be zero without penetration, never negative (adhesive), and continuous. Where one
    of its derivatives jumps, an entry of `switches` must change. All numbers of a law are arrays,
    and responses are differentiable with respect to them. `exponent`: exact or approximate exponent
    of the penetration in the static force.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> class Spring(rootsopt.ContactLaw):
    ...     stiffness: jax.Array
    ...     exponent: jax.Array
    ...
    ...     def __call__(self, depth, rate):
    ...         return self.stiffness * jax.numpy.maximum(depth, 0.0)
    ...
    ...     def depth_at(self, force):
    ...         return force / self.stiffness
    >>> spring = Spring(jax.numpy.asarray(1e8), jax.numpy.asarray(1.0))
    >>> print(f"{float(spring(2e-6, 0.0)):.0f} N")
    200 N
    """

    exponent: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def __call__(
        self, depth: Float[Array, "*n"], rate: Float[Array, "*#n"] | float
    ) -> Float[Array, "*n"]:
        """Return the normal force (N), ≥ 0, for penetration `depth` (m) growing at `rate` (m/s)."""

    @abc.abstractmethod
    def depth_at(self, force: Float[Array, ""]) -> Float[Array, ""]:
        """Return the static penetration (m) that carries `force` (N).

        The result must be differentiable with respect to the force and the law."""

    def switches(self, depth: Float[Array, ""], rate: Float[Array, ""]) -> Bool[Array, " s"]:
        """Return flags (s,) that identify the smooth piece of the law.

        `depth`: penetration (m); `rate`: its rate (m/s). By default, they are those of
        `margins`."""
        return self.margins(depth, rate) > 0

    def margins(self, depth: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, " s"]:
        """Return numbers (s,) that are positive where the flags of `switches` are set.

        `depth`, `rate`: as in `switches`. Each number passes smoothly through zero where its flag
        changes. By default, the only one is the penetration. Margins of a class that overrides only
        `switches` are not used (see `flanks.margins_of`)."""
        return jnp.stack([depth])

    def stiffness_at(self, depth: Float[Array, ""]) -> Float[Array, ""]:
        """Return the static stiffness (N/m) at a penetration `depth` (m) > 0."""
        still = jnp.zeros_like(depth)
        return jax.jvp(lambda x: self(x, still), (depth,), (jnp.ones_like(depth),))[1]

    def depth_absorbing(self, work: Float[Array, ""]) -> Float[Array, ""]:
        """Return the penetration (m) at which the static force has absorbed `work` (J).

        By default, assume a power law with the law's `exponent`. The solver uses this depth only to
        choose its steps."""
        e = self.exponent
        unit = self.depth_at(jnp.ones_like(work))
        return ((e + 1) * work * unit**e) ** (1 / (e + 1))


def ramp(x: Float[Array, "*n"], width: Float[Array, "*#n"]) -> Float[Array, "*n"]:
    """Return max(0, x), with its corner rounded to 2 x²/w - x³/w² on 0 < x < w = `width`.

    The function is C¹. `x` and `width` have the same unit."""
    safe = jnp.where(width > 0, width, 1.0)
    t = jnp.clip(x / safe, 0.0, 1.0)
    rounded = safe * t**2 * (2 - t)
    # At x = 0 use the rounded branch, so that the derivative there is 0, not 1/2.
    return jnp.where(x < width, rounded, jnp.maximum(x, 0.0))


def smooth_step(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the cubic step 3x² - 2x³, clamped to 0 … 1."""
    t = jnp.clip(x, 0.0, 1.0)
    return t**2 * (3 - 2 * t)


def balanced_ramp(x: Float[Array, "*n"], width: Float[Array, "*#n"]) -> Float[Array, "*n"]:
    """Return max(0, x) with its corner rounded on 0 < x < w = `width` and its integral unchanged.

    Beyond the rounded zone, a spring with this force stores the same energy as one with a sharp
    corner. `x` and `width` have the same unit. The function is C¹. In the rounded zone it is w (9
    t² - 12 t³ + 5 t⁴) / 2 with t = x/w: `ramp` plus the multiple of t² (1 - t)² that restores the
    integral.
    """
    safe = jnp.where(width > 0, width, 1.0)
    t = jnp.clip(x / safe, 0.0, 1.0)
    rounded = safe * t**2 * (9 - 12 * t + 5 * t**2) / 2
    return jnp.where(x < width, rounded, jnp.maximum(x, 0.0))


def balanced_step(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return a C¹ step from 0 to 1 on 0 < x < 1 that has the integral of a sharp step at 0.

    A motion crosses the zone 0 < x < 1. A damper with this onset takes the same momentum from it as
    one with a sharp onset. The step is never negative, but exceeds 1 inside the zone, by up to
    half. With `smooth_step`, the damping over half the zone would be missing."""
    t = jnp.clip(x, 0.0, 1.0)
    return t**2 * (18 - 32 * t + 15 * t**2)


def force_rounding(
    depth: Float[Array, ""], exponent: Float[Array, ""], radius: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the relative rounding error of the force at a penetration `depth` (m).

    `exponent`: exponent of the penetration in the law; `radius`: pitch radius (m). The penetration
    is a difference between lengths of about the pitch radius, and has their rounding error. Without
    contact, the result is 0.
    """
    deep = jnp.where(depth > 0, depth, jnp.inf)
    return exponent * float(jnp.finfo(depth.dtype).eps) * radius / deep


class ImpactLaw(ContactLaw):
    """IMPACT contact force between two flanks (SI units).

    `stiffness`: K (N/m^e); `exponent`: e ≥ 1; `damping`: C (N·s/m), reached at the penetration d;
    `full_damping_depth`: d (m); `smoothing`: h (m), 0 for the law without rounding.
    """

    stiffness: Float[Array, ""]
    exponent: Float[Array, ""]
    damping: Float[Array, ""]
    full_damping_depth: Float[Array, ""]
    smoothing: Float[Array, ""]

    def __call__(
        self, depth: Float[Array, "*n"], rate: Float[Array, "*#n"] | float
    ) -> Float[Array, "*n"]:
        """Return the normal force (N), ≥ 0, for penetration `depth` (m) growing at `rate` (m/s)."""
        positive, elastic, total, width = self._parts(depth, rate)
        large = elastic > float(jnp.finfo(elastic.dtype).tiny) ** 0.5
        releasing = positive & large & (total > 0) & (total < width * elastic)
        share = jnp.where(releasing, total, 1.0) / jnp.where(releasing, elastic, 1.0)
        rounded = elastic * ramp(share, width)
        return jnp.where(positive, jnp.where(releasing, rounded, jnp.maximum(total, 0.0)), 0.0)

    def margins(self, depth: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, "5"]:
        """Return numbers (5,) that identify the smooth piece of the law.

        `depth`: penetration (m); `rate`: its rate (m/s). In order, they are positive: in contact;
        beyond the rounding of the onset; fully damped; not released; beyond the rounding of the
        release."""
        positive, elastic, total, width = self._parts(depth, rate)
        depths = jnp.stack([jnp.zeros_like(depth), self.smoothing, self.full_damping_depth])
        # Relative to the elastic force, which vanishes with the depth.
        large = elastic > float(jnp.finfo(elastic.dtype).tiny) ** 0.5
        share = total / jnp.where(large, elastic, 1.0)
        released = jnp.where(positive, jnp.stack([share, share - width]), -1.0)
        return jnp.concatenate([depth - depths, released])

    def _parts(self, depth, rate):
        """Return (whether in contact, elastic force (N), total force (N) before release, width).

        `depth`: penetration (m); `rate`: its rate (m/s). The total force is the sum of elastic
        force and damping force. The width is the fraction of the elastic force over which the
        release is rounded. Only the release uses the quotient of the two forces. The release is not
        rounded where the square of the elastic force is out of range.
        """
        delta = ramp(depth, self.smoothing)
        safe = jnp.where(delta > 0, delta, self.full_damping_depth)
        # In K δ^e, either factor may be out of range.
        elastic = (self.stiffness ** (1 / self.exponent) * safe) ** self.exponent
        positive = delta > 0
        damping = self.damping * smooth_step(safe / self.full_damping_depth)
        width = jnp.minimum(self.smoothing / self.full_damping_depth, 1.0)
        return positive, elastic, elastic + damping * rate, width

    def depth_at(self, force: Float[Array, ""]) -> Float[Array, ""]:
        return (force / self.stiffness) ** (1 / self.exponent)

    def stiffness_at(self, depth: Float[Array, ""]) -> Float[Array, ""]:
        # Ignore the rounded onset, which an impact passes at once.
        return self.exponent * self.stiffness * depth ** (self.exponent - 1)

    def depth_absorbing(self, work: Float[Array, ""]) -> Float[Array, ""]:
        e = self.exponent
        return ((e + 1) * work / self.stiffness) ** (1 / (e + 1))
