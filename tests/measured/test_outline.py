"""Tests of imported outlines: profile and deviations from files.

What a file says about its rotor is found from its points alone."""

import json
import re

import jax
import numpy as np
import pytest

from experiments._common.polygons import pair_gap
from rootsopt.commands.table import profile, simulate
from rootsopt.config import load, parse
from rootsopt.contact.closest import FlankPair
from rootsopt.measured.conjugacy import conjugacy, inset_note
from rootsopt.measured.fit import imported
from rootsopt.measured.loop import Loop
from rootsopt.measured.source import advice, outline_of, read_rotor
from rootsopt.optimize.design import optimize_design, pareto_front
from rootsopt.profiles import CIC, EE, outline
from rootsopt.scene import check_geometry
from rootsopt.scene.families import free_form_of
from tests.conformance.families import measure
from tests.standins import refusal

R = 0.033
CIC3 = CIC(3, R, np.deg2rad(36.43), 8.5e-3, np.deg2rad(4.0))
PROFILES = {"cic": CIC3, "ee": EE(3, R)}
CONFIG = """
profile: {{family: outline, lobes: 3, pitch_radius_mm: 33.0, outline_file: "{}"}}
rotor: {{length_mm: 100.0, density_kg_m3: 7800.0}}
contact: {{stiffness_N_per_mm_e: 2.0e5, exponent: 2.2, max_damping_N_s_per_mm: 0.25,
  full_damping_depth_mm: 0.01}}
scene: {{speed_rpm: 3000.0, load: {{torque_N_m: 4.775}},
  timing_gear: {{stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.5, backlash_mm: 0.1}}}}
"""

# Fewer roll angles at which the gap is measured, as `setattr` takes them.
POSES = "rootsopt.measured.conjugacy._POSES", 91


def cycloids(lobes, radius, count=300):
    """Return points (mm) of EE by its textbook formula: an epicycloid and a hypocycloid in turn."""
    small, turn = radius / (2 * lobes), np.linspace(0, np.pi / lobes, count, endpoint=False)
    out, back = radius + small, radius - small
    lobe = out * np.exp(1j * turn) - small * np.exp(1j * turn * out / small)
    valley = back * np.exp(1j * turn) + small * np.exp(-1j * turn * back / small)
    pair = np.concatenate([lobe, valley * np.exp(1j * np.pi / lobes)])
    return (np.exp(2j * np.pi * np.arange(lobes)[:, None] / lobes) * pair).ravel()


def cut(points, by):
    """Return points of an outline that is `by` mm smaller along its normals."""
    along = np.roll(points, -1) - np.roll(points, 1)
    return points + 1j * along / np.abs(along) * by


def cut_cic(inset):
    """Return points (mm) of a CIC rotor of pitch radius 33 mm, smaller by `inset` (mm)."""
    return cut(np.asarray(outline(CIC3, 300))[:-1] @ [1e3, 1e3j], inset)


def write(path, points):
    np.savetxt(path, np.stack([points.real, points.imag], axis=1), fmt="%.10g", delimiter=",")
    return path


def points_of(profile, count=1000):
    """Return points of an outline (mm) to ten digits, as in a CSV file, without repeating the
    first."""
    points = np.asarray(outline(profile, count))[:-1] * 1e3
    return np.array([[float(f"{x:.10g}") for x in row] for row in points]) @ [1, 1j]


def profile_of(points, smoothing=0.0):
    return imported(Loop(points, np.zeros(len(points), bool)), 3, 1e3 * R, smoothing)


def bulged(points, by):
    above = np.clip((np.abs(points) - 33) / (np.max(np.abs(points)) - 33), 0, 1)
    return cut(points, -by * np.sin(np.pi * above) ** 2)


@jax.jit
def approaches(profile, rolls, relatives):
    pair = FlankPair.of(profile, 2 * profile.pitch_radius, two_sided=True)
    return jax.lax.map(lambda pose: pair(*pose), (rolls, relatives))


