"""Tests of outline files: one-line messages for malformed files, joining, conventions of CAD."""

import dataclasses
import os
import random
import re

import ezdxf
import numpy as np
import pytest
from ezdxf import units
from hypothesis import given
from hypothesis import strategies as st

from rootsopt.measured.fit import imported
from rootsopt.measured.loop import Loop, signed_area
from rootsopt.measured.reading import Sought, read, untangled
from tests.fuzz import outlines
from tests.standins import fault_of, refusal

T = np.linspace(0, 2 * np.pi, 60, endpoint=False)
ROTOR = (40 + 8 * np.cos(3 * T)) * np.exp(1j * T)


def drawn(path, draw, version="R2010", units=units.MM, fmt="asc", **how):
    path.write_bytes(
        outlines.drawing(lambda document: draw(document.modelspace()), version, units, fmt)
    )
    return read(path, **how)


def line(space, start, stop):
    space.add_line((start.real, start.imag), (stop.real, stop.imag))


def lines(space, z, order=None):
    for k in range(len(z)) if order is None else order:
        line(space, *(z[k], z[(k + 1) % len(z)])[:: 1 if k % 2 else -1])


def polyline(z, kind="add_lwpolyline"):
    return lambda space: getattr(space, kind)([(p.real, p.imag) for p in z], close=True)


def fault(path, data):
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return refusal(lambda: imported(read(path), 3, 33.0, 0.0))


@given(seed=st.integers(0), smoothing=st.sampled_from([0.0, 1e-6, 1e-3, 10.0]))
def test_damaged_files_are_answered(tmp_path_factory, seed, smoothing):
    """They give a profile or a message of one line, and no other output."""
    data, ending = outlines.malformed(random.Random(seed))
    path = tmp_path_factory.getbasetemp() / f"damaged{ending}"
    path.write_bytes(data)
    assert fault_of(lambda: imported(read(path), 3, 33.0, smoothing)) is None


def test_undamaged_files_are_read(tmp_path):
    """They are accepted, so that random ones test the damage."""
    for name, data in outlines.good().items():
        (tmp_path / name).write_bytes(data)
        area = abs(signed_area(read(tmp_path / name).points))
        assert area == pytest.approx(3960 if "ee" in name else 3900, rel=0.1), name


@pytest.mark.parametrize(
    ("data", "message"),
    {
        "empty": ("", "is empty"),
        "blank": (" \n\n", "is empty"),
        "comments": ("# x\n# y\n", "has none"),
        "header alone": ("x_mm,y_mm\n", "has 0"),
        "long field": ("1," + "9" * 10_000_000, "line 1: must have at most 100000 characters"),
        "quoted field": ('1,"' + "9" * 90_000, "line 1: must hold x and y|larger than field limit"),
        "long text field": ("x,y\n" + "a" * 90_000 + ",1\n", r"line 2: .*a \.\.\. a"),
        "columns": ("x,y\n" + "1," * 5000, r"has 1; add the rest"),
        "zero byte": ("1,2\n3,\0\n", "line 2: must be text, but has a zero byte"),
        "latin 1": (b"x,y\n1,\xe9\n", "must be UTF-8 text, but is not at byte 6"),
        "nan": ("1,2\nnan,3\n", "line 2: must hold x and y in mm, but is 'nan, 3'"),
        "underscore": ("1,2\n1_0,3\n", "line 2: must hold"),
        "ragged": ("1,2\n3\n", "line 2: must hold x and y in mm, but is '3'"),
        "one place": ("1,2\n" * 9, "all its points are in one place"),
        "huge": ("1e300,0\n0,1e300\n-1e300,0\n0,-1e300\n", "measures 1e\\+300 mm"),
        "tiny": ("1e-300,0\n0,1e-300\n-1e-300,0\n0,0\n", "measures 2e-300 mm"),
        "error of a spreadsheet": (
            "x,y\n1,2\n#N/A,3\n",
            "line 3: must hold x and y in mm, but is '#N/A, 3'",
        ),
        "row that ends early": (
            "x_in;y_in\n1;2\n1,5;\n",
            "line 3: must hold x and y in inch, but is '1,5, '",
        ),
        "division by zero": ("x,y\n1,2\n1,#DIV/0!\n", "line 3: must hold x and y"),
        "missing number": ("x,y\n1,2\n,\n3,NaN\n", "line 4: must hold x and y"),
        "commas twice": (
            "12,5,33,0\n12,7,32,5\n11,33,1\n",
            "must separate columns by another character",
        ),
        "two units": (
            "x_mm,y_in\n1,2\n",
            "must state no unit of length or one of mm, .* 'x_mm, y_in'",
        ),
        "unknown unit": ("x [ft],y [ft]\n1,2\n", "but is 'x \\[ft\\], y \\[ft\\]'"),
        "polar, twice around": (
            "r,theta\n1,2\n3,90\n",
            "polar angles must go round once, .* but range over 88",
        ),
    }.values(),
)
def test_malformed_tables(tmp_path, data, message):
    text = fault(tmp_path / "points.csv", data)
    assert re.search(message, text), text


