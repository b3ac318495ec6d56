"""Tests of drawings, solids and animation, read back and compared with the exact geometry."""

import io
import itertools
import re
from collections import Counter
from unittest import mock

import ezdxf
import numpy as np
import pytest
from PIL import Image, ImageSequence

from experiments._common.polygons import signed_distance
from rootsopt.commands.table import profile
from rootsopt.config import load
from rootsopt.measured.loop import signed_area
from rootsopt.profiles import CIC, EE, FreeForm, geometry, outline, place_pair
from rootsopt.response.result import Series
from rootsopt.scene import Scene, check_geometry, design_vector
from rootsopt.scene.space import Space
from rootsopt.view.figures import cad, chosen, writing
from rootsopt.view.figures.animation import meshing_gif, rolling_contacts
from rootsopt.view.figures.drawing import Drawing, svg_text
from rootsopt.view.figures.pieces import Arc, outline_pieces, polyline
from rootsopt.view.files import ResultFolder
from tests.standins import refusal

R = 0.033
LENGTH = 100.0


def textbook(lobes, alpha, tip):
    """Return a CIC whose tip arc is centred on the pitch circle: every flank has two arcs."""
    return CIC(lobes, R, alpha, R * np.sin(alpha) * (np.pi / (2 * lobes) - tip), tip)


PROFILES = {
    "cic 2, no land": CIC(2, R, 0.85, 5e-3, 0.0),
    "cic 3": CIC(3, R, 0.6358, 8.5e-3, 0.07),
    "cic 3, past the longest": CIC(3, R, 0.6358, 9.0e-3, 0.07),
    "cic 3, textbook": textbook(3, 0.6358, 0.07),
    "cic 3, textbook, no land": textbook(3, 0.6358, 0.0),
    "ee 3": EE(3, R),
}
every_profile = pytest.mark.parametrize("shape", PROFILES.values(), ids=PROFILES)
FREE = FreeForm(3, R, np.radians(2.0), np.array([0.7, 0.9, 0.95, 0.8, 0.4, 0.1, -0.3]))


def area_mm2(shape):
    return float(geometry(shape).area) * 1e6


def written(shape, folder):
    """Return a solid or assembly, read back from its STEP file."""
    from build123d import import_step

    file = folder / "shape.step"
    file.write_bytes(cad.step_bytes(shape))
    return import_step(file)


def drawing(shape, **changes):
    return Drawing(**{
        "pieces": outline_pieces(shape),
        "pitch_radius": R * 1e3,
        "outer_radius": float(geometry(shape).outer_radius) * 1e3,
        "lobes": shape.lobes,
        "length": LENGTH,
        "helix_deg": 0.0,
        "bore": None,
        "notes": ("one", "two & <three>"),
        "root_radius": float(geometry(shape).root_radius) * 1e3,
        "block": (("Title", "Rotor"), ("Material", "iron")),
    } | changes)  # fmt: skip


@every_profile
def test_pieces_lie_on_the_flank(shape):
    """The package's outline, computed with other normals, lies on the pieces within their
    tolerance.

    Arcs are recognised where the profile has them."""
    pieces = outline_pieces(shape)
    fine = polyline(pieces, 0.01)
    true = np.asarray(outline(shape, 20))[:-1] * 1e3
    distance = signed_distance(true, np.stack([fine.real, fine.imag], -1), refine=False)
    # Sagitta of the polygon's chords of 0.01 mm on radii of 5 mm and more, and the tolerance.
    assert np.max(np.abs(distance)) < 1e-5
    arcs = [piece for piece in pieces if isinstance(piece, Arc)]
    assert bool(arcs) == isinstance(shape, CIC)
    ra = float(geometry(shape).outer_radius) * 1e3
    lands = [a.sweep for a in arcs if abs(a.center) < 1e-6 and abs(a.radius - ra) < 1e-6]
    land = 2 * float(getattr(shape, "tip_arc_angle", 0.0))
    assert lands == pytest.approx([land] * shape.lobes * (land > 0), abs=1e-12)


