"""Compares area and inertia of every profile family with polygons of its own outline.

The study draws random designs of each family and number of lobes over the whole range that a config
allows, and keeps valid designs. It compares `rootsopt.profiles.geometry` with polygons through
points of the outline. This reference needs only positions, neither arc lengths nor quadrature: four
polygons, each with half the spacing of the last, are extrapolated (Romberg).
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from experiments._common.driver import Run
from experiments._common.tables import Row, show
from rootsopt.config.families import families, family_of, parameters
from rootsopt.config.units import DEG, MM
from rootsopt.profiles import Curve, FreeForm, geometry
from rootsopt.profiles.cic import CIC
from rootsopt.profiles.soundness import PURE, margins
from rootsopt.scene.families import profile_of

RADIUS_MM = 33.0
LOBES = (2, 3, 4, 5, 6)
FAMILIES = tuple(family for family in families() if family != "outline")

# Numbers of coefficients for which free forms are drawn.
COEFFICIENTS = (3, 8, 24)

# Families and lobes of a reduced run.
QUICK = ("cic", "ee", "arc"), (2, 3)

# Number of designs drawn per family and number of lobes: in a full and in a reduced run.
DRAWS, QUICK_DRAWS = 1000, 50
_LEVELS = 4

# Number of sides of the finest polygon: per interval of a curve, per knot span of a free form,
# and per segment.
_SHORT, _SPAN, _WHOLE = 64, 512, 2048

# Exponent with which points are concentrated at both ends of a segment, where the outline may
# behave like a square root.
_GRADED = 5

# Longest involute that a config accepts, as a fraction of the longest possible.
_LONGEST_INVOLUTE = 1.02

# Violation of a limit (relative to the limit's scale) below which a design still counts as valid.
_ROUNDING = 1e-9


def by_polygons(profile):
    """Integrate area (m²) and polar moment of area (m⁴) of a profile from positions on its outline.

    Returns area and moment (2,), and an estimate of the larger of their relative errors.
    """
    if isinstance(profile, Curve):
        x, ends = np.arange(_SHORT + 1) / _SHORT, profile.node
    elif isinstance(profile, FreeForm):
        starts = [one.start for one in profile.stretches()[1:]]
        x, ends = np.arange(_SPAN + 1) / _SPAN, jnp.stack([0.0, *starts, profile.pitch_normal])
    else:
        x = np.arange(_WHOLE + 1) / _WHOLE
        x = x**_GRADED / (x**_GRADED + (1 - x) ** _GRADED)
        segments = profile.segments()
        ends = jnp.stack([segments[0].start, *(s.stop for s in segments)])
    nu = ends[:-1, None] + jnp.diff(ends)[:, None] * jnp.asarray(x)
    levels = jnp.zeros((_LEVELS, 2))
    for sign, point in ((1.0, profile.addendum), (-1.0, profile.dedendum)):
        # The dedendum runs upwards from the root, which is clockwise.
        places = profile.position(point(nu))
        levels += sign * jnp.stack([_polygon(places[:, :: 2**k]) for k in range(_LEVELS)])
    before = after = levels
    for power in range(1, _LEVELS):
        before, after = after, (4.0**power * after[:-1] - after[1:]) / (4.0**power - 1)
    return 2 * profile.lobes * after[0], jnp.max(jnp.abs(after[0] / before[0] - 1))


def _polygon(places):
    """Return ∫dA and ∫r² dA over the triangles between the axis and the sides of an open polygon.

    `places`: corners of the polygon (m)."""
    here, there = places[:, :-1], places[:, 1:]
    cross = here[..., 0] * there[..., 1] - here[..., 1] * there[..., 0]
    square = jnp.sum(here**2 + here * there + there**2, axis=-1)
    return jnp.stack([jnp.sum(cross) / 2, jnp.sum(cross * square) / 12])


def draw(family: str, lobes: int, count: int, random: np.random.Generator, size: int = 8):
    """Draw random designs (count, d) of a family, in config units. Some designs may be invalid.

    Half of the designs lie within the usual bounds. The others cover the range that a config
    allows, with a concentration at its limits. `size`: number of coefficients of a free form.
    """
    usual, wide = [np.zeros((count, 0))], [np.zeros((count, 0))]
    half, keys = 90.0 / lobes, family_of(family).keys
    # Greatest value in a config, and least distance from the ends as a fraction of it.
    limits = {"tip_arc_angle_deg": (min(half, 45.0), 1e-4), "tip_arc_turn_deg": (180.0, 1e-3)}
    for key in keys:
        shape = (count, size) if key == "coefficients" else (count, 1)
        low, high = parameters()[key].usually(RADIUS_MM, lobes)
        usual.append(low + (high - low) * random.random(shape))
        share = random.random(shape)
        if key == "coefficients":
            # Around an epicycloid, which has constant coefficients; many of these are valid.
            level = random.uniform(-0.5, 1.0, (count, 1))
            spread = 10.0 ** random.uniform(-3, 0, (count, 1))
            wide.append(np.clip(level + spread * (2 * share - 1), -1.0, 1.0))
        elif key == "trochoid_ratio":
            wide.append(10.0 ** (4 * share - 3))
        else:
            usually = (90.0, 1e-3) if key.endswith("_deg") else (RADIUS_MM * 3.0, 1e-4)
            most, least = limits.get(key, usually)
            wide.append(most * _crowded(share, least))
    first = random.random((count, 1)) < 0.5
    design = np.where(first, np.hstack(usual), np.hstack(wide))
    if "involute_length_mm" in keys:
        # Relative to the longest possible: no longer involute can be made.
        angle, length = keys.index("pressure_angle_deg"), keys.index("involute_length_mm")
        tip = design[:, 2] if family == "cic" else 0.0
        longest = RADIUS_MM * np.sin(design[:, angle] * DEG) * (half - tip) * DEG
        crowded = _crowded(random.random(count), 1e-6)
        share = np.where(first[:, 0], random.random(count), crowded)
        design[:, length] = longest * share * _LONGEST_INVOLUTE
    return design


def _crowded(share, least):
    """Concentrate uniform shares (0 to 1) at both ends, down to the distance `least` from an
    end."""
    near = 0.5 * (2 * least) ** (1 - np.abs(2 * share - 1))
    return np.where(share < 0.5, near, 1 - near)


@functools.partial(jax.jit, static_argnums=(0, 1))
def judged(family: str, lobes: int, designs):
    """Return, for each of n designs (n, d), whether a config with this design is accepted."""
    return lax.map(functools.partial(_sound, family, lobes), designs)


def _sound(family: str, lobes: int, design):
    profile = profile_of(family, lobes, jnp.asarray(RADIUS_MM * MM), design)
    if family_of(family).by_limits:
        alpha, length = design[0] * DEG, design[1]
        tip = design[2] * DEG if family == "cic" else 0.0
        free, edge = jnp.pi / (2 * lobes) - tip, RADIUS_MM * jnp.sin(alpha)
        shortest = edge * (free - 2 * alpha) + 1e-6 * RADIUS_MM
        uncut = edge * jnp.tan(alpha) * (1 + 1e-9)
        longest = jnp.minimum(edge * free * _LONGEST_INVOLUTE, uncut)
        good = (length <= longest) & (length >= shortest) & (length > 0)
        assert isinstance(profile, CIC)
        return good & (profile.arc_radius > 0) & (profile.arc_center_radius > 0)
    good = jnp.ones((), bool)
    for name, value in margins(profile).of_flank.items():
        if name not in family_of(family).inherent:
            scale = 1.0 if name in PURE else RADIUS_MM * MM
            good &= value >= -_ROUNDING * scale
    if family == "arcs_epicycloid":
        good &= design[2] >= 0.002 * RADIUS_MM
    return good


@functools.partial(jax.jit, static_argnums=(0, 1))
def compared(family: str, lobes: int, designs):
    """Compare area and polar moment of designs (n, d), in config units, with polygons.

    Returns (n, 3): relative errors of area and polar moment, and estimated error of the polygons.
    """

    def compare(design):
        profile = profile_of(family, lobes, jnp.asarray(RADIUS_MM * MM), design)
        truth, rest = by_polygons(profile)
        shape = geometry(profile)
        errors = jnp.abs(jnp.stack([shape.area, shape.polar_area_moment]) / truth - 1)
        return jnp.append(errors, rest)

    return lax.map(compare, designs)


def errors(family: str, lobes: int, count: int, random: np.random.Generator, size: int = 8):
    """Draw `count` random designs. Return the n valid designs (n, d) and their errors (n, 3).

    The errors are those of `compared`; `size`: number of coefficients of a free form."""
    # A family without parameters has one design.
    designs = draw(family, lobes, count if family_of(family).keys else 1, random, size)
    kept = designs[np.asarray(judged(family, lobes, designs))]
    if not len(kept):
        return kept, np.zeros((0, 3))
    # Use one size for all, so that a family is compiled once.
    padded = np.concatenate([kept, np.repeat(kept[:1], len(designs) - len(kept), axis=0)])
    return kept, np.asarray(compared(family, lobes, padded))[: len(kept)]


def row_of(family: str, lobes: int, size: int, designs: np.ndarray, found: np.ndarray) -> Row:
    """Return a row with the largest errors among valid designs (n, d), and the design with the
    worst.

    `found` (n, 3): result of `compared`; `size`: number of coefficients of a free form, else 0.
    """
    # Without a valid design, the errors are NaN.
    area, moment, reference = np.max(found, axis=0) if len(found) else np.full(3, np.nan)
    worst = designs[np.argsort(np.max(found[:, :2], axis=1))[-1:]]
    return {
        "family": f"{family} {size}" if size else family,
        "lobes": lobes,
        "sound": len(designs),
        "area_error": area,
        "polar_moment_error": moment,
        "reference_error": reference,
        "worst_design": " ".join(f"{x:.9g}" for x in worst.ravel()),
    }


def study(
    draws: int,
    seed: int = 0,
    families: Sequence[str] = FAMILIES,
    lobes: Sequence[int] = LOBES,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[Row]:
    """Compare families; yield a row per family, number of coefficients and number of lobes.

    `draws`: number of designs drawn for each row."""
    random = np.random.default_rng(seed)
    for family in families:
        sizes = COEFFICIENTS if family == "free_form" else (0,)
        for size, number in itertools.product(sizes, lobes):
            found = errors(family, number, draws, random, size)
            row, worst = row_of(family, number, size, *found), np.max(found[1], initial=0.0)
            say(f"{row['family']}, {number} lobes: {row['sound']} sound, {worst:.1e}")
            yield row


def run(job: Run) -> None:
    """Compare all families, or in a reduced run those of `QUICK`; write and print the rows."""
    rows = [*(study(QUICK_DRAWS, 0, *QUICK, job.say) if job.quick else study(DRAWS, say=job.say))]
    job.csv("geometry.csv", rows)
    show("Area and inertia against polygons", rows)
