"""Dimensions, title block and coordinates of the drawing, read back from the DXF file."""

import io

import ezdxf
import numpy as np
import pytest

from rootsopt.commands.table import profile as command
from rootsopt.config import load
from rootsopt.profiles import geometry
from rootsopt.view.figures.cad import dxf_bytes
from rootsopt.view.figures.drawing import coordinates
from rootsopt.view.figures.pieces import Arc, outline_pieces, polyline
from tests.standins import refusal
from tests.view.test_export import PROFILES, drawing

CONFIG = "cic_drawn"
DRAWN = "cic 2, no land", "cic 3", "cic 3, past the longest", "ee 3"


@pytest.mark.parametrize("name", DRAWN)
def test_dimensions_measure_the_rotor(name):
    """DIMENSION entities measure the geometry; the lobe width is that of a polygon."""
    shape = PROFILES[name]
    document = ezdxf.read(io.StringIO(dxf_bytes(drawing(shape, bore=12.0)).decode()))
    measured = {
        entity.dxf.text.split()[-1]: entity.get_measurement()
        for entity in document.modelspace().query("DIMENSION")
    }
    sizes = geometry(shape)
    points = polyline(outline_pieces(shape), 0.005)
    lobe = points[(np.abs(np.angle(points)) < np.pi / shape.lobes) & (points.real > 0)]
    upper = lobe[np.argsort(-np.angle(lobe))][::-1]  # from below to above
    upper = upper[upper.imag >= 0]
    rising = np.flatnonzero(np.diff(upper.imag) < 0)
    # From the tip on, y rises to the widest place; without one, the flank is cut at the pitch line.
    width = 2 * upper.imag[rising[0]] if len(rising) else 66 * np.sin(np.pi / (2 * shape.lobes))
    assert measured.pop("lobe") == pytest.approx(width, abs=2e-5)
    expected = {"outer": 2e3 * float(sizes.outer_radius), "root": 2e3 * float(sizes.root_radius)}
    assert measured == pytest.approx(expected | {"pitch": 66.0, "bore": 12.0}, abs=1e-9)


@pytest.mark.parametrize("name", DRAWN)
def test_coordinates_lie_on_the_flank(name):
    """Points lie between dense points of the outline, evenly spaced and symmetric.

    Their normals are those of the outline. The ends of all arcs are among them, for the grinder."""
    shape = PROFILES[name]
    pieces = outline_pieces(shape)
    found = coordinates(pieces, shape.lobes, 181)
    fine = polyline(pieces, 0.002)
    assert max(np.min(np.abs(fine - point)) for point in found.point[::7]) < 0.0011
    share = sum(piece.length for piece in pieces) / shape.lobes
    assert found.along[-1] - found.along[0] == pytest.approx(share, rel=1e-12)
    assert np.max(np.diff(found.along)) <= share / 180 * (1 + 1e-9)
    assert np.min(np.diff(found.along)) > 1e-9
    assert np.abs(np.angle(found.point[[0, -1]])) == pytest.approx(np.pi / shape.lobes, abs=1e-7)
    assert abs(found.point[np.argmin(np.abs(found.along))].imag) < 1e-9
    np.testing.assert_allclose(found.point, np.conj(found.point[::-1]), atol=1e-6)
    assert np.abs(found.normal) == pytest.approx(1)
    assert found.normal[len(found.point) // 2] == pytest.approx(1, abs=1e-9)
    # Chord between the neighbours, on smooth stretches.
    chord = found.point[2:] - found.point[:-2]
    slope = np.abs(np.imag(-1j * chord / np.abs(chord) / found.normal[1:-1]))
    assert np.median(slope) < 2e-3
    ends = np.array([piece.start for piece in pieces if isinstance(piece, Arc)])
    for end in ends[np.abs(np.angle(ends)) < np.pi / shape.lobes - 1e-6]:
        assert np.min(np.abs(found.point - end)) < 1e-9


STATED = {
    "drawing.tolerance_mm": "0.02",
    "drawing.title_block": "{Title: Blower rotor, Material: EN-GJS-500-7, General: ISO 2768-mK, "
    "Number: '4711', By: '%%c</script>^J'}",
}


def test_title_block_states_the_config(tmp_path):
    """The command writes texts, scene and table into the DXF; SVG and coordinates beside it."""
    given = [part for key, text in STATED.items() for part in ("--set", f"{key}={text}")]
    place = tmp_path / "run"
    assert command.main([CONFIG, "-o", str(place), "--no-figures", *given]) == 0
    assert (place / "rotor.svg").is_file()
    assert "outer radius 45.102855 mm" in (place / "rotor.dxf").read_text()
    space = ezdxf.readfile(place / "rotor.dxf").modelspace()
    assert {entity.dxf.text for entity in space.query("TEXT")} >= {
        "Blower rotor", "EN-GJS-500-7", "0.02 mm (ISO 1101)", "ISO 2768-mK", "4711",
        "3000 rpm, 4.775 N m, backlash 0.1 mm, clearance 0 mm", "66 mm",
        "% %c</script>^ J", "45.1029", "normal, deg",
    }  # fmt: skip
    rows = np.genfromtxt(place / "rotor_points.csv", delimiter=",", names=True)
    assert len(rows) >= 361
    assert np.max(np.hypot(rows["x_mm"], rows["y_mm"])) == pytest.approx(45.102855, abs=1e-6)
    assert rows["angle_deg"][0] == pytest.approx(-60, abs=1e-6)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("drawing.title_block={Material: 1.4301}", "quotes"),
        ("drawing.title_block={Title: " + 61 * "x" + "}", "at most 60 characters"),
        ("drawing.title_block={Title: ''}", "one line"),
        ("drawing.tolerance_mm=-1", "drawing.tolerance_mm"),
        ("drawing.revision=A", "title_block"),
        ("drawing.material=steel", "title_block"),
        ("drawing.colour=red", "drawing"),
    ],
)
def test_title_block_is_checked(override, words):
    assert words in refusal(load, CONFIG, [override])