@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES.keys())
def test_points_of_a_profile_give_its_contact_and_geometry(profile):
    """Gap within 1 nm, levers within 3e-4 of the pitch radius, area and inertia within 1e-9.

    Where arcs conform, ten digits do not determine the levers more closely."""
    found, checks = profile_of(points_of(profile))
    poses = np.meshgrid(np.linspace(1e-3, np.pi / 3 - 1e-3, 121), [0.0, -1e-4, -1e-3, -3e-3])
    truth, contact = (approaches(one, *map(np.ravel, poses)) for one in (profile, found))
    assert np.array_equal(truth.found, contact.found)
    assert np.count_nonzero(truth.found) > 400
    gap, there = np.asarray(contact.gap - truth.gap), np.asarray(truth.found)
    assert np.max(np.abs(gap[there])) < 1e-9
    for lever in ("lever1", "lever2"):
        off = np.asarray(getattr(contact, lever) - getattr(truth, lever))
        assert np.max(np.abs(off[there])) < 3e-4 * R
    exact, shape = measure(profile), measure(found)
    for name in ("area", "polar_area_moment", "outer_radius", "root_radius"):
        assert float(getattr(shape, name)) == pytest.approx(float(getattr(exact, name)), rel=1e-9)
    assert float(shape.seal_width) == pytest.approx(float(exact.seal_width), rel=1e-3)
    assert np.isnan(shape.undercut_margin)
    assert max(checks.lobe_deviation_um, checks.flank_deviation_um) < 1e-3
    assert np.nanmax(np.abs(conjugacy(found).gap)) < 1e-9


@pytest.mark.parametrize(("name", "by"), [("cic", 0.02), ("ee", -0.02)])
def test_a_wrong_outline_leaves_the_gap_that_its_points_leave(name, by):
    """Addenda 20 µm too thick overlap by 20 µm, as node against segment finds."""
    points = bulged(points_of(PROFILES[name]), by)
    found, _ = profile_of(points)
    polygon = np.stack([np.append(x, x[0]) for x in (points.real, points.imag)], axis=1)

    def gaps(*poses):
        return [pair_gap(polygon, 3, 2e3 * R, *pair) * 1e-3 for pair in zip(*poses, strict=True)]

    rolled = conjugacy(found)
    assert (rolled.least if by > 0 else rolled.most) == pytest.approx(-by * 1e-3, rel=1e-3)
    some = slice(7, None, 59)
    assert rolled.gap[some] == pytest.approx(gaps(rolled.roll[some], rolled.roll[some]), abs=1e-9)
    x, e = np.array([0.3, 0.6, 0.9]), np.array([-1e-3, -2e-3, -5e-4])
    seen = gaps(-x - e / 2, -x + e / 2)
    assert np.asarray(approaches(found, x, e).gap) == pytest.approx(seen, abs=1e-9)


@pytest.mark.parametrize(("by", "scatter"), [(0.02, 0.0), (-0.05, 0.0), (0.1, 2e-3), (0.0, 2e-3)])
def test_an_inset_is_seen_in_the_mesh(by, scatter):
    """Half the gap in rolling, with its sign; within the scatter, there is none."""
    points = cut(points_of(CIC3, 240), by)
    points = points + scatter * np.random.default_rng(0).normal(size=(2892, 2)) @ [1, 1j]
    found = conjugacy(profile_of(points, scatter)[0])
    assert found.inset == pytest.approx(by * 1e-3, abs=1e-9 + 0.2e-3 * scatter)
    assert found.record()["inset_um"] == found.inset / 1e-6
    said = inset_note(found.inset, 0.05)
    if scatter == 0 and by > 0:
        assert f"inset {by:g} mm" in said
        assert f"--set contact.clearance_mm={0.05 + 2 * by:.4g}`" in said
    assert ("oversize" in said) == (by < 0)


def test_seal_width_within_the_scatter():
    """Points with 2 µm of scatter: a land of 6.26 mm is found to 5 %; a rounded tip has none."""
    scatter = 2e-3
    off = np.random.default_rng(2).normal(size=(3000, 2)) @ [1, 1j]
    for one in PROFILES.values():
        points = points_of(one, 240)
        found, _ = profile_of(points + scatter * off[: len(points)], scatter)
        true = float(measure(one).seal_width)
        assert float(measure(found).seal_width) == pytest.approx(true, rel=0.05)