@pytest.mark.parametrize(
    ("split", "comma", "header", "encoding"),
    [
        (";", True, "x_mm,y_mm", "utf-8"),
        ("\t", True, "X [mm],Y [mm]", "utf-16"),
        (",", False, '"x","y"', "utf-8-sig"),
        (";", False, "Größe,Wert", "utf-8"),
        (";", False, "", "utf-8"),
        ("\t", False, "name", "utf-8"),
        (" ", False, "x_mm,y_mm", "utf-8"),
        *((split, True, "", "utf-8") for split in ";\t "),
    ],
)
def test_tables_of_spreadsheets(tmp_path, split, comma, header, encoding):
    data = outlines.table(ROTOR, split, comma, header).decode() + 2 * split
    (tmp_path / "points.csv").write_bytes(data.replace("\n", "\r\n").encode(encoding))
    assert read(tmp_path / "points.csv").points == pytest.approx(ROTOR, abs=1e-8)


def test_what_is_no_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "device.csv").symlink_to("/dev/zero")
    for name in ("pipe", "folder", "device"):
        message = refusal(read, tmp_path / f"{name}.csv")
        assert re.search(f"{name}.csv': is a {name}; give .* an outline", message)
    assert "can be read" in refusal(read, tmp_path / "a\0b.csv")
    (tmp_path / "large.dxf").touch()
    os.truncate(tmp_path / "large.dxf", 10**12)
    assert "at most 50 MB" in refusal(read, tmp_path / "large.dxf")


def spline(**changes):
    valid = {
        "control_points": [(0, 0), (1, 2), (3, 1), (4, 0)],
        "knots": [0.0] * 4 + [1.0] * 4,
    }

    def draw(space):
        added = space.add_spline(degree=3)
        for key, value in (valid | changes).items():
            setattr(added, key, value)

    return draw


ENTITIES = {
    "arc of no radius": (lambda s: s.add_arc((0, 0), 0, 0, 90), "ARC .* radius above 0, but has 0"),
    "huge arc": (lambda s: s.add_arc((0, 0), 1e300, 0, 90), "number of ARC must be finite"),
    "nan arc": (lambda s: s.add_arc((0, 0), np.nan, 0, 90), "number of ARC must be finite"),
    "nan bulge": (
        lambda s: s.add_lwpolyline([(0, 0, np.nan), (9, 0, 0), (9, 9, 0)], format="xyb"),
        "number of LWPOLYLINE must be finite",
    ),
    "empty polyline": (lambda s: s.add_lwpolyline([], close=True), "has none of them"),
    "one corner": (lambda s: s.add_lwpolyline([(1, 1)], close=True), "have no extent"),
    "text": (lambda s: s.add_text("rotor"), "must hold an outline of LINE, ARC"),
    "gap": (
        lambda s: [s.add_line((0, 0), (1, 0)), s.add_lwpolyline([(1, 0), (1, 1), (0, 0.1)])],
        r"closed within .*widest gap 0.1 mm",
    ),
    "line of no length": (lambda s: s.add_line((1, 1), (1, 1)), "have no extent"),
    "another plane": (
        lambda s: s.add_arc((0, 0), 9, 0, 90, dxfattribs={"extrusion": (1, 0, 0)}),
        "lie in the plane of x and y",
    ),
    "huge drawing": (
        lambda s: [s.add_circle((0, 0), 9), s.add_arc((0, 0), 9e8, 0, 360)],
        "measure 2.*e\\+09 mm",
    ),
    "equal knots": (spline(knots=[1.0] * 8), "equal knots"),
    "falling knots": (spline(knots=[0, 0, 0, 0, 1, 1, 1, 0.5]), "rising order"),
    "few knots": (
        spline(knots=[0, 0, 1, 1]),
        "1 of 1 SPLINE are not valid .*knot value count: 4 < 8",
    ),
    "no weight": (spline(weights=[0.0] * 4), "weights above 0"),
    "two weights": (spline(weights=[1.0, 1.0]), "are not valid .*weight count: 2 != 4"),
    "few points": (
        spline(control_points=[(0, 0), (1, 1)]),
        "are not valid .*control point count: 2 < 4",
    ),
}


