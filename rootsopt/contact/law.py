"""What every contact law is to a rotor pair: normal force over penetration and its rate."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class ContactLaw(eqx.Module):
    """Normal force between two flanks (SI units).

    The force is zero without penetration and never adhesive. It is continuous; where a derivative
    of it jumps, an entry of `switches` must change. All numbers of a law are arrays, and a
    response is differentiable with respect to them. `exponent`: the power of the penetration by
    which the force at rest grows, or about that.
    """

    exponent: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def __call__(
        self, depth: Float[Array, "*n"], rate: Float[Array, "*#n"] | float
    ) -> Float[Array, "*n"]:
        """Normal force (N), ≥ 0, for penetration `depth` (m) growing at `rate` (m/s)."""

    @abc.abstractmethod
    def depth_at(self, force: Float[Array, ""]) -> Float[Array, ""]:
        """Static penetration (m) that carries `force` (N), differentiable."""

    def switches(self, depth: Float[Array, ""], rate: Float[Array, ""]) -> Bool[Array, " s"]:
        """On which of its smooth pieces the law is; here, whether there is contact."""
        del rate
        return jnp.stack([depth > 0])

    def stiffness_at(self, depth: Float[Array, ""]) -> Float[Array, ""]:
        """Stiffness (N/m) at rest, at a penetration `depth` (m) > 0."""
        still = jnp.zeros_like(depth)
        return jax.jvp(lambda x: self(x, still), (depth,), (jnp.ones_like(depth),))[1]

    def depth_absorbing(self, work: Float[Array, ""]) -> Float[Array, ""]:
        """Penetration (m) at which the law at rest has taken up `work` (J), as a power law with
        this `exponent` would. The solver's steps follow from it, no result does."""
        e = self.exponent
        unit = self.depth_at(jnp.ones_like(work))
        return ((e + 1) * work * unit**e) ** (1 / (e + 1))