def test_lobes_off_the_axis_are_refused_before_anything_is_compiled(tmp_path, monkeypatch, capsys):
    """Every command that simulates says what `profile` says, unless the config gives the axis."""
    path = write(tmp_path / "points.csv", points_of(CIC3, 240) + 0.4)
    (tmp_path / "scene.yaml").write_text(CONFIG.format(path))
    looked = []
    monkeypatch.setattr("rootsopt.scene.families.check", looked.append)
    config = load(tmp_path / "scene.yaml")
    for work in (check_geometry, optimize_design, pareto_front):
        assert re.search(r"outline_center` = fit .*\[0, 0\]", refusal(work, config))
    assert simulate.main([str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "out")]) == 2
    assert "set `profile.outline_center` = fit" in capsys.readouterr().err
    assert not looked
    for center, simulated in (("[0, 0]", True), ("fit", True), ("null", False)):
        given = load(tmp_path / "scene.yaml", [f"profile.outline_center={center}"])
        check_geometry(given, simulated=simulated)
    assert len(looked) == 3


def test_turned_and_clockwise_outlines_are_put_right():
    found, checks = profile_of(points_of(CIC3, 240)[::-1] * np.exp(0.3j))
    assert checks.reversed
    assert checks.turned_deg == pytest.approx(-np.degrees(0.3), abs=1e-6)
    assert conjugacy(found).least > -1e-9


def test_lobes_and_flanks_that_differ_are_told():
    points = points_of(CIC3, 240)
    worse, angle = bulged(points, 0.03), np.angle(points)
    _, checks = profile_of(np.where(np.abs(angle) < np.pi / 3, worse, points))
    # The mean lobe has a third of it.
    assert checks.lobe_deviation_um == pytest.approx(20, rel=0.01)
    _, checks = profile_of(np.where(np.mod(angle, 2 * np.pi / 3) < np.pi / 3, worse, points))
    # The lobe's axis moves over with the flank and takes up part of it.
    assert 15 < checks.flank_deviation_um < 30
    assert "trailing flank" in advice(parse(CONFIG.format("x.csv")).profile, checks)[0]


