"""Leakage and play against closed forms, SciPy's quadrature and polygons of the rotors."""

import dataclasses
import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize

from experiments._common.polygons import pair_gap, signed_distance
from rootsopt import InputError, Scene, load_config
from rootsopt.measured.conjugacy import conjugacy
from rootsopt.profiles import CIC, geometry, place_pair
from rootsopt.profiles.epicycloid import circle_epicycloid
from rootsopt.pump.flow import (
    critical_ratio,
    laminar_mass_flow,
    leakage,
    mean_free_path,
    nozzle_flux,
    tip_length,
)
from rootsopt.pump.gap import Allowances, mesh_gap, play
from rootsopt.pump.sheet import KEYS, missing, sheet, warnings
from rootsopt.scene.reading import Gas
from tests.conformance.families import LOBES, R, made, measure, outline_of
from tests.measured.test_outline import PROFILES, points_of, profile_of

AIR = Gas(*map(jnp.asarray, (1e5, 293.15, 287.05, 1.4)))
DESIGN = jnp.asarray([36.43, 9.0, 4.0])

gapped = jax.jit(mesh_gap)


def gaps(family, normal=0.0, center=0.0, radial=0.0):
    return gapped(made(family), Allowances(*map(jnp.asarray, (normal, center, radial))))


def by_energy(before, throat):
    """Density times speed in the throat of a nozzle of air, from enthalpy and isentrope."""
    temperature = 293.15 * (throat / before) ** (0.4 / 1.4)
    speed = np.sqrt(2 * 287.05 * 3.5 * (293.15 - temperature))
    return throat / (287.05 * temperature) * speed


# Flow (m³/s at 100 kPa) through 1 m² of a choked nozzle behind 300 kPa.
FASTEST = by_energy(3e5, 3e5 * (2 / 2.4) ** 3.5) * 287.05 * 293.15 / 1e5


def test_nozzle_of_air():
    """150 → 100 kPa at 293.15 K: 338.706 kg/(s·m²); choked below 0.52828, where the flow is the
    greatest over all pressures in the throat."""
    flux, up = functools.partial(nozzle_flux, gas=AIR), jnp.asarray(1.5e5)
    assert float(flux(up, jnp.asarray(1e5))) == pytest.approx(338.706, abs=1e-3)
    assert float(critical_ratio(AIR.heat_ratio)) == pytest.approx(0.52828, abs=5e-6)
    assert float(flux(up, jnp.asarray(1e5))) == pytest.approx(by_energy(1.5e5, 1e5), rel=1e-12)
    best = optimize.minimize_scalar(
        lambda p: -by_energy(1.5e5, p), bounds=(5e4, 1.4e5), method="bounded"
    )
    choked, slope = jax.value_and_grad(flux, 1)(up, jnp.asarray(1e3))
    assert float(choked) == pytest.approx(-best.fun, rel=1e-9)
    assert (float(slope), float(flux(up, up))) == (0, 0)


def test_laminar_gas_by_quadrature_of_its_pressure():
    """Mass flow per width through a slot, from dp/dx with the density of each place; for a small
    pressure difference it is the liquid's."""
    h, length, up, down, mu = 5e-5, 4e-3, 3e5, 1e5, 1.8e-5
    found = laminar_mass_flow(*map(jnp.asarray, (h, length, up, down, mu)), AIR)
    driven, _ = integrate.quad(lambda p: p / (287.05 * 293.15), down, up)
    assert float(found) == pytest.approx(h**3 * driven / (12 * mu * length), rel=1e-12)


@pytest.mark.parametrize("family", ["ee", "cic"])
def test_gaps_are_those_of_polygons(family):
    outline = outline_of(family) / 1e3
    size = 2e-5
    moved, smaller = gaps(family, center=size), gaps(family, radial=size)
    shrunk = outline * (1 - size / np.hypot(*outline.T)[:, None])
    for k in (2, 11, 23, 37):
        phi = -float(moved.roll[k])
        polygons = [
            pair_gap(one, LOBES, distance, phi, phi)
            for one, distance in ((outline, 2 * R + size), (shrunk, 2 * R))
        ]
        found = [float(one.least[k]) for one in (moved, smaller)]
        assert polygons == pytest.approx(found, abs=0.02 * size)


