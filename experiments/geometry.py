"""Area and inertia of every profile family against its own outline.

    python experiments/geometry.py [-o DIR] [--draws 2000] [--seed 0]

Draws designs of each family and number of lobes over the whole range that a config allows, keeps
the sound ones, and compares `rootsopt.profiles.geometry` with polygons through points of the
outline. The reference uses positions alone, neither arc lengths nor quadrature: polygons at four
spacings, each half the last, extrapolated (Romberg). Writes geometry.csv, a row for each family and
number of lobes with the greatest relative errors and the design that has it.
"""

import argparse
import functools
import sys
from pathlib import Path
from typing import Any

from rootsopt.cli import use_float64

use_float64()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax import lax  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from rootsopt import files  # noqa: E402
from rootsopt.config import FAMILY_KEYS  # noqa: E402
from rootsopt.config.families import family_of, parameters  # noqa: E402
from rootsopt.families import DEG, MM, profile_of  # noqa: E402
from rootsopt.profiles import Curve, FreeForm, geometry  # noqa: E402
from rootsopt.profiles.cic import CIC  # noqa: E402
from rootsopt.profiles.validity import PURE, margins  # noqa: E402

RADIUS_MM = 33.0
LOBES = (2, 3, 4, 5, 6)
FAMILIES = tuple(family for family in FAMILY_KEYS if family != "outline")
COEFFICIENTS = (3, 8, 24)
"""Sizes of a free form."""
_LEVELS = 4
_SHORT, _SPAN, _WHOLE = 64, 512, 2048
"""Sides of the finest polygon: on an interval of a curve, a knot span of a free form, a segment."""
_GRADED = 5
"""Power with which points crowd at both ends of a segment, where an outline may have a root."""
_LONGEST_INVOLUTE = 1.02
"""Length of an involute that a config accepts, as a share of the longest."""
_ROUNDING = 1e-9
"""Margin, relative to its scale, that counts as 0."""


def by_polygons(profile):
    """Area (m²) and polar moment of area (m⁴) enclosed by the outline, from positions alone, and an
    estimate of the greater of their relative errors."""
    x = np.arange(_SHORT + 1) / _SHORT
    if isinstance(profile, Curve):
        ends = profile.node
    elif isinstance(profile, FreeForm):
        x = np.arange(_SPAN + 1) / _SPAN
        ends = jnp.append(0.0, jnp.stack([s.start for s in profile.stretches()[1:]]))
        ends = jnp.append(ends, profile.pitch_normal)
    else:
        x = np.arange(_WHOLE + 1) / _WHOLE
        x = x**_GRADED / (x**_GRADED + (1 - x) ** _GRADED)
        segments = profile.segments()
        ends = jnp.stack([segments[0].start, *(s.stop for s in segments)])
    nu = ends[:-1, None] + jnp.diff(ends)[:, None] * jnp.asarray(x)
    levels = jnp.zeros((_LEVELS, 2))
    for sign, point in ((1.0, profile.addendum), (-1.0, profile.dedendum)):
        # The dedendum is run through from the root up, which is clockwise.
        places = profile.position(point(nu))
        levels += sign * jnp.stack([_polygon(places[:, :: 2**k]) for k in range(_LEVELS)])
    before = after = levels
    for power in range(1, _LEVELS):
        before, after = after, (4.0**power * after[:-1] - after[1:]) / (4.0**power - 1)
    rest = jnp.max(jnp.abs(after[0] / before[0] - 1))
    return 2 * profile.lobes * after[0], rest


def _polygon(places):
    """∫dA and ∫r² dA of the triangles between the axis and the sides of open polygons."""
    here, there = places[:, :-1], places[:, 1:]
    cross = here[..., 0] * there[..., 1] - here[..., 1] * there[..., 0]
    square = jnp.sum(here**2 + here * there + there**2, axis=-1)
    return jnp.stack([jnp.sum(cross) / 2, jnp.sum(cross * square) / 12])


def draw(family: str, lobes: int, count: int, random: np.random.Generator, size: int = 8):
    """`count` designs of a family in config units, not all of them sound: half within the usual
    bounds, the others as far as a config allows, crowding towards the limits. `size`: number of
    coefficients of a free form."""
    usual, wide = [np.zeros((count, 0))], [np.zeros((count, 0))]
    half = 90.0 / lobes
    for key in FAMILY_KEYS[family]:
        shape = (count, size) if key == "coefficients" else (count, 1)
        share = random.random(shape)
        low, high = parameters()[key].usually(RADIUS_MM, lobes)
        usual.append(low + (high - low) * share)
        share = random.random(shape)
        if key == "coefficients":
            # Around an epicycloid, which is constant; many of these are sound.
            level = random.uniform(-0.5, 1.0, (count, 1))
            spread = 10.0 ** random.uniform(-3, 0, (count, 1))
            wide.append(np.clip(level + spread * (2 * share - 1), -1.0, 1.0))
        elif key == "tip_arc_angle_deg":
            wide.append(min(half, 45.0) * _crowded(share, 1e-4))
        elif key.endswith("_deg"):
            wide.append((180.0 if key == "tip_arc_turn_deg" else 90.0) * _crowded(share, 1e-3))
        elif key == "trochoid_ratio":
            wide.append(10.0 ** (4 * share - 3))
        else:
            wide.append(RADIUS_MM * 3.0 * _crowded(share, 1e-4))
    first = random.random((count, 1)) < 0.5
    design = np.where(first, np.hstack(usual), np.hstack(wide))
    keys = FAMILY_KEYS[family]
    if "involute_length_mm" in keys:
        # As a share of the longest one: no other length can be made.
        angle, length = keys.index("pressure_angle_deg"), keys.index("involute_length_mm")
        tip = design[:, 2] if family == "cic" else 0.0
        longest = RADIUS_MM * np.sin(design[:, angle] * DEG) * (half - tip) * DEG
        crowded = _crowded(random.random(count), 1e-6)
        share = np.where(first[:, 0], random.random(count), crowded)
        design[:, length] = longest * share * _LONGEST_INVOLUTE
    return design


