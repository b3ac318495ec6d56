"""Tests of imported outlines: profile and deviations from files."""

import importlib.util
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.polygons import pair_gap
from rootsopt.commands.table import profile, simulate
from rootsopt.config import load, parse
from rootsopt.contact.closest import FlankPair
from rootsopt.errors import InputError
from rootsopt.measured.conjugacy import conjugacy, inset_note
from rootsopt.measured.curves import _jumps
from rootsopt.measured.fit import imported
from rootsopt.measured.loop import Loop
from rootsopt.measured.source import advice, outline_of
from rootsopt.optimize.design import optimize_design, pareto_front
from rootsopt.profiles import CIC, EE, geometry, outline
from rootsopt.scene import check_geometry
from rootsopt.scene.families import free_form_of
from tests.measured.test_finding import POSES, write

R = 0.033
CIC3 = CIC(3, R, np.deg2rad(36.43), 8.5e-3, np.deg2rad(4.0))
PROFILES = {"cic": CIC3, "ee": EE(3, R)}
every_profile = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES.keys())
CONFIG = """
profile: {{family: outline, lobes: 3, pitch_radius_mm: 33.0, outline_file: "{}"}}
rotor: {{length_mm: 100.0, density_kg_m3: 7800.0}}
contact: {{stiffness_N_per_mm_e: 2.0e5, exponent: 2.2, max_damping_N_s_per_mm: 0.25,
  full_damping_depth_mm: 0.01}}
scene: {{speed_rpm: 3000.0, load: {{torque_N_m: 4.775}},
  timing_gear: {{stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.5, backlash_mm: 0.1}}}}
"""


def points_of(profile, count=1000):
    """Return points of an outline (mm) to ten digits, as in a CSV file, without repeating the
    first."""
    points = np.asarray(outline(profile, count))[:-1] * 1e3
    return np.array([[float(f"{x:.10g}") for x in row] for row in points]) @ [1, 1j]


def profile_of(points, smoothing=0.0):
    return imported(Loop(points, np.zeros(len(points), bool)), 3, 1e3 * R, smoothing)


def closed(points):
    return np.stack([np.append(x, x[0]) for x in (points.real, points.imag)], axis=1)


def bulged(points, by):
    """Return points with the addenda `by` mm too thick."""
    along = np.roll(points, -1) - np.roll(points, 1)
    above = np.clip((np.abs(points) - 33) / (np.max(np.abs(points)) - 33), 0, 1)
    return points - 1j * along / np.abs(along) * by * np.sin(np.pi * above) ** 2


def cut(points, by):
    """Return points of an outline that is `by` mm smaller along its normals."""
    along = np.roll(points, -1) - np.roll(points, 1)
    return points + 1j * along / np.abs(along) * by


@jax.jit
def approaches(pair, rolls, relatives):
    return jax.lax.map(lambda pose: pair(*pose), (rolls, relatives))


def contact_of(profile):
    rolls, relatives = jnp.meshgrid(
        jnp.linspace(1e-3, np.pi / 3 - 1e-3, 121), jnp.array([0.0, -1e-4, -1e-3, -3e-3])
    )
    pair = FlankPair.of(profile, 2 * profile.pitch_radius, two_sided=True)
    return approaches(pair, rolls.ravel(), relatives.ravel())


@every_profile
def test_points_of_a_profile_give_its_contact_and_geometry(profile):
    """Gap within 1 nm, levers within 3e-4 of the pitch radius, area and inertia within 1e-9.

    Where arcs conform, ten digits do not determine the levers more closely."""
    found, checks = profile_of(points_of(profile))
    truth, contact = contact_of(profile), contact_of(found)
    assert np.array_equal(truth.found, contact.found)
    assert np.count_nonzero(truth.found) > 400
    gap, there = np.asarray(contact.gap - truth.gap), np.asarray(truth.found)
    assert np.max(np.abs(gap[there])) < 1e-9
    for lever in ("lever1", "lever2"):
        off = np.asarray(getattr(contact, lever) - getattr(truth, lever))
        assert np.max(np.abs(off[there])) < 3e-4 * R
    exact, shape = geometry(profile), geometry(found)
    for name in ("area", "polar_area_moment", "outer_radius", "root_radius"):
        assert float(getattr(shape, name)) == pytest.approx(float(getattr(exact, name)), rel=1e-9)
    assert float(shape.seal_width) == pytest.approx(float(exact.seal_width), rel=1e-3)
    assert np.isnan(shape.undercut_margin)
    assert max(checks.lobe_deviation_um, checks.flank_deviation_um) < 1e-3
    rolled = conjugacy(found)
    assert max(-rolled.least, rolled.most) < 1e-9


