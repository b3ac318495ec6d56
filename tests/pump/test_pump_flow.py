"""Flow against polygons of the chambers, closed forms and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from rootsopt import load_config
from rootsopt.config.families import families
from rootsopt.profiles import EE, geometry, place_pair
from rootsopt.pump import flow
from rootsopt.pump.sheet import sheet
from rootsopt.scene import Scene, design_vector
from rootsopt.scene.families import margins_of
from tests.conformance.families import LOBES, R, config_of, made, outline_of

ROLLING = [
    pytest.param(name, marks=[pytest.mark.long] * (name not in ("cic", "ee", "free_form")))
    for name, row in families().items()
    if row.example is not None and row.maker is not None
]


@jax.jit
def describe(profile):
    shape = geometry(profile)
    lines = flow.flow_lines(profile, shape, 6)
    return shape, flow.ripple(profile, shape), lines, flow.tip_height_share(profile, shape)


over = jax.jit(flow.relative_flow)


def shoelace(points):
    z = points @ [1, 1j]
    return float(np.sum((np.conj(z) * np.roll(z, -1)).imag)) / 2


def arc(radius, start, stop):
    turn = np.linspace(start, stop, 20001)
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def suction(outline, lobes, phi):
    """Area of the upper chamber, up to a constant.

    From the contact along rotor 1 to the tip that seals it at the housing, back along the housing
    to fixed points above both axes, and likewise along rotor 2."""
    first, second = place_pair(outline, lobes, 2 * R, phi, phi)
    outer = np.max(np.hypot(*outline.T))
    sides = []
    distance, partner = KDTree(second[:-1]).query(first[:-1])
    near = int(np.argmin(distance))
    for points, begin, axis, sign, turned in (
        (first[:-1], near, 0.0, 1, 2),
        # Rotor 2 seen in a mirror: it is passed through the other way.
        (second[:-1][::-1], len(second) - 2 - int(partner[near]), 2 * R, -1, 3),
    ):
        centred = np.roll((points - [axis, 0.0]) * [sign, 1.0], -begin, axis=0)
        angle = np.unwrap(np.arctan2(*centred.T[::-1]))
        tips = np.flatnonzero(np.hypot(*centred.T) > outer - 1e-12)
        # The tip that seals this side of the chamber lies so many half pitches ahead of φ1.
        tip = tips[np.argmin(abs(angle[tips] - phi - turned * np.pi / lobes))]
        side = np.concatenate([centred[: tip + 1], arc(outer, angle[tip], np.pi / 2)])
        sides.append(side * [sign, 1.0] + [axis, 0.0])
    return -shoelace(np.concatenate([sides[0], sides[1][::-1]]))


@pytest.mark.parametrize("lobes", [2, 3, 4])
def test_ee_has_one_line(lobes):
    _, ripple, lines, _ = describe(EE(lobes, R))
    assert float(ripple) == pytest.approx(2 / (4 * lobes + 1), rel=1e-13)
    assert 2 * abs(float(lines[0])) == pytest.approx(2 / (4 * lobes + 1), rel=1e-12)
    np.testing.assert_allclose(lines[1:4], 0.0, atol=1e-10)


def test_ripple_of_the_paper():
    config = load_config("configs/cic_drawn.yaml")
    _, ripple, _, share = describe(Scene.from_config(config).profile(design_vector(config)))
    assert 100 * float(ripple) == pytest.approx(16.6, abs=0.05)
    assert 0.7 < float(share) < 0.72


@pytest.mark.parametrize("family", ROLLING)
def test_ripple_and_mean_of_every_family(family):
    """Greatest minus least flow of many samples; the mean of the samples is 1; the lines are those
    of a discrete Fourier transform of them."""
    profile = made(family)
    shape, ripple, lines, share = describe(profile)
    if min(margins_of(config_of(family)).get("rolling", 0.0), 0.0) < -1e-6:
        return
    phi = (np.arange(4096) + 0.5) * np.pi / LOBES / 4096
    found = np.asarray(over(profile, shape, jnp.asarray(phi)))
    ends = np.asarray(over(profile, shape, jnp.asarray([0.0, np.pi / LOBES / 2])))
    assert ends[1] - ends[0] == pytest.approx(float(ripple), rel=1e-9)
    assert np.max(found) - np.min(found) <= float(ripple) * (1 + 1e-9)
    assert np.mean(found) == pytest.approx(1.0, abs=2e-5)
    sampled = [2 * np.mean(found * np.cos(2 * LOBES * k * phi)) for k in range(1, 7)]
    np.testing.assert_allclose(lines, sampled, atol=1e-4)
    assert 0 < float(share) < 1


@pytest.mark.parametrize("family", ["ee", "cic"])
def test_flow_is_the_growth_of_the_chamber(family):
    """Growth of the suction chamber's polygon against the flow over the mesh, and the pockets
    against the volume per revolution."""
    profile, outline = made(family), outline_of(family) / 1e3
    shape, *_ = describe(profile)
    ends = np.linspace(0.03, 0.03 + np.pi / LOBES, 4)
    grown = np.diff([suction(outline, LOBES, phi) for phi in ends])
    nodes, weights = np.polynomial.legendre.leggauss(60)
    half = np.pi / LOBES / 6
    phi = (ends[:-1, None] + half + half * nodes).ravel()
    swept = np.asarray(over(profile, shape, jnp.asarray(phi))).reshape(3, 60) @ weights * half
    outer = float(shape.outer_radius)
    assert grown == pytest.approx(float(shape.area_efficiency) * outer**2 * swept, rel=1e-6)
    lobe = outline[: (len(outline) - 1) // LOBES + 1]
    pocket = shoelace(np.concatenate([arc(outer, 0, 2 * np.pi / LOBES), lobe[::-1]]))
    volume = flow.displaced_volume(shape, jnp.asarray(0.1))
    assert 2 * LOBES * pocket * 0.1 == pytest.approx(float(volume), rel=1e-6)


@pytest.mark.parametrize(("lobes", "centre"), [(2, 0.92882), (3, 0.96693), (4, 0.98111)])
def test_radius_ratio_stays_below_its_limit(lobes, centre):
    """The single arc on the verge of undercut; and the limiting flank, s = 2 r sin(θ/2), traced
    backwards from the pitch crossing by the law of gearing."""
    height = np.sqrt(1 + centre**2 - 2 * centre * np.cos(np.pi / (2 * lobes)))
    limit = flow.greatest_radius_ratio(lobes)
    assert 0.85 < (centre + height - 1) / (limit - 1) < 1
    turned = np.linspace(0, np.pi / (2 * lobes), 20001)
    s = 0.0
    for step in np.diff(turned):
        half = s + step / 2 * np.sqrt(1 - s**2 / 4)
        s += step * np.sqrt(1 - half**2 / 4)
    assert 1 + s == pytest.approx(limit, rel=1e-9)


def test_twist_of_other_families_against_samples():
    """CIC has many lines: against the mean of shifted samples, and their Fourier transform."""
    profile = made("cic")
    shape, _, lines, _ = describe(profile)
    count, twist = 12000, np.radians(20.0)
    phi = np.arange(count) * 2 * np.pi / LOBES / count
    straight = np.asarray(over(profile, shape, jnp.asarray(phi)))
    # 20° are a sixth of the lobe pitch: a whole number of samples.
    kernel = np.append([0.5, *np.ones(count // 6 - 1), 0.5], np.zeros(count - count // 6 - 1))
    mean = np.fft.ifft(np.fft.fft(straight) * np.fft.fft(kernel * 6 / count)).real
    found = jax.jit(flow.twisted_ripple)(profile, shape, jnp.asarray(twist))
    assert float(found) == pytest.approx(np.ptp(mean), rel=1e-5)
    sizes = 2 * np.abs(np.fft.rfft(mean))[2 * np.arange(1, 5)] / count
    turned = flow.twisted_lines(lines[:4], LOBES, jnp.asarray(twist))
    np.testing.assert_allclose(np.abs(turned), sizes, atol=1e-6)


def test_sheet_counts_the_twist():
    config = load_config("ee", ["rotor.helix_deg=30", "solver.slices=2"])
    rows = sheet(Scene.from_config(config), design_vector(config))
    assert 100 * rows["flow_ripple"] == pytest.approx(9.794, abs=5e-4)
    assert 2 * rows["flow_lines"][0] == pytest.approx(rows["flow_ripple"], rel=1e-9)