def _crowded(share, least):
    """Even shares, made to crowd towards both ends, down to the `least` distance."""
    near = 0.5 * (2 * least) ** (1 - np.abs(2 * share - 1))
    return np.where(share < 0.5, near, 1 - near)


@functools.partial(jax.jit, static_argnums=(0, 1))
def judged(family: str, lobes: int, designs):
    """Whether configs with these designs (n, d) are accepted, (n,)."""
    return lax.map(functools.partial(_sound, family, lobes), designs)


def _sound(family: str, lobes: int, design):
    profile = profile_of(family, lobes, jnp.asarray(RADIUS_MM * MM), design)
    if family_of(family).by_limits:
        alpha, length = design[0] * DEG, design[1]
        tip = design[2] * DEG if family == "cic" else 0.0
        half = jnp.pi / (2 * lobes)
        edge = RADIUS_MM * jnp.sin(alpha)
        longest = edge * (half - tip) * _LONGEST_INVOLUTE
        shortest = edge * (half - tip - 2 * alpha) + 1e-6 * RADIUS_MM
        uncut = edge * jnp.tan(alpha) * (1 + 1e-9)
        good = (length <= longest) & (length >= shortest) & (length <= uncut) & (length > 0)
        assert isinstance(profile, CIC)
        return good & (profile.arc_radius > 0) & (profile.arc_center_radius > 0)
    good = jnp.ones((), bool)
    for name, value in margins(profile)._asdict().items():
        if name not in family_of(family).inherent:
            scale = 1.0 if name in PURE else RADIUS_MM * MM
            good &= value >= -_ROUNDING * scale
    if family == "arcs_epicycloid":
        good &= design[2] >= 0.002 * RADIUS_MM
    return good


@functools.partial(jax.jit, static_argnums=(0, 1))
def compared(family: str, lobes: int, designs):
    """Relative errors of area and polar moment of designs (n, d) in config units, and the
    reference's own, (n, 3)."""

    def compare(design):
        profile = profile_of(family, lobes, jnp.asarray(RADIUS_MM * MM), design)
        truth, rest = by_polygons(profile)
        shape = geometry(profile)
        errors = jnp.abs(jnp.stack([shape.area, shape.polar_area_moment]) / truth - 1)
        return jnp.append(errors, rest)

    return lax.map(compare, designs)


def errors(family: str, lobes: int, count: int, random: np.random.Generator, size: int = 8):
    """The sound designs (n, d) among `count` drawn ones, and what they `compared` to (n, 3)."""
    # A family without parameters has one design.
    designs = draw(family, lobes, count if FAMILY_KEYS[family] else 1, random, size)
    kept = designs[np.asarray(judged(family, lobes, designs))]
    if not len(kept):
        return kept, np.zeros((0, 3))
    # One size for all, so that a family is compiled once.
    padded = np.concatenate([kept, np.repeat(kept[:1], len(designs) - len(kept), axis=0)])
    return kept, np.asarray(compared(family, lobes, padded))[: len(kept)]


def study(draws: int, seed: int, families=FAMILIES, lobes=LOBES, say=lambda row: None):
    """A row for each family, size and number of lobes."""
    random = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    for family in families:
        for size in COEFFICIENTS if family == "free_form" else (0,):
            for number in lobes:
                designs, found = errors(family, number, draws, random, size)
                row: dict[str, Any] = {
                    "family": f"{family} {size}" if size else family,
                    "lobes": number,
                    "sound": len(designs),
                }
                names = "area", "polar_moment", "reference"
                for k, name in enumerate(names):
                    row[f"{name}_error"] = float(np.max(found[:, k])) if len(found) else np.nan
                worst = int(np.argmax(np.max(found[:, :2], axis=1))) if len(found) else None
                keys = FAMILY_KEYS[family]
                values = [] if worst is None else designs[worst]
                row["worst_design"] = " ".join(f"{x:.9g}" for x in values) if len(keys) else ""
                rows.append(row)
                say(row)
    return rows


def main() -> int:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("results/geometry"))
    parser.add_argument("--draws", type=int, default=2000, help="designs drawn of each kind")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    console = Console()
    rows = study(options.draws, options.seed, say=lambda row: console.print(row, soft_wrap=True))
    folder = files.ResultFolder(options.output)
    folder.write_csv("geometry.csv", {key: [row[key] for row in rows] for key in rows[0]})
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(f"{x:.3g}" if isinstance(x, float) else str(x) for x in row.values()))
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