def test_textbook_cic_has_arcs_about_the_pitch_circle():
    """The tip arc and its conjugate are circles of equal radius, centred on the pitch circle.

    Halves of an arc on both sides of a lobe's axis are one piece."""
    pieces = outline_pieces(textbook(3, 0.6358, 0.0))
    arcs = [piece for piece in pieces if isinstance(piece, Arc)]
    assert (len(arcs), len(pieces)) == (6, 18)
    np.testing.assert_allclose([abs(arc.center) for arc in arcs], 33.0, atol=1e-8)
    np.testing.assert_allclose([arc.radius for arc in arcs], arcs[0].radius, atol=1e-8)
    assert sorted(np.sign([arc.sweep for arc in arcs])) == [-1] * 3 + [1] * 3


@pytest.mark.parametrize("shape", [*PROFILES.values(), FREE], ids=[*PROFILES, "free form"])
def test_dxf_read_back(shape):
    """The DXF is in millimetres, has the layers, and is closed to 1e-9 mm; its area is right to
    1e-6."""
    document = ezdxf.read(io.StringIO(cad.dxf_bytes(drawing(shape, bore=12.0)).decode()))
    assert document.units == ezdxf.units.MM
    audit = document.audit()
    assert (audit.errors, audit.fixes) == ([], [])
    assert {entity.dxf.layer for entity in document.modelspace()} == {
        "OUTLINE", "BORE", "PITCH_CIRCLE", "CENTER_LINES", "TEXT",
        "CIRCLES", "DIMENSIONS", "TITLE_BLOCK", "TABLE",
    }  # fmt: skip
    for layer, radius in (("BORE", 6.0), ("PITCH_CIRCLE", 33.0)):
        (circle,) = document.modelspace().query(f'CIRCLE[layer=="{layer}"]')
        assert circle.dxf.radius == radius
    # Fine points of all entities in one counter-clockwise run, by ezdxf alone.
    entities = [*document.modelspace().query('*[layer=="OUTLINE"]')]
    assert all(one.dxftype() == "ARC" or one.dxf.degree == 3 for one in entities)
    fine = [one.construction_tool().flattening(1e-6) for one in entities]
    parts = [np.array([complex(point.x, point.y) for point in points]) for points in fine]
    ends, pieces = parts[-1][[0, -1]], []
    here = ends[np.argmin(np.min(np.abs(ends[:, None] - parts[0][[0, -1]]), axis=1))]
    for points in parts:
        # A concave arc of a DXF runs the other way round.
        if abs(points[-1] - here) < abs(points[0] - here):
            points = points[::-1]
        assert abs(points[0] - here) < 1e-9
        pieces.append(points[:-1])
        here = points[-1]
    run = np.concatenate(pieces)
    assert signed_area(run) == pytest.approx(area_mm2(shape), rel=1e-6)
    tip = np.max(np.abs(run))
    assert tip == pytest.approx(float(geometry(shape).outer_radius) * 1e3, abs=1e-5)
    assert abs(np.angle(run[np.argmin(np.abs(run - tip))])) < 1e-3


@pytest.mark.parametrize("name", ["cic 2, no land", "cic 3"])
def test_svg_read_back(name):
    """The drawing has true size, and its own curves enclose the area to 1e-6."""
    svg = pytest.importorskip("svgpathtools")
    shape = PROFILES[name]
    text = svg_text(drawing(shape))
    size = re.search(r'viewBox="(\S+) (\S+) (\S+) (\S+)"', text).group(3)
    assert re.search(rf'<svg [^>]*width="{size}mm"', text)
    assert "two &amp; &lt;three&gt;" in text
    path = svg.parse_path(re.search(r'class="outline" d="([^"]+)"', text).group(1))
    assert path.iscontinuous()
    assert path.isclosed()
    run = np.array([piece.point(x) for piece in path for x in np.arange(1000) / 1000])
    # Counter-clockwise with y up is clockwise with y down.
    assert -signed_area(run) == pytest.approx(area_mm2(shape), rel=1e-6)