@pytest.mark.parametrize(
    "family", ["cic", pytest.param("circle_epicycloid", marks=pytest.mark.long)]
)
def test_film_is_that_of_polygons(family):
    """h³ ∫ dl / d³ over the polygon of rotor 1, with its distance d from that of rotor 2; and the
    parabola of the same curvature where that is short."""
    h = 2e-5
    found = gaps(family, normal=h)
    # Length of a slot that passes as much as a gap h + x²/2R: h³ ∫ dx / (h + x²/2R)³.
    parabola = 3 * np.pi / 8 * np.sqrt(2 * np.asarray(found.least) / np.asarray(found.curvature))
    np.testing.assert_allclose(np.asarray(found.length)[[20, 33]], parabola[[20, 33]], rtol=0.02)
    for k in (8, 20, 33, 44):
        beta = float(found.roll[k])
        first, second = place_pair(outline_of(family) / 1e3, LOBES, 2 * R, -beta, -beta)
        distance = h + signed_distance(first[:-1], second)
        step = np.hypot(*np.diff(first, axis=0).T)
        inverse = (h / np.append(distance, distance[0])) ** 3
        film = np.sum((inverse[1:] + inverse[:-1]) / 2 * step)
        assert float(found.length[k]) == pytest.approx(film, rel=0.01)


@functools.cache
def scene_of(*changes):
    return Scene.from_config(load_config("configs/cic_drawn.yaml", changes))


LIQUID = (
    "pump={viscosity_mPa_s: 50, pressure_difference_Pa: 2.0e5, tip_clearance_mm: 0.08, "
    "end_clearance_mm: 0.05}",
    "contact.clearance_mm=0.06",
)
BLOWER = (*LIQUID, "pump.viscosity_mPa_s=0.0182", "pump.gas.inlet_pressure_Pa=1.0e5")
IN_SERIES = (*BLOWER, "pump.tips_in_series=3")
# Heat that changes no length; scenes where it does so have the same compiled program.
COLD = (*LIQUID, "scene.heat={}")


@eqx.filter_jit
def leaks(scene, design):
    profile = scene.profile(design)
    return leakage(scene, scene.medium, profile, geometry(profile))


def test_liquid_leaks_like_slots():
    scene = scene_of(*COLD)
    found, shape = leaks(scene, DESIGN), measure(scene.profile(DESIGN))
    strip = 4 * float(shape.outer_radius) ** 2 / float(shape.area)
    assert float(found.ends) == pytest.approx(4 * strip * 5e-5**3 * 2e5 / (12 * 0.05), rel=1e-12)
    np.testing.assert_allclose(found.gap.least, 6e-5, rtol=1e-12)
    volume = 2 * 0.1 * (np.pi * float(shape.outer_radius) ** 2 - float(shape.area))
    assert float(1 - found.efficiency) == pytest.approx(float(found.total) / (50 * volume))
    thicker = leaks(scene_of(*COLD, "pump.viscosity_mPa_s=100"), DESIGN)
    assert float(thicker.total) == pytest.approx(float(found.total) / 2, rel=1e-12)


@eqx.filter_jit
def tips(profile, height, nu):
    flank = profile.position(profile.addendum(nu))
    return tip_length(profile, geometry(profile), height), flank


def test_heat_opens_the_gaps_at_tips_and_ends():
    """The clearances are those between a housing and rotors whose lengths have grown.

    The housing's length is shared between two ends, the radius of its bore is not."""
    scene = scene_of(*LIQUID, "scene.heat={rotor_warming_K: 10, housing_warming_K: 40}")
    found, cold = leaks(scene, DESIGN), leaks(scene_of(*COLD), DESIGN)
    length, outer = 0.1, float(measure(scene.profile(DESIGN)).outer_radius)
    housing, rotor = 1.1e-5 * 40, 1.1e-5 * 10
    end = ((1 + housing) * length + 2 * 5e-5 - (1 + rotor) * length) / 2
    assert end == pytest.approx(66.5e-6)
    assert float(found.ends / cold.ends) == pytest.approx((end / 5e-5) ** 3, rel=1e-9)
    tip = (1 + housing) * outer + 8e-5 - (1 + rotor) * outer
    # The tips of both rotors, with the film that `test_tip_gap_by_polygon` checks.
    for leak, height in ((found, tip), (cold, 8e-5)):
        film, _ = tips(scene.profile(DESIGN), jnp.asarray(height), jnp.zeros(20001))
        each = length * height**3 * 2e5 / (12 * 0.05 * float(film))
        assert float(leak.tips) == pytest.approx(2 * each, rel=1e-9)


