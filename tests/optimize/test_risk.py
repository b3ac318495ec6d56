"""Tests of combined objectives of many scenes, against SciPy and differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats.mstats import hdquantiles

from rootsopt.config.tolerances import TolerancesConfig
from rootsopt.response.reducers import combine


def rule(**settings) -> TolerancesConfig:
    over = {"contact.clearance_mm": {"normal": 0.002}}
    return TolerancesConfig.model_validate({"over": over, **settings})


VALUES = np.array([1.02, 0.71, 0.93, 1.41, 0.88, 1.07, 0.79])
RULES = {
    "mean + 2 sigma": (rule(), np.mean(VALUES) + 2 * np.std(VALUES)),
    "mean + 0.5 sigma": (rule(k=0.5), np.mean(VALUES) + 0.5 * np.std(VALUES)),
    "quantile": (rule(combine="quantile"), hdquantiles(VALUES, 0.95)[0]),
    "median": (rule(combine="quantile", quantile=0.5), hdquantiles(VALUES, 0.5)[0]),
    "worst": (rule(combine="worst"), 1.41),
}
"""Rules, and what NumPy and SciPy find by them."""


@pytest.mark.parametrize("name", RULES)
def test_weights_are_the_gradient(name):
    """The weights agree with central differences.

    The error of these is the third derivative times step²/6, about 1e-10, plus rounding 1e-16 /
    step."""
    one, expected = RULES[name]
    found = combine(one, VALUES)
    step = 1e-5
    assert found.value == pytest.approx(expected, rel=1e-12)
    for weight, moved in zip(found.weights, step * np.eye(len(VALUES)), strict=True):
        upper, lower = (combine(one, VALUES + sign * moved).value for sign in (1, -1))
        assert weight == pytest.approx((upper - lower) / (2 * step), abs=1e-8)


@given(st.lists(st.floats(0.1, 10), min_size=2, max_size=40))
def test_worst_quantile_median_in_order(values):
    worst, high, middle = (combine(RULES[k][0], values) for k in ("worst", "quantile", "median"))
    slack = 1e-12 * max(values)
    assert worst.value + slack >= high.value >= middle.value - slack
    for one, _ in RULES.values():
        assert np.sum(combine(one, values).weights) == pytest.approx(1, abs=1e-12)
        assert combine(one, [values[0]] * 5).value == pytest.approx(values[0], rel=1e-13)