@pytest.mark.parametrize(
    "shape", [PROFILES["cic 3, textbook, no land"], FREE], ids=["concave arcs", "lands"]
)
def test_step_read_back(shape, tmp_path):
    """Volume over length, and area of the section, are right to 1e-6; arcs are cylinders.

    This also holds with bore and twist."""
    pytest.importorskip("build123d")
    pieces = outline_pieces(shape)
    for bore, helix in ((0.0, 0.0), (10.0, -np.pi / 3)):
        back = written(cad.rotor(pieces, LENGTH, bore or None, helix), tmp_path)
        assert back.is_valid
        exact = area_mm2(shape) - np.pi * bore**2 / 4
        assert back.volume / LENGTH == pytest.approx(exact, rel=1e-6)
        kinds = [face.geom_type.name for face in back.faces()]
        planes = (face for face in back.faces() if face.geom_type.name == "PLANE")
        ends = sorted(planes, key=lambda end: end.center().Z)
        assert [end.area for end in ends] == pytest.approx([exact, exact], rel=1e-6)
        assert [end.center().Z for end in ends] == pytest.approx([0, LENGTH], abs=1e-9)
        assert abs(back.bounding_box().size.Z - LENGTH) <= 1e-6
        arcs = sum(isinstance(piece, Arc) for piece in pieces)
        assert kinds.count("CYLINDER") == (1 if bore else arcs)


def test_pair_meshes_along_its_length(tmp_path):
    """In every section of the twisted pair, rotor 2 is where the package's frame puts it.

    The rotors overlap nowhere, and the STL is closed."""
    build123d = pytest.importorskip("build123d")
    shape, helix = PROFILES["cic 3"], np.radians(50.0)
    back = written(cad.pair(outline_pieces(shape), 3, 66.0, LENGTH, None, helix), tmp_path)
    assert len(back.solids()) == 2
    assert {child.label for child in back.children} == {"rotor_1", "rotor_2"}
    points = np.asarray(outline(shape, 12)) * 1e3
    for z, turn in ((0.0, 0.0), (LENGTH, helix)):
        for rotor, placed in zip(
            back.solids(), place_pair(points, 3, 66.0, turn, turn), strict=True
        ):
            middle = placed[:-1].mean(axis=0)
            # The points are on its surface, not inside: a little outwards, they leave it.
            inner, outer = (
                [
                    rotor.distance_to(build123d.Vertex(x, y, z))
                    for x, y in middle + (placed[::29] - middle) * factor
                ]
                for factor in (1.0, 1 + 1e-4)
            )
            assert max(inner) < 1e-4 < min(outer)
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    corners = np.frombuffer(cad.stl_bytes(back.solids()[0])[84:], kind)["corners"].astype(float)
    volume = np.sum(np.linalg.det(corners)) / 6
    assert volume / LENGTH == pytest.approx(area_mm2(shape), rel=1e-3)
    faces = [[tuple(corner) for corner in face] for face in corners]
    edges = Counter((face[i], face[i - 1]) for face in faces for i in range(3))
    assert all(edges[b, a] == count for (a, b), count in edges.items())


def test_drawings_have_the_twist_of_the_design(tmp_path):
    config = load("ee", ["optimizer.bounds.helix_deg=[0, 90]", "rotor.helix_deg=20"])
    with mock.patch.object(writing, "_solids", return_value={}) as solids:
        writing.write(ResultFolder(tmp_path), config, ["stl"], {"helix_deg": 33.0})
    assert solids.call_args.args[0].helix_deg == 33.0


@pytest.mark.parametrize("text", ["dwg", "dxf,png", "none,dxf"])
def test_formats_that_are_not_known(text):
    assert "must be formats out of dxf, svg, step, stl, gif" in refusal(chosen, text)