@every_profile
@pytest.mark.parametrize("by", [0.02, -0.02])
def test_a_wrong_outline_leaves_the_gap_that_its_points_leave(profile, by):
    """Addenda 20 µm too thick overlap by 20 µm, as node against segment finds."""
    points = bulged(points_of(profile), by)
    found, _ = profile_of(points)
    rolled = conjugacy(found)
    worst = rolled.least if by > 0 else rolled.most
    assert worst == pytest.approx(-by * 1e-3, rel=1e-3)
    for i in range(7, 361, 59):
        seen = pair_gap(closed(points), 3, 2e3 * R, rolled.roll[i], rolled.roll[i]) * 1e-3
        assert rolled.gap[i] == pytest.approx(seen, abs=1e-9)
    pair = FlankPair.of(found, 2 * found.pitch_radius, two_sided=True)
    rolls, relatives = np.array([0.3, 0.6, 0.9]), np.array([-1e-3, -2e-3, -5e-4])
    for x, e, gap in zip(rolls, relatives, approaches(pair, rolls, relatives).gap, strict=True):
        seen = pair_gap(closed(points), 3, 2e3 * R, -x - e / 2, -x + e / 2) * 1e-3
        assert float(gap) == pytest.approx(seen, abs=1e-9)


@pytest.mark.parametrize(
    ("by", "scatter"), [(0.5, 0.0), (0.02, 0.0), (-0.05, 0.0), (0.0, 0.0), (0.1, 2e-3), (0.0, 2e-3)]
)
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
        true = float(geometry(one).seal_width)
        assert float(geometry(found).seal_width) == pytest.approx(true, rel=0.05)


def test_lobes_off_the_axis_are_refused_before_anything_is_compiled(tmp_path, monkeypatch, capsys):
    """Every command that simulates says what `profile` says, unless the config gives the axis."""
    path = write(tmp_path / "points.csv", points_of(CIC3, 240) + 0.4)
    (tmp_path / "scene.yaml").write_text(CONFIG.format(path))
    looked = []
    monkeypatch.setattr("rootsopt.scene.families.check", looked.append)
    config = load(tmp_path / "scene.yaml")
    for work in (check_geometry, optimize_design, pareto_front):
        with pytest.raises(InputError, match=r"outline_center` = fit .*\[0, 0\]"):
            work(config)
    assert simulate.main([str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "out")]) == 2
    assert "set `profile.outline_center` = fit" in capsys.readouterr().err
    assert not looked
    for center, simulated in (([0, 0], True), ("fit", True), (None, False)):
        given = config.model_copy(
            update={"profile": config.profile.model_copy(update={"outline_center": center})}
        )
        check_geometry(given, simulated=simulated)
    assert len(looked) == 3


def test_turned_and_clockwise_outlines_are_put_right():
    points = points_of(CIC3, 240)
    found, checks = profile_of(points[::-1] * np.exp(0.3j))
    assert checks.reversed
    assert checks.turned_deg == pytest.approx(-np.degrees(0.3), abs=1e-6)
    assert conjugacy(found).least > -1e-9


