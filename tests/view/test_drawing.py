"""Dimensions, title block and coordinates of the drawing, read back from the DXF file."""

import csv
import io
from pathlib import Path

import ezdxf
import numpy as np
import pytest

from rootsopt.commands.table import profile as command
from rootsopt.config import load
from rootsopt.errors import InputError
from rootsopt.profiles import geometry
from rootsopt.view.figures.cad import dxf_bytes
from rootsopt.view.figures.drawing import coordinates
from rootsopt.view.figures.pieces import Arc, outline_pieces, polyline
from tests.view.test_export import PROFILES, drawing

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "configs/cic_drawn.yaml"
DRAWN = "cic 2, no land", "cic 3", "cic 3, past the longest", "ee 3"


def parsed(drawn):
    document = ezdxf.read(io.StringIO(dxf_bytes(drawn).decode()))
    audit = document.audit()
    assert not audit.has_errors
    assert not audit.has_fixes
    return document


def texts(document):
    return [entity.dxf.text for entity in document.modelspace().query("TEXT")]


@pytest.mark.parametrize("name", DRAWN)
def test_dimensions_measure_the_rotor(name):
    """DIMENSION entities measure the geometry; the lobe width is that of a polygon."""
    shape = PROFILES[name]
    document = parsed(drawing(shape, bore=12.0))
    measured = {
        entity.dxf.text.split()[-1]: entity.get_measurement()
        for entity in document.modelspace().query("DIMENSION")
    }
    sizes = geometry(shape)
    assert measured["outer"] == pytest.approx(2e3 * float(sizes.outer_radius), abs=1e-9)
    assert measured["root"] == pytest.approx(2e3 * float(sizes.root_radius), abs=1e-9)
    assert measured["pitch"] == pytest.approx(66.0, abs=1e-9)
    assert measured["bore"] == 12.0
    points = polyline(outline_pieces(shape), 0.005)
    lobe = points[(np.abs(np.angle(points)) < np.pi / shape.lobes) & (points.real > 0)]
    upper = lobe[np.argsort(-np.angle(lobe))][::-1]  # from below to above
    upper = upper[upper.imag >= 0]
    rising = np.flatnonzero(np.diff(upper.imag) < 0)
    # From the tip on, y rises to the widest place; without one, the flank is cut at the pitch line.
    width = 2 * upper.imag[rising[0]] if len(rising) else 66 * np.sin(np.pi / (2 * shape.lobes))
    assert measured["lobe"] == pytest.approx(width, abs=2e-5)


@pytest.mark.parametrize("name", DRAWN)
def test_coordinates_lie_on_the_flank(name):
    """Points lie between dense points of the outline, evenly spaced and symmetric.

    Their normals are those of the outline."""
    shape = PROFILES[name]
    pieces = outline_pieces(shape)
    found = coordinates(pieces, shape.lobes, 181)
    fine = polyline(pieces, 0.002)
    for point in found.point[::7]:
        assert np.min(np.abs(fine - point)) < 0.0011
    total = sum(piece.length for piece in pieces)
    assert found.along[-1] - found.along[0] == pytest.approx(total / shape.lobes, rel=1e-12)
    assert np.max(np.diff(found.along)) <= total / shape.lobes / 180 * (1 + 1e-9)
    assert np.abs(np.angle(found.point[[0, -1]])) == pytest.approx(np.pi / shape.lobes, abs=1e-7)
    assert abs(found.point[np.argmin(np.abs(found.along))].imag) < 1e-9
    np.testing.assert_allclose(found.point, np.conj(found.point[::-1]), atol=1e-6)
    assert np.abs(found.normal) == pytest.approx(1)
    assert found.normal[len(found.point) // 2] == pytest.approx(1, abs=1e-9)
    # Chord between the neighbours, on smooth stretches.
    chord = found.point[2:] - found.point[:-2]
    slope = np.abs(np.imag(-1j * chord / np.abs(chord) / found.normal[1:-1]))
    assert np.median(slope) < 2e-3


def test_ends_of_pieces_are_among_the_coordinates():
    """The coordinates contain the ends of all arcs, for the grinder."""
    shape = PROFILES["cic 3"]
    pieces = outline_pieces(shape)
    found = coordinates(pieces, 3, 50)
    ends = [piece.start for piece in pieces if isinstance(piece, Arc)]
    ends = [end for end in ends if abs(np.angle(end)) < np.pi / 3 - 1e-6]
    assert ends
    for end in ends:
        assert np.min(np.abs(found.point - end)) < 1e-9
    assert len(np.unique(np.round(found.along, 9))) == len(found.along)


STATED = {
    "drawing.tolerance_mm": "0.02",
    "drawing.title_block": "{Title: Blower rotor, Material: EN-GJS-500-7, General: ISO 2768-mK, "
    "Number: '4711', By: '%%c</script>^J'}",
}


def test_title_block_states_the_config(tmp_path):
    """The command writes texts, scene and table into the file, and coordinates beside it."""
    given = [part for key, text in STATED.items() for part in ("--set", f"{key}={text}")]
    place = tmp_path / "run"
    assert command.main([str(CONFIG), "-o", str(place), "--no-figures", *given]) == 0
    document = ezdxf.readfile(place / "rotor.dxf")
    found = texts(document)
    for words in (
        "Blower rotor", "EN-GJS-500-7", "0.02 mm (ISO 1101)", "ISO 2768-mK", "4711",
        "3000 rpm, 4.775 N m, backlash 0.1 mm, clearance 0 mm", "66 mm",
        "% %c</script>^ J", "45.1029", "normal, deg",
    ):  # fmt: skip
        assert words in found
    with (place / "rotor_points.csv").open() as file:
        rows = list(csv.DictReader(file))
    points = np.array([[float(row["x_mm"]), float(row["y_mm"])] for row in rows])
    assert len(points) >= 361
    assert np.max(np.hypot(*points.T)) == pytest.approx(45.102855, abs=1e-6)
    assert float(rows[0]["angle_deg"]) == pytest.approx(-60, abs=1e-6)


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
    with pytest.raises(InputError, match=words):
        load(CONFIG, [override])
