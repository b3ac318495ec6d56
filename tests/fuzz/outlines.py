"""Malformed outline files for reader and fit.

Good files of this program are damaged: bytes, headers, cells, encodings, and the outline itself."""

import functools
import io
import random
from pathlib import Path

import ezdxf
import numpy as np

from rootsopt.config import load
from rootsopt.profiles import CIC, EE, outline
from rootsopt.scene import Scene, design_vector
from rootsopt.view.figures.cad import dxf_bytes
from rootsopt.view.figures.drawing import Drawing

_R = 33.0
NUMBERS = """nan NaN -nan inf -inf 1e308 -1e308 1e-308 1e400 0 -0 -1 1 2 3 99 255 1e9 1e12 -1e9
2147483648 -9223372036854775809 123456789012345678901234567890 1,5 1.5.2 1_0 0x10 1e"""
WORDS = [
    "",
    " ",
    "\0",
    "9" * 400,
    "x" * 5000,
    "é",
    "\ud800",
    "1 2",
    "- 5",
    "%s",
    "\t",
    "abc",
    "#",
    "{",
]
BAD = [*NUMBERS.split(), *WORDS]


@functools.cache
def points(family: str, count: int = 30) -> np.ndarray:
    """Return the outline (mm, x + iy) of a good rotor, without repeating the first point."""
    rotor = CIC(3, 0.033, 0.6358, 8.5e-3, 0.0698) if family == "cic" else EE(3, 0.033)
    return np.asarray(outline(rotor, count))[:-1] @ [1, 1j] * 1e3


def epicycloid(lobes: int, radius: float, count: int, inset: float = 0.0) -> np.ndarray:
    """Return EE (mm, x + iy) by its formula, tip on +x, even in the rolling angle.

    `inset`: distance (mm) by which the curve is moved inwards, loops included."""
    t = (np.arange(count) + 0.5) * 2 * np.pi / count
    small, out = radius / (2 * lobes), np.floor(t * lobes / np.pi) % 2 == 0
    side = np.where(out, 1.0, -1.0)
    ratio = 2 * lobes * side + 1
    turning = small * np.exp(1j * ratio * t)
    z = (radius + side * small) * np.exp(1j * t) - side * turning
    along = 1j * ((radius + side * small) * np.exp(1j * t) - side * ratio * turning)
    z = z + 1j * along / np.abs(along) * inset
    return z * np.exp(-0.5j * np.pi / lobes)


def table(z: np.ndarray, split: str = ",", comma: bool = False, header: str = "x_mm,y_mm") -> bytes:
    """Return a CSV file of points."""
    rows = [split.join(f"{v:.10g}" for v in (p.real, p.imag)) for p in [*z, *z[:1]]]
    rows = [row.replace(".", ",") for row in rows] if comma else rows
    return "\n".join([header.replace(",", split), *rows, ""]).encode()


def drawing(draw, version: str = "R2000", units: int = 4, fmt: str = "asc") -> bytes:
    """Return a DXF file with what `draw` adds to a document, the same bytes each time."""
    ezdxf.options.write_fixed_meta_data_for_testing = True
    document = ezdxf.new(version, units=units)
    draw(document)
    data = io.BytesIO() if fmt == "bin" else io.StringIO()
    document.write(data, fmt=fmt)
    found = data.getvalue()
    return found if fmt == "bin" else document.encode(found)


def lines(z: np.ndarray, random: random.Random):
    """Return a function that draws loose lines in any order and direction."""

    def draw(document):
        ends = list(zip(z, np.roll(z, -1), strict=True))
        random.shuffle(ends)
        for pair in ends:
            start, stop = random.sample(pair, 2)
            document.modelspace().add_line((start.real, start.imag), (stop.real, stop.imag))

    return draw


def polyline(z: np.ndarray, old: bool = False, block: bool = False):
    """Return a function that draws a closed polyline with small bulges, optionally in a block."""

    def draw(document):
        space = document.blocks.new("ROTOR") if block else document.modelspace()
        rows = [(p.real, p.imag, 1e-4 * (k % 7)) for k, p in enumerate(z)]
        add = space.add_polyline2d if old else space.add_lwpolyline
        add(rows, format="xyb", close=True)
        if block:
            document.modelspace().add_blockref("ROTOR", (0, 0))

    return draw


@functools.cache
def good() -> dict[str, bytes]:
    config = load(Path(__file__).parents[2] / "configs" / "cic_drawn.yaml")
    profile = Scene.from_config(config).profile(design_vector(config))
    text = io.StringIO(dxf_bytes(Drawing.of(config, profile, {})).decode())
    entities = list(ezdxf.read(text).modelspace())
    chance = random.Random(0)

    def own(document):
        for entity in entities:
            if entity.dxftype() != "DIMENSION":  # ezdxf cannot copy these between documents.
                document.modelspace().add_foreign_entity(entity)

    cic, ee = points("cic"), points("ee")
    return {
        "cic.csv": table(cic),
        "ee.csv": table(ee, ";", comma=True),
        "tabs.txt": table(points("cic", 60), "\t"),
        "own.dxf": drawing(own),  # Of R2000: later ones list their classes in any order.
        "lines.dxf": drawing(lines(cic[::2], chance)),
        "bulges.dxf": drawing(polyline(cic)),
        "r12.dxf": drawing(polyline(ee, old=True), "R12", units=0),
        "block.dxf": drawing(polyline(cic, block=True)),
        "binary.dxf": drawing(polyline(cic), fmt="bin"),
        "inches.dxf": drawing(lines(ee[::3] / 25.4, chance), units=1),
    }


