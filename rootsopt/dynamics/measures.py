"""Averages of the contact force over a motion, integrated along with it.

Mean and mean square always; Fourier coefficients of spectral lines and a power of the force,
from which its p-norm follows, where a scene asks for them.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def _no_orders() -> Float[np.ndarray, "0"]:
    return np.zeros(0)


class Measures(eqx.Module):
    """What is averaged beside mean and mean square.

    `orders`: spectral lines, in multiples of the mesh frequency; they are lines of a motion of
    k mesh periods where k times the order is whole. `norm`: p of the p-norm
    (mean of F^p)^(1/p) ≤ max F, a smooth stand-in for the peak, or None.
    """

    orders: Float[Array, " lines"] | Float[np.ndarray, " lines"] = eqx.field(
        default_factory=_no_orders
    )
    norm: Float[Array, ""] | None = None

    @property
    def count(self) -> int:
        """How many averages there are: q = 2 + two for every line, and one for the p-norm."""
        return 2 + 2 * self.orders.shape[0] + (self.norm is not None)

    def rates(
        self, tau: Float[Array, ""], force: Float[Array, ""], top: Float[Array, ""]
    ) -> Float[Array, " q"]:
        """What to integrate at time `tau` (mesh periods) with the `force` in any unit; `top`:
        about the greatest, in the same unit, so that no power is out of range."""
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
        """Mean (N), mean square (N²), cosine and sine coefficients (N), p-norm (N) from the
        averages of `rates`, and the factors by which derivatives of these become theirs. `unit`
        (N) is that of the forces."""
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
        """Amplitudes (N) of the lines of a closed orbit of `period` mesh periods and their
        derivatives, from the values and derivatives behind mean, mean square and peak. An order
        that is no line of the motion has amplitude 0."""
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
        """Response of a closed orbit by the names of the result file.

        `response`: (mean, mean square, peak, then the other `values`) with derivatives behind, a
        row each, (r, 1 + d); `period` k in mesh periods. Each name has its value (N) and its
        derivatives (d,). An order that is no line of the motion has amplitude 0.
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
"""The p-norm in result files."""


def line_name(order: float) -> str:
    """Name of a spectral line's amplitude in result files."""
    return f"line_{order:g}_force_N"