def test_lobes_and_flanks_that_differ_are_told():
    points = points_of(CIC3, 240)
    lobe = np.abs(np.angle(points)) < np.pi / 3
    worse = np.where(lobe, bulged(points, 0.03), points)
    _, checks = profile_of(worse)
    # The mean lobe has a third of it.
    assert checks.lobe_deviation_um == pytest.approx(20, rel=0.01)
    leading = np.mod(np.angle(points), 2 * np.pi / 3) < np.pi / 3
    _, checks = profile_of(np.where(leading, bulged(points, 0.03), points))
    # The lobe's axis moves over with the flank and takes up part of it.
    assert 15 < checks.flank_deviation_um < 30
    assert "trailing flank" in advice(parse(CONFIG.format("x.csv")).profile, checks)[0]


def test_joints_are_seen():
    """Land, arc, involute and their mates give eight joints per lobe, without the pitch circle."""
    points = points_of(CIC3, 240)
    found = np.degrees(np.angle(points[np.roll(_jumps(np.roll(points, 77)), -77)]))
    assert np.sum(np.abs(found) < 59) == 8
    assert np.min(np.abs(found - 4)) < 1e-6


FAULTS = {
    "open": (lambda z: z[: len(z) * 3 // 4], "must be closed"),
    "two lobes": (lambda z: z * np.abs(z), "crosses the pitch circle"),
    "off the axis": (lambda z: z + 60, "around the rotor's axis"),
    "folded": (lambda z: z * np.exp(2e-4j * (np.abs(z) - 33) ** 4), "fold back"),
    "unequal": (lambda z: np.where(np.abs(np.angle(z)) < 1, bulged(z, 1.5), z), "equal lobes"),
    "hollow": (lambda z: bulged(z, -4.0), "convex addendum|fold back|a flank turns by"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path, fault):
    change, message = FAULTS[fault]
    path = write(tmp_path / "points.csv", change(points_of(CIC3, 240)))
    with pytest.raises(InputError, match=message):
        check_geometry(parse(CONFIG.format(path)))


def test_config_keys(tmp_path):
    path = write(tmp_path / "points.csv", points_of(CIC3, 60))
    (tmp_path / "scene.yaml").write_text(CONFIG.format("points.csv"))
    config = load(tmp_path / "scene.yaml")
    assert config.profile.outline_file == str(path)
    for change, message in (
        ("profile.outline_file=null", r"`profile.outline_file` is required"),
        ("profile.family=ee", r"`profile.outline_file` does not belong to family ee"),
    ):
        with pytest.raises(InputError, match=message):
            load(tmp_path / "scene.yaml", [change])
    with pytest.raises(InputError, match=r"must be a file that can be read"):
        check_geometry(load(tmp_path / "scene.yaml", ["profile.outline_file=none.csv"]))
    with pytest.raises(InputError, match=r"must not be read from a file for a projection"):
        free_form_of(config.profile, 12)
    with pytest.raises(InputError, match=r"`optimizer.family` must be one of"):
        load(tmp_path / "scene.yaml", ["optimizer.family=ee"])


def test_profile_command_reads_its_own_files(tmp_path, monkeypatch):
    """`profile` reads the CSV that it copies and the DXF that it draws; the folder is complete."""
    monkeypatch.setattr(*POSES)
    path = write(tmp_path / "points.csv", points_of(CIC3, 240))
    (tmp_path / "scene.yaml").write_text(CONFIG.format(path))
    drawn = "dxf" if importlib.util.find_spec("ezdxf") else "none"
    first = tmp_path / "first"
    arguments = [str(tmp_path / "scene.yaml"), "-o", str(first), "--no-figures", "--export", drawn]
    assert profile.main(arguments) == 0
    record = json.loads((first / "result.json").read_text())
    assert record["outline"]["interference_um"] < 1e-3
    assert record["geometry"]["undercut_margin_mm"] is None
    again = load(first / "config.yaml")
    assert again.profile.outline_file == str(first / "outline.csv")
    sources = ["profile_design.csv"] + (["rotor.dxf"] if drawn == "dxf" else [])
    for name in sources:
        other = again.profile.model_copy(update={"outline_file": str(first / name)})
        found, _ = outline_of(other)
        area = float(found.area) * 1e6
        assert area == pytest.approx(record["geometry"]["area_mm2"], rel=1e-7)
        assert max(-conjugacy(found).least, conjugacy(found).most) < 5e-8
