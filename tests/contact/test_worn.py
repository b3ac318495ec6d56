"""Wear, normal offset and heat as changes of the clearance, and scenes that an optimum holds in."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import Config, InputError, Scene, load_config
from rootsopt.contact.wrapped import WornContact, series_at, wear_series, wear_shape
from rootsopt.profiles import EE
from rootsopt.response.scatter import draw, shifts
from tests.conformance.families import LOBES, R, made

BASE = ("contact.clearance_mm=0.05", "contact.wear={}", "scene.heat={}")

shape = jax.jit(wear_shape)


def scene_of(*changes: str) -> tuple[Config, Scene]:
    config = load_config("cic_drawn", [*BASE, *changes])
    return config, Scene.from_config(config)


@pytest.mark.parametrize("lobes", [2, 3, 5])
def test_ee_wears_evenly(lobes):
    """s, dl1/dβ and dl2/dβ of EE are proportional to sin ψ: 8N / (4N² - 1) everywhere."""
    roll = jnp.linspace(0.02, 0.98, 20) * np.pi / (2 * lobes)
    np.testing.assert_allclose(shape(EE(lobes, R), roll), 8 * lobes / (4 * lobes**2 - 1), rtol=1e-9)


def test_shape_from_the_ways_of_the_contact():
    """Arc lengths of both flanks between neighbouring contacts, from points."""
    profile = made("cic")
    roll = np.linspace(0.3, 0.7, 400) * np.pi / (2 * LOBES)
    nu = profile.normal_at(jnp.asarray(roll))
    expected = 0.0
    for curve in (profile.addendum, profile.dedendum):
        beta, psi, s = map(np.asarray, eqx.filter_jit(curve)(nu))
        points = np.exp(1j * beta) * (R + s * 1j * np.exp(-1j * psi))
        expected += np.abs(s[1:] + s[:-1]) * np.diff(roll) / np.abs(np.diff(points))
    found = np.asarray(shape(profile, jnp.asarray((roll[1:] + roll[:-1]) / 2)))
    np.testing.assert_allclose(found, expected, rtol=1e-3)


@pytest.mark.parametrize("family", ["cic", "ee", "arc_involute"])
def test_series_has_the_depth_and_no_ripples(family):
    profile, depth = made(family), jnp.asarray(2e-5)
    roll = np.linspace(0, np.pi / LOBES, 512)
    series = jax.jit(wear_series)(profile, depth)
    at = jax.jit(jax.vmap(lambda x: series_at(series, jnp.asarray(float(LOBES)), x)))
    values, rates = map(np.asarray, at(roll))
    assert np.max(values) == pytest.approx(2e-5, rel=1e-3)
    assert np.min(values) >= 0
    np.testing.assert_allclose(values, values[::-1], atol=1e-12)
    np.testing.assert_allclose(np.gradient(values, roll)[1:-1], rates[1:-1], atol=1e-6)


def test_worn_gap_has_a_potential():
    """Gap and levers: d gap = -lever1 dφ1 + lever2 dφ2, and the gap grows by the wear."""
    config, scene = scene_of("contact.wear.depth_mm=0.03")
    worn = eqx.filter_jit(lambda design: scene.contact(scene.profile(design)))(config.design)
    assert isinstance(worn, WornContact)

    @eqx.filter_jit
    def seen(worn, first, second):
        def found(contact, first, second):
            return contact(-(first + second) / 2, second - first)

        slopes = jax.grad(lambda *at: found(worn, *at)[0], (0, 1))(first, second)
        (gap, *levers), (section, *_) = (found(x, first, second) for x in (worn, worn.section))
        wear = series_at(worn.coefficients, worn.lobes, -(first + second) / 2)[0]
        return slopes, levers, gap - section, wear

    (by_first, by_second), levers, grown, wear = seen(worn, jnp.asarray(-0.3), jnp.asarray(-0.3004))
    np.testing.assert_allclose([-by_first, by_second], levers, rtol=1e-9)
    assert float(grown) == pytest.approx(float(wear), rel=1e-9)
    assert 0 < grown <= 3e-5


def test_offset_and_heat_are_clearances():
    _, new = scene_of()
    _, other = scene_of(
        "contact.wear.offset_mm=0.01",
        "scene.center_distance_error_mm=0.02",
        "scene.heat.rotor_warming_K=50",
        "scene.heat.housing_warming_K=20",
        "scene.heat.housing_expansion_per_K=2.2e-5",
    )
    assert float(other.clearance - new.clearance) == pytest.approx(2e-5)
    strain = 2.2e-5 * 20 - 1.1e-5 * 50
    assert float(new.center_distance_error) == 0
    assert float(other.center_distance_error) == pytest.approx(2e-5 + 0.066 * strain)
    plain = Scene.from_config(load_config("cic_drawn"))
    assert plain.wear is None
    assert plain.center_distance_error is None
    assert not isinstance(eqx.filter_eval_shape(plain.contact, made("cic")), WornContact)


CONDITIONS = (
    "tolerances={conditions: {new: {}, hot: {scene.heat.rotor_warming_K: 60}, "
    "worn: {contact.wear: {depth_mm: 0.02, offset_mm: 0.002}}}, combine: worst}"
)


def test_conditions_are_scenes():
    config, _ = scene_of(CONDITIONS)
    assert config.tolerances.samples == 3
    keys = [one.key for one in config.scatters]
    rows = [dict(zip(keys, row, strict=True)) for row in draw(config, 3)]
    new = dict.fromkeys(keys, 0.0)
    assert rows[:2] == [new, new | {"scene.heat.rotor_warming_K": 60.0}]
    assert rows[2]["contact.wear.depth_mm"] == 0.02
    moved = [one.scene for one in shifts(config, draw(config, 3))]
    assert float(moved[1].center_distance_error) == pytest.approx(-0.066 * 1.1e-5 * 60)
    assert float(moved[2].clearance) == pytest.approx(4e-6)
    assert float(moved[2].wear) == pytest.approx(2e-5)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("{conditions: {new: {}}}", "must name two or more scenes"),
        (
            "{conditions: {a: {}, b: {}}, over: {contact.clearance_mm: {normal: 0.001}}}",
            "holds both",
        ),
        ("{conditions: {a: {}, b: {contact.wear.dept_mm: 1}}}", "depth_mm"),
        ("{conditions: {a: {}, b: {contact.wear.depth_mm: 5}}}", "the scene `b`"),
    ],
)
def test_conditions_that_are_refused(given, words):
    with pytest.raises(InputError, match=words):
        scene_of(f"tolerances={given}")
