"""Checks that every contact law must pass (`rootsopt.contact.ContactLaw`)."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.conformance.kinks import along, unmarked


def check_law(law, depth, rate, sharp=0.0):
    """Check a law at penetrations about `depth` (m) and rates about `rate` (m/s).

    `sharp` (m): depth up to which the onset is rounded, where `depth_at` need not hold."""
    rng = np.random.default_rng(5)
    # At random, at the onset, and at rest.
    depths = depth * np.concatenate([rng.uniform(-2, 2, 400), [0.0], np.linspace(-1, 3, 500)])
    rates = rate * np.concatenate([rng.normal(0, 1, 400), [1.0], np.zeros(500)])
    found, slopes = _forces(law, depths, rates)
    assert np.all(found[depths <= 0] == 0), "force without penetration"
    assert np.all(found >= 0), "adhesive force"
    assert np.any(found > 0)
    assert np.all(np.isfinite(slopes)), "slopes at or beside the onset"
    assert np.all(np.diff(found[401:]) >= 0), "force at rest falls with depth"
    _check_inverse(law, depth, sharp)
    _check_kinks(law, depth, rate)


@jax.jit
def _forces(law, depths, rates):
    return jax.vmap(jax.value_and_grad(lambda d, v: law(d, v), (0, 1)))(depths, rates)


def _check_inverse(law, depth, sharp):
    """Check that `depth_at`, `stiffness_at` and `depth_absorbing` agree with the law at rest."""
    deep = sharp + depth * np.array([0.1, 0.5, 1.0, 3.0])
    nodes, weights = np.polynomial.legendre.leggauss(60)
    found, product, reached = _inverse(law, deep, depth * (nodes + 1) / 2, weights * depth / 2)
    np.testing.assert_allclose(found, deep, rtol=1e-9)
    np.testing.assert_allclose(product, 1.0, rtol=1e-9)
    assert abs(reached / depth - 1) < 0.1, "far from the depth that takes up this work"


@jax.jit
def _inverse(law, deep, inside, weights):
    """Return the depths (m) of the loads at `deep`, stiffness times its inverse there, and the
    depth (m) that absorbs the integral over `inside`."""
    loads, forces = (jax.vmap(law)(x, jnp.zeros_like(x)) for x in (deep, inside))
    found, slope = jax.vmap(jax.value_and_grad(law.depth_at))(loads)
    stiffness = jax.vmap(law.stiffness_at)(deep)
    return found, slope * stiffness, law.depth_absorbing(jnp.sum(weights * forces))


def _check_kinks(law, depth, rate):
    lines = [((0.8 * depth, -4 * rate), (0.9 * depth, 3 * rate))]
    for speed in rate * np.array([-3.0, -1.0, 0.0, 1.0]):
        lines.append(((-0.3 * depth, speed), (1.7 * depth, 1.3 * speed)))
    found = along(_piece, lines, law)
    for line, (values, slopes, flags) in zip(lines, found, strict=True):
        missed = unmarked(values, slopes, flags)
        assert missed.size == 0, f"kinks that no switch marks, on {line}: {missed}"
        assert np.any(flags[1:] != flags[:-1]), "a line through onset or release without a switch"


def _piece(at, law):
    return law(*at)[None], law.switches(*at)