def damaged_bytes(data: bytes, chance: random.Random) -> bytes:
    """Return the data with bytes changed, lost, repeated or inserted."""
    for _ in range(chance.choice([1, 1, 2, 5, 40])):
        at = chance.randrange(len(data) + 1)
        size = chance.choice([1, 1, 2, 8, 100, len(data) // 3])
        piece = chance.choice(
            [chance.randbytes(size), b"", data[at : at + size] * 2, b"\0" * size, b"9" * size]
        )
        data = data[:at] + piece + data[at + size :]
        if chance.random() < 0.15:
            data = data[: chance.randrange(len(data) + 1)]
    return data


def damaged_cells(data: bytes, chance: random.Random) -> bytes:
    """Return the data with cells, rows, separators, headers, marks or the encoding changed."""
    rows = data.decode().splitlines()
    for _ in range(chance.choice([1, 1, 2, 10])):
        k = chance.randrange(len(rows))
        split = next((c for c in ";\t," if c in rows[k]), " ")
        cells = rows[k].split(split)
        match chance.randrange(9):
            case 0 | 1:
                cells[chance.randrange(len(cells))] = chance.choice(BAD)
                rows[k] = split.join(cells)
            case 2:
                rows[k] = split.join(cells * chance.choice([2, 1000]))
            case 3:
                rows[k] = cells[0]
            case 4:
                rows[k] = rows[k].replace(split, chance.choice([" ", ";", "|", "\t\t", '","', ""]))
            case 5:
                names = [
                    "x;y",
                    "y,x",
                    "nr,x [mm],y [mm]",
                    '"x_mm","y_mm"',
                    "x_mm",
                    "# x",
                    "a\tb",
                    "",
                ]
                rows[0] = chance.choice(names)
            case 6:
                rows[k] = '"' + rows[k]
            case 7:
                rows.insert(k, rows[k])
            case 8:
                rows[k] += chance.choice(["9" * 300_000, "\0", "\x1c", "\u2028", "  ", ",,,", "#"])
    text = "\n".join(rows)
    if chance.random() < 0.2:
        return text.encode(chance.choice(["utf-16", "utf-16-le", "utf-8-sig", "utf-32"]), "replace")
    return text.encode("utf-8", "replace")


def wrong_outline(chance: random.Random) -> np.ndarray:
    """Return readable points that are not a rotor, or a strange one."""
    z = points(chance.choice(["cic", "ee"]), chance.choice([4, 15, 30, 60])).copy()
    noise = np.random.default_rng(chance.randrange(1 << 30))
    n, k = len(z), chance.randrange(len(z))
    size = 10.0 ** chance.choice([-300, -12, -6, -3, -2, -1, 1, 2, 3, 6, 12, 150, 300])
    changes = [
        lambda: z * size,
        lambda: z * 0 + 33,
        lambda: z.real + 0j,
        lambda: z[[0, n // 2]],
        lambda: z[: chance.randrange(12)],
        lambda: np.where(np.arange(n) == k, z * chance.choice([0, -1, 1e-9, 1.2, 3, 1e4]), z),
        lambda: np.roll(z, k)[:: chance.choice([-1, 2, 7, 31])],
        lambda: np.concatenate([z, z]),
        lambda: np.repeat(z, chance.choice([2, 5])),
        lambda: np.sort_complex(z),
        lambda: noise.permutation(z),
        lambda: (
            z + 10.0 ** chance.uniform(-9, 1) * (noise.normal(size=n) + 1j * noise.normal(size=n))
        ),
        lambda: z + chance.choice([1, 5, 40]) * np.exp(1j * chance.uniform(0, 7)),
        lambda: np.abs(z) * np.exp(chance.choice([-1, 0.5, 2, 3]) * 1j * np.angle(z)),
        lambda: z.real * chance.choice([0, 1e-9, 0.9, 2]) + 1j * z.imag,
        lambda: _R * np.exp(2j * np.pi * np.arange(n) / n),
        lambda: np.round(z, chance.choice([0, 1, 2])),
        lambda: z * (1 + 0.3 * np.sin(np.angle(z) * chance.choice([1, 2, 3, 6, 50]))),
        lambda: np.where(np.abs(z) > chance.uniform(20, 45), chance.uniform(0.8, 1.2) * z, z),
        lambda: z * np.exp(1j * chance.choice([1e-4, 1e-2]) * (np.abs(z) - _R) ** 2),
        lambda: z + 1e-9 * (np.arange(n) % 2),
        lambda: np.insert(z, k, z[k] + 10.0 ** chance.choice([-12, -9, -7, -5, -3])),
    ]
    with np.errstate(all="ignore"):
        return chance.choice(changes)()


def malformed(chance: random.Random) -> tuple[bytes, str]:
    """Return content and extension of a file."""
    if chance.random() < 0.3:
        z = wrong_outline(chance)
        if chance.random() < 0.3 and 0 < len(z) < 400:
            draw = chance.choice([lines(z, chance), polyline(z), polyline(z, old=True)])
            return drawing(draw, fmt=chance.choice(["asc", "asc", "bin"])), ".dxf"
        return table(z), ".csv"
    name = chance.choice(list(good()))
    kinds = [damaged_bytes] if name.endswith(".dxf") else [damaged_bytes, damaged_cells]
    return chance.choice(kinds)(good()[name], chance), Path(name).suffix
