"""Averages of the contact force over a motion, integrated along with the motion.

Mean and mean square are always computed. Two kinds of average are computed on request: the Fourier
coefficients of spectral lines, and the average of a power of the force, which gives its p-norm.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def _no_orders() -> Float[np.ndarray, "0"]:
    return np.zeros(0)


class Measures(eqx.Module):
    """The averages of the force to compute in addition to mean and mean square.

    `orders` (lines,): spectral lines, in multiples of the mesh frequency. A motion of k mesh
    periods contains a line if k times its order is a whole number. `norm`: exponent p of the p-norm
    (mean of F^p)^(1/p) ≤ max F, a smooth substitute for the peak; None: no p-norm.
    """

    orders: Float[Array, " lines"] | Float[np.ndarray, " lines"] = eqx.field(
        default_factory=_no_orders
    )
    norm: Float[Array, ""] | None = None

    @property
    def count(self) -> int:
        """Number q of averages: 2, plus 2 for each line, plus 1 for the p-norm."""
        return 2 + 2 * self.orders.shape[0] + (self.norm is not None)

    def rates(
        self, tau: Float[Array, ""], force: Float[Array, ""], top: Float[Array, ""]
    ) -> Float[Array, " q"]:
        """Return the integrands of the averages at time `tau` (mesh periods).

        `force`: the contact force, in any unit; `top`: roughly its greatest value, in the same
        unit. Powers of the force are scaled by `top`, so that they do not overflow."""
        rates = [jnp.stack([force, force**2])]
        if self.orders.shape[0]:
            angle = 2 * jnp.pi * jnp.asarray(self.orders, force.dtype) * tau
            rates += [force * jnp.cos(angle), force * jnp.sin(angle)]
        if self.norm is not None:
            pushes = force > 0
            power = jnp.where(pushes, force / top, 1.0) ** self.norm.astype(force.dtype)
            rates.append(jnp.where(pushes, power, 0.0)[None])
        return jnp.concatenate(rates)

    def values(
        self, averages: Float[Array, " q"], unit: Float[Array, ""], top: Float[Array, ""]
    ) -> tuple[Float[Array, " q"], Float[Array, " q"]]:
        """Return the measures from the averages of `rates`, and factors for their derivatives.

        The measures are the mean (N), the mean square (N²), the means of force times cosine and
        force times sine (N), and the p-norm (N). Derivatives of the averages times these factors
        are derivatives of the measures. `unit` (N): unit of the force in `rates`; `top`: as in
        `rates`."""
        factors = jnp.full_like(averages, unit).at[1].set(unit**2)
        values = factors * averages
        if self.norm is not None:
            power = jnp.maximum(averages[-1], jnp.finfo(averages.dtype).tiny)
            size = unit * top * power ** (1 / self.norm.astype(averages.dtype))
            values = values.at[-1].set(size)
            factors = factors.at[-1].set(size / (self.norm.astype(averages.dtype) * power))
        return values, factors

    def amplitudes(
        self, others: Any, slopes: Any, period: Any
    ) -> tuple[Float[Array, " lines"], list[Float[Array, " d"]]]:
        """Return the amplitudes (N) of the spectral lines of a closed orbit, and their derivatives.

        `others` (q - 2,) and `slopes` (q - 2, d): the measures that follow the mean square in
        `values`, and their derivatives; `period`: period of the orbit (mesh periods). A line that
        the motion does not contain has amplitude 0."""
        sizes, rows = [], []
        for k, order in enumerate(self.orders):
            cos, sin = others[k], others[k + self.orders.shape[0]]
            size = jnp.hypot(cos, sin)
            present = jnp.abs(order * period - jnp.round(order * period)) < 1e-6
            slope = cos * slopes[k] + sin * slopes[k + self.orders.shape[0]]
            sizes.append(jnp.where(present, 2 * size, 0.0))
            rows.append(jnp.where(present, 2 * slope / jnp.maximum(size, 1e-150), 0.0))
        return jnp.stack(sizes) if sizes else jnp.zeros(0), rows

    def named(self, response: Any, period: int) -> dict[str, tuple[float, Any]]:
        """Return the response of a closed orbit as a dict whose keys are names in the result file.

        `response` (r, 1 + d): one row each for mean, mean square and peak, then for the measures
        that follow the mean square in `values`. Column 0 holds the value, the other d columns its
        derivatives. `period`: period of the orbit (mesh periods). Each name maps to a pair: the
        value (N) and its derivatives (d,). A requested spectral line that the motion does not
        contain has amplitude 0.
        """
        rows = np.asarray(response, np.float64)
        mean, square, peak, *others = rows
        rms = np.sqrt(max(square[0], 0.0))
        found = {
            "mean_force_N": (float(mean[0]), mean[1:]),
            "peak_force_N": (float(peak[0]), peak[1:]),
            "rms_force_N": (float(rms), square[1:] / (2 * max(rms, 1e-150))),
        }
        lines = self.orders.shape[0]
        for order, cos, sin in zip(np.asarray(self.orders), others, others[lines:], strict=False):
            size = np.hypot(cos[0], sin[0])
            present = abs(order * period - round(order * period)) < 1e-6
            slope = 2 * (cos[0] * cos[1:] + sin[0] * sin[1:]) / max(size, 1e-150)
            found[line_name(order)] = (
                (float(2 * size), slope) if present else (0.0, np.zeros_like(slope))
            )
        if self.norm is not None:
            norm = others[-1]
            found[PEAK_NORM] = (float(norm[0]), norm[1:])
        return found


PEAK_NORM = "peak_norm_force_N"
"""Name of the p-norm in result files."""


def line_name(order: float) -> str:
    """Return the name of a spectral line's amplitude in result files."""
    return f"line_{order:g}_force_N"
