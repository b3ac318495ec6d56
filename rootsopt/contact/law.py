"""Base class of all contact laws: normal force as a function of penetration and its rate."""

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

        `depth`: penetration (m); `rate`: its rate (m/s). By default, the only flag says whether
        there is penetration."""
        return jnp.stack([depth > 0])

    def margins(self, depth: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, " s"]:
        """Return numbers (s,) that are positive where the flags of `switches` are set.

        `depth`, `rate`: as in `switches`. Each number passes smoothly through zero where its flag
        changes. Margins of a class that overrides only `switches` are not used (see
        `flanks.margins_of`)."""
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