@pytest.mark.parametrize("family", ["circle_epicycloid", "cic"])
def test_tip_gap_by_polygon(family):
    """The film of the polygon, also for a tip arc almost concentric with the housing: such an arc
    seals over its own length, and no further."""
    profile, h = made(family), 2e-3 * R
    if family == "circle_epicycloid":
        profile = circle_epicycloid(
            LOBES, jnp.asarray(R), jnp.asarray(0.1389 * R), jnp.radians(5.0)
        )
    nu = np.linspace(0, float(profile.pitch_normal), 20001)
    length, flank = map(np.asarray, tips(profile, jnp.asarray(h), jnp.asarray(nu)))
    gap = h + np.linalg.norm(flank[0]) - np.linalg.norm((flank[1:] + flank[:-1]) / 2, axis=1)
    film = 2 * np.sum(np.linalg.norm(np.diff(flank, axis=0), axis=1) * (h / gap) ** 3)
    assert float(length) == pytest.approx(film, rel=1e-4)


def test_overlapping_flanks_let_nothing_through():
    """A search may pass through such designs. A negative flow would draw it there."""
    scene = dataclasses.replace(scene_of(*COLD), clearance=jnp.asarray(-1e-4))
    found = leaks(scene, DESIGN)
    assert float(jnp.max(found.gap.least)) < 0
    assert float(found.mesh) == 0
    with pytest.raises(InputError, match=r"overlap by 100 um; raise `contact.clearance_mm`"):
        sheet(dataclasses.replace(scene_of(*LIQUID), clearance=scene.clearance), DESIGN)


def test_gas_leaks_less_than_friction_or_inertia_alone():
    scene = scene_of(*IN_SERIES)
    found = leaks(scene, DESIGN)
    assert 0 < float(found.mesh) <= 0.1 * 6e-5 * FASTEST * (1 + 1e-12)
    assert 0 < float(found.tips) <= 2 * 0.1 * 8e-5 * FASTEST * (1 + 1e-12)
    assert float(found.knudsen) == pytest.approx(0.0662e-6 / 5e-5, rel=0.01)
    assert 0 < float(found.efficiency) < 1
    # The least gap counts, wherever it is.
    tight = eqx.tree_at(lambda s: s.medium.tip_clearance, scene, jnp.asarray(2e-5))
    assert float(leaks(tight, DESIGN).knudsen) == pytest.approx(0.0662e-6 / 2e-5, rel=0.01)


@eqx.filter_jit
def mesh_slopes(scene, design):
    def mesh(design):
        profile = scene.profile(design)
        found = leakage(scene, scene.medium, profile, geometry(profile))
        return found.mesh, found.gap.length

    (flow, length), (slope, _) = jax.jvp(mesh, (design,), (jnp.asarray([1.0, 1.0, 0.0]),))
    return flow, slope, length


def test_mesh_leakage_is_smooth_where_friction_takes_over_from_inertia():
    """It is the mean of the lesser flow over the roll, by NumPy, and its slope that of differences:
    the slope of a design that is moved by as little as a film's sampled points are apart."""
    scene = dataclasses.replace(scene_of(*IN_SERIES), clearance=jnp.asarray(3e-5))
    rows = [mesh_slopes(scene, DESIGN + shift) for shift in np.outer(range(4), [2e-3, 2e-3, 0])]
    flow, slope, length = (np.array(x) for x in zip(*rows, strict=True))
    slow = (3e-5) ** 3 * (9e10 - 1e10) / (24 * 1.82e-5 * length[0] * 1e5)
    fast = 3e-5 * FASTEST
    lesser = np.minimum(np.interp(np.linspace(-0.5, 47.5, 480_001), range(48), slow), fast)
    assert 3 < np.sum(slow < fast) < 43
    assert flow[0] == pytest.approx(0.1 * np.mean(lesser), rel=1e-6)
    np.testing.assert_allclose((flow[2:] - flow[:-2]) / 4e-3, slope[1:-1], rtol=1e-4)


def test_tips_in_series_share_the_pressure_ratio():
    """Of wide tips, three nozzles with equal pressure ratios; by energy and isentrope.

    Three nozzles that pass the same mass, solved by SciPy, pass up to a tenth less."""
    up, down, height = 1.3e5, 1e5, 5e-4
    wide = eqx.tree_at(
        lambda s: (s.medium.pressure_difference, s.medium.tip_clearance),
        scene_of(*IN_SERIES), (jnp.asarray(up - down), jnp.asarray(height)),
    )  # fmt: skip
    rate = float(leaks(wide, DESIGN).tips) * down / (287.05 * 293.15) / (2 * 0.1 * height)
    assert rate == pytest.approx(by_energy(up, up ** (2 / 3) * down ** (1 / 3)), rel=1e-9)

    def uneven(between):
        return np.diff([by_energy(a, b) for a, b in itertools.pairwise([up, *between, down])])

    first = optimize.fsolve(uneven, [1.2e5, 1.1e5])[0]
    assert by_energy(up, first) < rate < 1.1 * by_energy(up, first)