FAULTS = {
    "open": (lambda z: z[: len(z) * 3 // 4], "must be closed"),
    "two lobes": (lambda z: z * np.abs(z), "crosses the pitch circle"),
    "off the axis": (lambda z: z + 60, "around the rotor's axis"),
    "folded": (lambda z: z * np.exp(2e-4j * (np.abs(z) - 33) ** 4), "fold back"),
    "unequal": (lambda z: np.where(np.abs(np.angle(z)) < 1, bulged(z, 1.5), z), "equal lobes"),
    "hollow": (lambda z: bulged(z, -4.0), "convex addendum|fold back|a flank turns by"),
    "collinear": (lambda z: z.real + 0j, ""),
    "two points": (lambda z: z[[0, len(z) // 2]], ""),
    "six points": (lambda z: z[:: len(z) // 6], ""),
    "axis among the points": (lambda z: np.where(np.arange(len(z)) == 5, 0, z), ""),
    "spike": (lambda z: np.where(np.arange(len(z)) == 5, 3 * z, z), ""),
    "twice around": (lambda z: np.concatenate([z, z]), ""),
    "figure of eight": (
        lambda z: np.concatenate([z.real + 60 + 1j * z.imag, -z.real - 60 - 1j * z.imag]),
        "",
    ),
    "micrometres": (lambda z: z * 1e3, ""),
    "metres": (lambda z: z * 1e-3, ""),
    "in any order": (lambda z: np.random.default_rng(0).permutation(z), ""),
    "lobes of other angles": (lambda z: np.abs(z) * np.exp(2j * np.angle(z) / 3), ""),
    "circle": (lambda z: 33.0 * np.exp(2j * np.pi * np.arange(len(z)) / len(z)), ""),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path, fault, capfd):
    change, message = FAULTS[fault]
    path = write(tmp_path / "points.csv", change(points_of(CIC3, 60)))
    assert re.search(message, refusal(check_geometry, parse(CONFIG.format(path))))
    assert capfd.readouterr().err == ""


def test_config_keys(tmp_path):
    scene = tmp_path / "scene.yaml"
    scene.write_text(CONFIG.format("points.csv"))
    config = load(scene)
    assert config.profile.outline_file == str(tmp_path / "points.csv")
    for change, message in (
        ("profile.outline_file=null", "`profile.outline_file` is required"),
        ("profile.family=ee", "`profile.outline_file` does not belong to family ee"),
        ("optimizer.family=ee", "`optimizer.family` must be one of"),
    ):
        assert message in refusal(load, scene, [change])
    assert "must be a file that can be read" in refusal(check_geometry, config)
    assert "must not be read from a file for a" in refusal(free_form_of, config.profile, 12)


def test_profile_command_reads_its_own_files(tmp_path, monkeypatch):
    """`profile` reads the CSV that it copies and the DXF that it draws; the folder is complete."""
    monkeypatch.setattr(*POSES)
    path = write(tmp_path / "points.csv", points_of(CIC3, 240))
    (tmp_path / "scene.yaml").write_text(CONFIG.format(path))
    first = tmp_path / "first"
    options = ["-o", str(first), "--no-figures", "--export", "dxf"]
    assert profile.main([str(tmp_path / "scene.yaml"), *options]) == 0
    record = json.loads((first / "result.json").read_text())
    assert record["outline"]["interference_um"] < 1e-3
    assert record["geometry"]["undercut_margin_mm"] is None
    again = load(first / "config.yaml")
    assert again.profile.outline_file == str(first / "outline.csv")
    for name in ("profile_design.csv", "rotor.dxf"):
        other = again.profile.model_copy(update={"outline_file": str(first / name)})
        found, _ = outline_of(other)
        assert float(found.area) * 1e6 == pytest.approx(record["geometry"]["area_mm2"], rel=1e-7)
        assert np.nanmax(np.abs(conjugacy(found).gap)) < 5e-8


def found_in(folder, points, given=None):
    return read_rotor(
        write(folder / "rotor.csv", points), given or {}, lambda what, default: default
    )


ROTORS = {
    "EE of 2 lobes in um, clockwise, off centre": (
        (cycloids(2, 40.0)[::-1] * np.exp(0.3j) + 7 - 2j) / 1e-3, "um", 2, 80.0, 0.0, 7 - 2j),
    "EE of 4 lobes in m": (cycloids(4, 55.0) / 1e3, "m", 4, 110.0, 0.0, 0j),
    "CIC cut by 0.1 mm in inch, turned": (
        (cut_cic(0.1) * np.exp(1j) + 20j) / 25.4, "inch", 3, 66.0, 0.1, 20j),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] * ("CIC" not in n)) for n in ROTORS]
)
def test_unit_axis_lobes_distance_and_inset_are_found(name, tmp_path, monkeypatch):
    monkeypatch.setattr(*POSES)
    points, unit, lobes, distance, inset, axis = ROTORS[name]
    rotor = found_in(tmp_path, points)
    assert rotor.lobes == lobes
    assert rotor.radius == pytest.approx(distance / 2, abs=2e-3)
    assert conjugacy(rotor.outline).inset * 1e3 == pytest.approx(inset, abs=1e-3)
    assert abs(rotor.checks.axis - axis) < 1e-3
    assert f"unit {unit}" in rotor.facts[0]


@pytest.mark.long
def test_scattered_and_dense_points_are_thinned_and_smoothed(tmp_path):
    noise = np.random.default_rng(0).normal(0, 0.004, (2, 20_000)).T @ [1, 1j]
    whole = cut_cic(0.1)
    place = np.arange(20_000) / 20_000 * len(whole)
    points = np.interp(place, np.arange(len(whole)), whole, period=len(whole))
    rotor = found_in(tmp_path, points + noise)
    assert rotor.radius == pytest.approx(33, abs=5e-3)
    assert conjugacy(rotor.outline).inset * 1e3 == pytest.approx(0.1, abs=5e-3)
    assert any("points is used" in fact for fact in rotor.facts)


REFUSED = {
    "a circle": (50 * np.exp(2j * np.pi * np.arange(400) / 400), {}, "no such symmetry"),
    "another distance": (cycloids(3, 33.0), {"pitch_radius_mm": 41.0}, "`--centre-distance-mm`"),
    "lobes that do not mesh": (
        np.exp(2j * np.pi * np.arange(900) / 900)
        * (40 + 12 * np.cos(6 * np.pi * np.arange(900) / 900)), {}, "rolls on another"),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] * ("lobes" in n)) for n in REFUSED]
)
def test_what_is_no_rotor_is_refused(name, tmp_path):
    points, given, message = REFUSED[name]
    assert message in refusal(found_in, tmp_path, points, given)
