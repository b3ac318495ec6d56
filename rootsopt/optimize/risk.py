"""Combines the objectives in the scenes of a sample into one number, with its gradient.

The combinations are R = Σ w_k(J) J_k, where J_k is the objective in scene k of n, and the weights w
add up to 1:

- Mean plus c = `tolerances.k` standard deviations: R = m + c s, with m = Σ J_k / n and
  s² = Σ (J_k - m)² / n. Hence w_k = (1 + c (J_k - m) / s) / n.
- Quantile q: the estimator of Harrell and Davis, a weighted mean of all ordered values. The weight
  of the i-th smallest is B(i/n) - B((i-1)/n). B is the distribution function of the beta
  distribution with parameters (n + 1) q and (n + 1) (1 - q). This estimator varies less between
  samples than a single ordered value, and every scene contributes to its gradient. Source: Harrell
  and Davis, A new distribution-free quantile estimator, Biometrika 69 (1982) 635-640.
- Worst: the greatest value. Its weight is 1.

Each R is a homogeneous function of J of degree 1. Therefore dR/dJ_k = w_k (Euler's theorem),
wherever R is differentiable."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.config.tolerances import TolerancesConfig

_EQUAL = 1e-14
"""Standard deviation, relative to the mean, below which all values count as equal."""


class Combined(NamedTuple):
    """A combination R of n values.

    `value`: R; `weights` (n,): derivatives of R with respect to the values."""

    value: float
    weights: NDArray[np.float64]


def combine(tolerances: TolerancesConfig, values: ArrayLike) -> Combined:
    """Return the combination of `values` (n,) that `tolerances.combine` selects."""
    found = np.asarray(values, np.float64)
    if tolerances.combine == "worst":
        weights = np.zeros(len(found))
        weights[np.argmax(found)] = 1.0
    elif tolerances.combine == "quantile":
        weights = np.empty(len(found))
        weights[np.argsort(found, kind="stable")] = order_weights(len(found), tolerances.quantile)
    else:
        weights = _mean_and_deviation(found, tolerances.k)
    return Combined(float(weights @ found), weights)


def order_weights(count: int, quantile: float) -> NDArray[np.float64]:
    """Return the weights (count,) of Harrell and Davis for `count` values in ascending order.

    `quantile`: the quantile q that the weighted mean estimates."""
    from scipy.special import betainc  # Slow import (0.1 s).

    edges = np.arange(count + 1) / count
    cumulative = betainc((count + 1) * quantile, (count + 1) * (1 - quantile), edges)
    return np.diff(cumulative)


def _mean_and_deviation(values: NDArray[np.float64], k: float) -> NDArray[np.float64]:
    away = values - np.mean(values)
    deviation = float(np.sqrt(np.mean(away**2)))
    # For equal values, the standard deviation has a corner, and 0 is one of its subgradients.
    if deviation <= _EQUAL * abs(float(np.mean(values))):
        return np.full(len(values), 1 / len(values))
    return (1 + k * away / deviation) / len(values)


__all__ = ["Combined", "combine", "order_weights"]
