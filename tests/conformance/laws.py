"""Checks that every contact law must pass (`rootsopt.contact.ContactLaw`)."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.conformance.kinks import along, unmarked


def check_law(law, depth, rate, sharp=0.0):
    """Check a law at penetrations about `depth` (m) and rates about `rate` (m/s).

    `sharp` (m): depth up to which the onset is rounded, where `depth_at` need not hold."""
    rng = np.random.default_rng(5)
    force = jax.jit(jax.vmap(law))
    depths = depth * rng.uniform(-2, 2, 400)
    rates = rate * rng.normal(0, 1, 400)
    found = np.asarray(force(depths, rates))
    assert np.all(found[depths <= 0] == 0), "force without penetration"
    assert np.all(found >= 0), "adhesive force"
    assert np.any(found > 0)
    slopes = jax.jit(jax.vmap(jax.grad(lambda d, v: law(d, v), (0, 1))))(
        jnp.append(jnp.asarray(depths), 0.0), jnp.append(jnp.asarray(rates), rate)
    )
    assert all(np.all(np.isfinite(slope)) for slope in slopes), "slopes at or beside the onset"
    still = np.asarray(force(depth * np.linspace(-1, 3, 500), np.zeros(500)))
    assert np.all(np.diff(still) >= 0), "force at rest falls with depth"
    _check_inverse(law, depth, sharp)
    _check_kinks(law, depth, rate)


def _check_inverse(law, depth, sharp):
    """Check that `depth_at`, `stiffness_at` and `depth_absorbing` agree with the law at rest."""
    deep = sharp + depth * np.array([0.1, 0.5, 1.0, 3.0])
    loads = jax.vmap(law)(deep, jnp.zeros(4))
    np.testing.assert_allclose(jax.vmap(law.depth_at)(loads), deep, rtol=1e-9)
    stiffness = jax.vmap(law.stiffness_at)(jnp.asarray(deep))
    np.testing.assert_allclose(jax.vmap(jax.grad(law.depth_at))(loads) * stiffness, 1.0, rtol=1e-9)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    inside = depth * (nodes + 1) / 2
    work = np.sum(weights * depth / 2 * np.asarray(jax.vmap(law)(inside, jnp.zeros(60))))
    reached = float(law.depth_absorbing(jnp.asarray(work)))
    assert abs(reached / depth - 1) < 0.1, "far from the depth that takes up this work"


def _check_kinks(law, depth, rate):
    lines = [((0.8 * depth, -4 * rate), (0.9 * depth, 3 * rate))]
    for speed in rate * np.array([-3.0, -1.0, 0.0, 1.0]):
        lines.append(((-0.3 * depth, speed), (1.7 * depth, 1.3 * speed)))
    found = along(lambda at: (law(*at)[None], law.switches(*at)), lines)
    for line, (values, slopes, flags) in zip(lines, found, strict=True):
        missed = unmarked(values, slopes, flags)
        assert missed.size == 0, f"kinks that no switch marks, on {line}: {missed}"
        assert np.any(flags[1:] != flags[:-1]), "a line through onset or release without a switch"