@pytest.mark.parametrize("name", ENTITIES)
def test_senseless_entities(tmp_path, name):
    draw, message = ENTITIES[name]
    assert re.search(message, refusal(drawn, tmp_path / "drawing.dxf", draw))


WHOLE = outlines.drawing(lambda document: polyline(ROTOR)(document.modelspace()), "R2010").decode()


def test_damaged_drawings_are_not_read_as_others(tmp_path, capfd):
    """A decimal comma, an unknown unit or a truncated file is rejected; the library would accept
    it."""
    code = "$INSUNITS\n 70\n"
    units = "$INSUNITS must be the code of a length unit (4: mm, 1: inch, 0: none), but is"
    for data, message in (
        (WHOLE.replace("48.0", "48,0"), "a number of LWPOLYLINE must be"),
        (WHOLE[: WHOLE.rindex("ENDSEC")], "end with the mark EOF"),
        ("x,y\n1,2\n", "is not a DXF file"),
        (b"AutoCAD Binary DXF\r\n\x1a\x00" + b"\xff" * 99, "is not a DXF file"),
        *((WHOLE.replace(f"{code}4", code + x), f"{units} {x}") for x in ("99", "-1", "17", "18")),
    ):
        assert message in fault(tmp_path / "drawing.dxf", data)
    assert capfd.readouterr().err == ""


def test_what_the_library_says_stays_inside(tmp_path, caplog):
    odd = WHOLE.replace(" 90\n60\n", " 90\n60.0\n")
    assert odd != WHOLE
    (tmp_path / "drawing.dxf").write_text(odd)
    assert read(tmp_path / "drawing.dxf").points == pytest.approx(ROTOR)
    assert not caplog.records


@pytest.mark.parametrize(
    ("code", "length", "version", "fmt"),
    [
        (1, 25.4, "R2010", "asc"),
        (2, 304.8, "R2010", "asc"),
        (8, 2.54e-5, "R2010", "asc"),
        (9, 0.0254, "R2010", "asc"),
        (14, 100.0, "R2010", "asc"),
        (21, 1.2e6 / 3937, "R2010", "asc"),
        (0, 1.0, "R12", "asc"),
        (0, 1.0, "R2000", "bin"),
        (0, 1.0, "R2018", "bin"),
    ],
)
def test_units_and_versions_of_drawings(tmp_path, code, length, version, fmt):
    draw = polyline(ROTOR / length, "add_polyline2d" if version == "R12" else "add_lwpolyline")
    loop = drawn(tmp_path / "drawing.dxf", draw, version, units=code, fmt=fmt)
    assert loop.points == pytest.approx(ROTOR, abs=1e-9)


def test_entities_seen_from_below(tmp_path):
    """CAD mirrors an arc or a polyline by reversing its normal; its x axis is then reversed."""
    below = {"extrusion": (0, 0, -1)}

    def draw(space):
        space.add_arc((-10, 0), 5, 90, 270, dxfattribs=below)  # Right half of a circle at x = 10.
        space.add_lwpolyline(
            [(-10, 5, 0), (10, 5, -1), (10, -5, 0), (-10, -5, 0)], format="xyb", dxfattribs=below
        )

    loop = drawn(tmp_path / "slot.dxf", draw)
    assert (np.min(loop.points.real), np.max(loop.points.real)) == pytest.approx(
        (-15, 15), rel=1e-4
    )
    assert abs(signed_area(loop.points)) == pytest.approx(200 + 25 * np.pi, rel=1e-3)


def test_splines_are_sampled_on_the_exact_curve(tmp_path):
    """Rational quarters of a circle, one with its degree raised to 12 (the library ends at 10)."""
    quarter, weights = np.array([40, 40 + 40j, 40j]), np.array([1, np.sqrt(0.5), 1])

    def draw(space):
        points, weight = quarter * weights, weights.copy()
        for turn in range(4):
            while turn == 3 and len(weight) < 13:
                share = np.arange(1, len(weight)) / len(weight)
                points, weight = (
                    np.array([x[0], *(share * x[:-1] + (1 - share) * x[1:]), x[-1]])
                    for x in (points, weight)
                )
            spline = space.add_spline(degree=len(weight) - 1)
            spline.control_points = [(z.real, z.imag) for z in points / weight * 1j**turn]
            spline.weights, spline.knots = weight, [0.0] * len(weight) + [2.0] * len(weight)

    loop = drawn(tmp_path / "circle.dxf", draw)
    assert np.abs(loop.points) == pytest.approx(40, abs=1e-11)
    assert np.sum(loop.joints) == 4