def test_sheet_has_the_rows_of_its_inputs(monkeypatch):
    # The play has its own tests, and takes most of the time of a sheet.
    monkeypatch.setattr("rootsopt.pump.sheet._has_play", lambda scene: False)
    small = sheet(scene_of(), DESIGN)
    assert len(small) == 5
    # 3,000 revolutions per minute; a litre has a thousand cubic centimetres.
    assert small["theoretical_flow_l_min"] == pytest.approx(
        small["displaced_volume_cm3"] / 1000 * 3000, rel=1e-12
    )
    whole = sheet(scene_of(*LIQUID), DESIGN)
    assert whole["volumetric_efficiency"] == pytest.approx(
        1
        - sum(whole[f"{place}_leakage_l_min"] for place in ("mesh", "tip", "end"))
        / whole["theoretical_flow_l_min"],
        rel=1e-12,
    )
    assert whole["flank_gap_min_um"] == pytest.approx(60)
    assert "knudsen_number" not in whole


def test_sheet_says_what_it_lacks_and_what_does_not_hold():
    assert missing({}).count("(") == 3
    whole = dict.fromkeys(KEYS, 0.5)
    assert missing(whole) == ""
    assert "`pump.tip_clearance_mm`" in missing({k: 0.5 for k in whole if "tip_leak" not in k})
    assert warnings({}) == warnings({"volumetric_efficiency": 0.9, "knudsen_number": 1e-3}) == []
    for key, value, word in (
        ("knudsen_number", 0.1, "slips"),
        ("knudsen_number", 2.0, "molecular"),
        ("volumetric_efficiency", -1.0, "delivers nothing"),
    ):
        assert word in warnings({key: value})[0]
    # Closed flanks: the number is that of the gap at the end faces. Air at 20 °C: 0.0662 µm.
    scene = scene_of(BLOWER[0], *BLOWER[2:])
    path = float(mean_free_path(scene.medium.gas.inlet_pressure, scene.medium.viscosity, AIR))
    assert path == pytest.approx(0.0662e-6, rel=0.01)
    assert sheet(scene, DESIGN)["knudsen_number"] == pytest.approx(path / 5e-5, rel=1e-9)


def test_pressure_is_asked_for():
    changes = ["pump.viscosity_mPa_s=50", "scene.load={pressure_difference_Pa: 3.0e4}"]
    with pytest.raises(InputError, match=r"`pump.pressure_difference_Pa` must be given"):
        load_config("configs/cic_drawn.yaml", changes[:1])
    assert load_config("configs/cic_drawn.yaml", changes).pump.pressure_difference_Pa == 3e4


# Play against polygons that are pushed into each other, and closed forms


C = 5e-5


played = jax.jit(play)


@functools.cache
def of(family, error=0.0):
    return played(made(family), C, 2 * R + error, radial=0.0)


def test_ee_and_involute():
    """At the pitch crossing of EE the lever is r; on an involute it is r cos α, and stays so."""
    assert float(of("ee").gear_backlash) == pytest.approx(2 * C, rel=1e-4)
    assert np.min(of("ee").total) > 2 * C / R
    found = of("cic")
    angle = C / (R * np.cos(np.radians(36.43)))
    assert float(found.gear_backlash) == pytest.approx(2 * R * angle, rel=1e-6)
    # Rotor 1's drive flank touches on the involute where 0 ≤ -φ1 - π/2N, as far as it reaches.
    near = np.abs(np.asarray(found.phi) - 2 * np.pi / LOBES + np.pi / 6) < 0.2
    assert np.sum(near) > 5
    np.testing.assert_allclose(np.asarray(found.behind)[near], -angle, rtol=1e-5)


@pytest.mark.parametrize(
    ("family", "error"),
    [
        ("cic", 0.0),
        ("cic", 3e-5),
        *(
            pytest.param(one, 0.0, marks=pytest.mark.long)
            for one in ("ee", "five_arcs", "ellipse", "extended_cycloid")
        ),
    ],
)
def test_polygons_touch_where_the_play_ends(family, error):
    """The rotors' polygons, with nominal flanks, overlap there by the clearance; half the way they
    do by less. So they do at another centre distance, where the flanks are not conjugate."""
    found, outline = of(family, error), outline_of(family) / 1e3
    for k in (3, 41, 70):
        phi, behind, ahead = (float(x[k]) for x in (found.phi, found.behind, found.ahead))
        for end in (behind, ahead):
            gap = pair_gap(outline, LOBES, 2 * R + error, phi, phi + end)
            assert gap == pytest.approx(-C, rel=2e-3)
            assert pair_gap(outline, LOBES, 2 * R + error, phi, phi + end / 2) > -0.99 * C