@pytest.fixture
def few_frames(monkeypatch):
    """Use eight frames per mesh period, a fifth of the usual number."""
    monkeypatch.setattr("rootsopt.view.figures.animation._FRAMES", 8)


def frames_of(file):
    with Image.open(file) as picture:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(picture)]
    assert len(frames) == 8
    return [np.asarray(frame, float) for frame in frames]


def test_profile_writes_an_animation(tmp_path, few_frames):
    given = ["cic_drawn", "-o", str(tmp_path / "out"), "--no-figures", "--export", "gif"]
    assert profile.main(given) == 0
    gif = tmp_path / "out/figures/meshing.gif"
    assert gif.stat().st_size < 2e6 / 5
    assert all(np.mean(np.abs(a - b)) > 3 for a, b in itertools.pairwise(frames_of(gif)[:5:2]))


@every_profile
def test_rolling_contacts_touch_both_rotors(shape):
    """The contact point lies on both outlines, and a step along the normal leads from rotor 1 to 2.

    Drive and coast flanks take turns."""
    points = np.asarray(outline(shape, 200)) * 1e3
    angles = np.linspace(0.05, 2 * np.pi / shape.lobes - 0.03, 7)
    flanks = [rolling_contacts(shape, angles, coast) for coast in (False, True)]
    assert np.all(flanks[0].present ^ flanks[1].present)
    for i, angle in enumerate(angles):
        flank = flanks[int(flanks[1].present[i])]
        pair = place_pair(points, shape.lobes, 66.0, angle, angle)
        steps = flank.point[i] + np.array([[0.0], [0.05], [-0.05]]) * flank.normal[i]
        first, second = (signed_distance(steps, one) for one in pair)
        assert max(abs(first[0]), abs(second[0])) < 2e-3
        assert first[2] < 0 < first[1]
        assert second[1] < 0 < second[2]


def test_arrow_follows_the_force(few_frames):
    """The GIF of a simulation covers the requested periods.

    It has red and blue arrows only while that flank carries a force."""
    shape = PROFILES["cic 3"]
    turn = 2 * np.pi * np.arange(360) / 360
    force = np.where(np.arange(360) % 120 >= 60, 50.0, 0.0)
    series = Series(turn, turn, 0 * turn, 0 * turn, force, 0 * turn, 0 * turn)
    data = meshing_gif(drawing(shape), shape, series, 1)
    before, after = (
        np.sum(np.abs(frame[: len(frame) // 2] - [0, 114, 178]).sum(-1) < 40)
        for frame in frames_of(io.BytesIO(data))[2::4]
    )
    assert before < 0.2 * after


def test_bore_takes_mass_and_inertia():
    """A bore removes π ρ L r² and π/2 ρ L r⁴ from any design, and must fit into it.

    An optimisation keeps the root circle outside the bore."""
    plain, bored = (load("cic_drawn", sets) for sets in ([], ["rotor.bore_mm=20"]))
    one, other = Scene.from_config(plain), Scene.from_config(bored)
    cylinder = 7800.0 * 0.1 * np.pi * 0.01**2
    limits = {c.name: c for c in Space.of(bored, other).constraints}
    for factor in (1.0, 1.01):
        shape = geometry(one.profile(factor * design_vector(plain)))
        lost = [
            float(one.mass(shape) - other.mass(shape)),
            float(one.inertia(shape) - other.inertia(shape)),
        ]
        assert lost == pytest.approx([cylinder, cylinder * 0.01**2 / 2], rel=1e-9)
        slack = float(limits["root radius"].scaled(shape.root_radius))
        assert slack == pytest.approx(float(shape.root_radius) * 1e3 - 10.0, rel=1e-9)
    assert "root radius" not in {c.name for c in Space.of(plain, one).constraints}
    told = refusal(check_geometry, load("ee", ["rotor.bore_mm=44.0"]))
    assert re.search("`rotor.bore_mm` must be less than 44 .* but is 44", told)
    check_geometry(load("ee", ["rotor.bore_mm=43.9"]))