def test_blocks(tmp_path):
    """A turned outline in a block is read; entities drawn directly have precedence."""
    document, path = ezdxf.new(units=units.MM), tmp_path / "block.dxf"
    inner, outer = document.blocks.new("ROTOR"), document.blocks.new("SHEET")
    polyline(ROTOR)(inner)
    outer.add_blockref("ROTOR", (0, 0), dxfattribs={"rotation": 90})
    document.modelspace().add_blockref("SHEET", (5, 0))
    document.saveas(path)
    assert read(path).points == pytest.approx(5 + 1j * ROTOR)
    polyline(ROTOR / 2)(document.modelspace())
    document.saveas(path)
    assert read(path).points == pytest.approx(ROTOR / 2)
    inner.add_blockref("SHEET", (0, 0))
    document.saveas(path)
    assert "blocks must be inserted singly" in refusal(read, path)


def test_what_does_not_belong_to_the_outline(tmp_path):
    """Repeated lines, centre lines from the axis or a corner, and a bore of arcs have no effect."""

    def clean(space):
        lines(space, ROTOR)
        lines(space, ROTOR[6::-1], range(6))
        for end in 60 * np.exp(2j * np.pi * np.arange(60) / 60):  # A dial: 60 ends at a place.
            line(space, 0j, end)
        line(space, ROTOR[30], 0j + 90)
        for start in (0, 180):
            space.add_arc((0, 0), 5, start, start + 180)

    loop = drawn(tmp_path / "clean.dxf", clean)
    assert sorted(loop.points, key=np.angle) == pytest.approx(sorted(ROTOR, key=np.angle))
    chord = refusal(drawn, tmp_path / "chord.dxf", lambda s: [clean(s), line(s, *ROTOR[[6, 0]])])
    assert "must not branch, but 3 ends meet at (" in chord


def test_a_gap_is_not_answered_with_the_bore(tmp_path):
    def draw(space):
        lines(space, ROTOR, range(59))
        space.add_arc((0, 0), 5, 0, 180)
        space.add_arc((0, 0), 5, 180, 360)

    gap = f"enclose more than any .* a gap of {abs(ROTOR[59] - ROTOR[0]):.4g} mm at"
    assert re.search(gap, refusal(drawn, tmp_path / "gap.dxf", draw))