def test_overlap_is_negative():
    """A centre distance that is too small: tips overlap by all of it, flanks by less."""
    found = of("ee", -2e-4)
    assert float(found.overlap) == pytest.approx(2e-4 - C, rel=2e-2)
    # The greatest lever of EE is r.
    assert -1.05 < float(found.gear_backlash) / (2 * 1.5e-4) < -0.5
    assert float(of("ee").overlap) == 0


@pytest.mark.long
@pytest.mark.parametrize("family", ["ee", "cic"])
def test_play_is_continuous_in_the_overlap(family):
    """Points with 2 µm of scatter: from overlap to clearance, the backlash changes by twice the
    clearance over the cosine of the least pressure angle, and the overlap is that of the gap."""
    points = points_of(PROFILES[family], 240)
    points = points + 2e-3 * np.random.default_rng(0).normal(size=(len(points), 2)) @ [1, 1j]
    scattered = profile_of(points, 2e-3)[0]
    # Backlash, overlap and clearance in µm, least play in mrad.
    clearance = np.array([-5.0, -0.5, 0.0, 0.5, 5.0])
    found = [played(scattered, 1e-6 * c, 2 * R, radial=0.0) for c in clearance]
    backlash, overlap, play = np.array(
        [(1e6 * x.gear_backlash, 1e6 * x.overlap, 1e3 * jnp.min(x.total)) for x in found], float
    ).T
    least = 1e6 * conjugacy(scattered).least
    assert -4 < least < -0.5
    assert overlap == pytest.approx(np.maximum(0, -least - clearance), abs=0.2)
    slope = np.diff(backlash) / np.diff(clearance)
    steepest = 2 / (1 if family == "ee" else np.cos(np.radians(36.43)))
    assert np.all((slope > 0.4 * steepest) & (slope < 1.3 * steepest))
    assert -2.5 * steepest < backlash[2] < 0
    assert np.all(np.abs(np.diff(play)) < 5)


def test_smaller_rotors_have_the_play_of_their_gap():
    """A radius that is smaller everywhere: the gap of the flanks, over the lever r cos ψ."""
    profile, gap = made("cic"), gaps("cic", radial=C)
    found = played(profile, 0.0, 2 * R, radial=C)
    lever = R * np.cos(profile.addendum(profile.normal_at(gap.roll)).psi)
    expected = 2 * R * np.min(np.asarray(gap.least) / lever)
    assert float(found.gear_backlash) == pytest.approx(expected, rel=2e-2)
    assert expected > C


def test_sheet_counts_all_that_parts_the_flanks(monkeypatch):
    """The play is that with the config's clearance, centre distance error and smaller radius."""
    monkeypatch.setattr("rootsopt.pump.sheet._leaking", lambda *_: {})
    scene = scene_of(
        "pump={viscosity_mPa_s: 50, pressure_difference_Pa: 2.0e5, radial_allowance_mm: 0.01}",
        "contact.clearance_mm=0.05",
        "scene.center_distance_error_mm=0.02",
    )
    expected = played(scene.profile(DESIGN), C, 2 * R + 2e-5, radial=1e-5).gear_backlash
    found = sheet(scene, DESIGN)["gear_backlash_max_mm"]
    assert found == pytest.approx(1e3 * float(expected), rel=1e-9)


def test_play_is_smooth_in_the_design():
    """Over moves as short as the sampled points are apart, slopes are those of differences."""

    @jax.jit
    def ends(angle):
        def at(angle):
            profile, poses = CIC(LOBES, R, angle, 8.5e-3, 0.07), jnp.asarray([0.1, 0.35, 0.8])
            found = play(profile, jnp.asarray(C), phi=poses)
            return jnp.stack([found.behind, found.ahead])

        return jax.jvp(at, (angle,), (jnp.ones(()),))

    found = [ends(np.deg2rad(36.4) + 2e-6 * k) for k in range(12)]
    values, slopes = (np.array(x) for x in zip(*found, strict=True))
    np.testing.assert_allclose(
        (values[2:] - values[:-2]) / 4e-6, slopes[1:-1], atol=1e-4 * np.max(np.abs(slopes))
    )