def test_joints_of_a_clockwise_drawing():
    """Corners and jumps of curvature keep their places if a loop is reversed.

    The rotor has joints on one flank of every lobe. Joints in the original order would lie on the
    other flank."""
    z = outlines.points("cic", 60)
    joints = np.zeros(len(z), bool)
    joints[[k * len(z) // 3 + j for k in range(3) for j in (37, 58, 91)]] = True
    z, joints = np.roll(z, -17), np.roll(joints, -17)
    found, checks = imported(Loop(z, joints), 3, 33.0, 0.0)
    turned, others = imported(Loop(z[::-1], joints[::-1]), 3, 33.0, 0.0)
    assert (checks.reversed, others.reversed) == (False, True)
    for name in ("crown", "valley"):
        for part in ("node", "value", "slope"):
            one, other = (np.asarray(getattr(getattr(x, name), part)) for x in (found, turned))
            assert other == pytest.approx(one, abs=1e-12)


@pytest.mark.parametrize(
    ("smoothing", "words"), [(1e-4, "needs more than 500 knots"), (10.0, "at most 0.02 of the")]
)
def test_smoothing_that_does_not_fit_the_scatter(smoothing, words, capfd):
    """Too little smoothing is rejected: fitting would take minutes, and the curve would follow the
    noise."""
    z = outlines.points("cic", 300)
    z = z + np.random.default_rng(0).normal(0, 1e-3, (len(z), 2)) @ [1, 1j]
    assert words in refusal(imported, Loop(z, np.zeros(len(z), bool)), 3, 33.0, smoothing)
    assert capfd.readouterr().err == ""


SOUGHT = Sought(3, 33.0)
EE = outlines.epicycloid(3, 33.0, 480)


def rectangle(space, width, height):
    corners = [(x * width / 2, y * height / 2) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    space.add_lwpolyline(corners, close=True)


def title_block(space):
    for x in (-90, 40, 65, 90):
        lines(space, np.array([x - 70j, x - 60j, x - 50j]), range(2))
    for y in (-70, -60, -50):
        lines(space, np.array([-90, 40, 65, 90]) + 1j * y, range(3))
    lines(space, np.array([-90 - 50j, -90 + 70j, 90 + 70j, 90 - 50j]), range(3))


SURROUNDINGS = {
    "frame": lambda s: rectangle(s, 130, 90),
    "square": lambda s: rectangle(s, 140, 140),
    "circle of arcs": lambda s: [s.add_arc((0, 0), 60, a, a + 180) for a in (0, 180)],
    "housing": lambda s: [s.add_arc((0, 0), 44.2, 42, 318), s.add_arc((66, 0), 44.2, 222, 138)],
    "closed housing": lambda s: s.add_lwpolyline(
        [(33, 29.4, 3.0), (33, -29.4, 3.0)], format="xyb", close=True
    ),
    "title block": title_block,
    "second rotor": lambda s: polyline(66 - EE)(s),
    "dimension and text": lambda s: [
        s.add_text("ROTOR"),
        s.add_linear_dim((0, 60), (-44, 0), (44, 0)).render(),
        s.add_lwpolyline([(-50, 60), (50, 60), (50, 75), (-50, 75)], close=True),
    ],
    "open square": lambda s: lines(s, 70 * np.array([1 + 1j, -1 + 1j, -1 - 1j, 1 - 1j]), range(3)),
}


@pytest.mark.parametrize("name", SURROUNDINGS)
def test_the_rotor_is_told_from_what_is_drawn_around_it(tmp_path, name):
    """The larger loops have no lobes, or another place or size; the choice is reported."""
    path = tmp_path / "drawing.dxf"
    loop = drawn(path, lambda s: [SURROUNDINGS[name](s), polyline(EE)(s)], sought=SOUGHT)
    assert loop.points == pytest.approx(EE, abs=1e-9)
    assert all("the 3-lobed one at (0, 0) mm is read" in note for note in loop.notes)


def test_one_of_several_rotors_is_chosen_by_its_centre(tmp_path):
    path = tmp_path / "pair.dxf"
    message = refusal(
        drawn, path, lambda s: [polyline(z)(s) for z in (EE - 33, 33 - EE)], sought=SOUGHT
    )
    assert re.search(r"holds 2 elsewhere, at .*`profile.outline_center` = \[", message)
    for center, points in ((-33.0, EE - 33), (33.0, 33 - EE)):
        chosen = dataclasses.replace(SOUGHT, center=(center, 0.0))
        assert read(path, sought=chosen).points == pytest.approx(points, abs=1e-9)
    two = refusal(drawn, path, lambda s: [polyline(EE * k)(s) for k in (1, 0.98)], sought=SOUGHT)
    assert "holds 2 at the axis, with outer radii of 43.996 and 43" in two
    rows = [f"{z.real:.9f},{z.imag:.9f}" for z in [*EE, EE[0], *(66 - EE), 66 - EE[0]]]
    (tmp_path / "pair.csv").write_text("\n".join(["x_mm,y_mm", *rows]))
    for center, points in ((None, EE), ((66.0, 0.0), 66 - EE)):
        found = read(tmp_path / "pair.csv", sought=Sought(3, 33.0, center))
        assert found.points == pytest.approx(points, abs=1e-8)


@pytest.mark.parametrize("gap", [1e-5, 3e-4, 1.8e-3, 1e-2])
@pytest.mark.parametrize("framed", [False, True])
def test_ends_that_miss_are_joined_or_the_key_is_named(tmp_path, gap, framed):
    """The value in the message reads the file; gaps are closed without a bend at their ends."""

    def draw(space):
        for k in range(12):  # A polyline per half flank, each shifted by half the gap.
            part = np.append(EE, EE[0])[40 * k : 40 * k + 41] + np.exp(1j * k) * gap / 2
            space.add_lwpolyline([(z.real, z.imag) for z in part])
        if framed:
            rectangle(space, 130, 90)

    path, join = tmp_path / "gap.dxf", 1e-3
    if gap > join:
        told = r"widest gap is ([\d.e-]+) mm, at \(.*`profile.outline_join_mm` = ([\d.e-]+),"
        said = re.search(told, refusal(drawn, path, draw, sought=SOUGHT))
        widest, join = map(float, said.groups())
        assert widest < join < 1.1 * widest
    loop = drawn(path, draw, sought=SOUGHT, join=join)
    assert loop.gap[0] <= gap
    assert any("apart were joined" in note for note in loop.notes) == (gap > 1e-4)
    points = loop.points if signed_area(loop.points) > 0 else loop.points[::-1]
    off = np.roll(points, -int(np.argmin(np.abs(points - EE[0])))) - EE
    assert np.max(np.abs(off)) < gap
    assert np.max(np.abs(np.diff(off, append=off[0]))) < gap / 8


HEADERS = {
    "nr;y (mm);x (mm)": (1.0, None),
    "x_in,y_in": (25.4, "lengths are read in inch"),
    "X (inch);Y (inch)": (25.4, "lengths are read in inch"),
    "x [cm]\ty [cm]": (10.0, "lengths are read in cm"),
    "# x_in,y_in": (25.4, "lengths are read in inch"),
    "x;y\nmm;mm": (1.0, None),
    "r, theta": (1.0, "polar coordinates r, theta (deg)"),
    "r_in;phi (rad)": (25.4, "polar coordinates r, theta (rad)"),
    "theta_deg radius_mm": (1.0, "polar coordinates r, theta (deg)"),
}


@pytest.mark.parametrize("header", HEADERS)
@pytest.mark.parametrize("comma", [False, True])
def test_headers_that_state_units_or_polar_coordinates(tmp_path, header, comma):
    length, note = HEADERS[header]
    split = next((c for c in ";\t," if c in header), " ")
    split = ";" if comma and split == "," else split
    columns = EE.real / length, EE.imag / length
    if note and "polar" in note:
        columns = np.abs(EE) / length, np.angle(EE, deg="(deg)" in note)
    columns = columns[:: -1 if header.startswith(("theta", "nr")) else 1]
    columns = [range(len(EE)), *columns] if header.startswith("nr") else columns
    rows = [split.join(f"{v:.12g}" for v in row) for row in zip(*columns, strict=True)]
    rows = [row.replace(".", ",") for row in rows] if comma else rows
    (tmp_path / "points.csv").write_text("\n".join([header.replace(",", split), *rows]))
    loop = read(tmp_path / "points.csv")
    assert loop.points == pytest.approx(EE, abs=1e-8)
    assert bool(loop.notes) == bool(note)
    assert note is None or note in " ".join(loop.notes)


@pytest.mark.parametrize(
    ("lobes", "inset", "count"),
    [(3, 0.2, 1000), pytest.param(4, 0.5, 4000, marks=pytest.mark.long)],
)
def test_swallow_tails_of_an_offset_are_named_and_cut_off(tmp_path, lobes, inset, count):
    """The loops are at the crossings of the pitch circle; without them, the offset is read.

    The message about what is left names the loops and a smoothing, which reads the file."""
    z = outlines.epicycloid(lobes, 33.0, count, inset)
    path = tmp_path / "points.csv"
    path.write_bytes(outlines.table(z))
    loop = untangled(read(path), lobes, 33.0)
    assert np.max(np.abs(np.angle(np.diff(loop.points)[1:] / np.diff(loop.points)[:-1]))) < 2
    (note,) = loop.notes
    assert "small loops (swallow-tails of an offset) at (" in note
    places = [float(x) for x in re.findall(r"\(([-\d.]+) deg, [\d.]+ um long\)", note)]
    off = (np.array(places) * lobes / 180) % 1 - 0.5  # Flanks cross in the middle of a half lobe.
    assert off == pytest.approx(0, abs=0.03)
    assert abs(signed_area(loop.points)) == pytest.approx(abs(signed_area(z)), rel=1e-6)
    message = refusal(imported, loop, lobes, 33.0, 0.0)
    said = re.search(r"`profile.outline_smoothing_mm` = ([\d.e-]+), with which", message)
    found, _ = imported(loop, lobes, 33.0, float(said[1]))
    assert float(found.outer_radius) == pytest.approx(33e-3 * (1 + 1 / lobes) - 1e-3 * inset)


def test_outlines_that_cross_themselves_widely_are_refused():
    loop = Loop(outlines.epicycloid(3, 33.0, 1500, 6.0), np.zeros(1500, bool))
    message = refusal(untangled, loop, 3, 33.0)
    assert re.search(r"does not cross itself, .* loops .* at \(.* deg, .* um", message)
