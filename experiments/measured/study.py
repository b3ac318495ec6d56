"""Compares a measured rotor with its design: form, gap in rolling, contact force.

The study makes points such as a coordinate measuring machine gives for a rotor with form errors.
The points lie along the outline of the config's profile, with a form error of the addenda, an error
of each lobe, and noise. They are in clockwise order, and turned by an angle. They are imported as
family `outline`.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from experiments._common.polygons import signed_distance
from experiments._common.scenes import CIC
from experiments._common.simulation import evaluate, profile_of
from rootsopt.config import Config, load
from rootsopt.measured.conjugacy import Conjugacy, conjugacy
from rootsopt.measured.source import outline_of
from rootsopt.output.files import ResultFolder
from rootsopt.profiles import Profile, outline
from rootsopt.scene import check_geometry, design_keys

FORM, LOBES, NOISE = 20e-3, 3e-3, 1e-3
"""Form error of the addenda, differences between lobes, and RMS noise of the points (mm)."""
TURN = 17.0
"""Angle (deg) by which the measured points are turned."""
MM = 1e-3


def complex_points(profile: Profile, points: int) -> np.ndarray:
    """Return the outline of a profile as complex numbers (mm), counter-clockwise from a tip on +x.

    The outline is closed, but the last point, equal to the first, is omitted."""
    return np.asarray(outline(profile, points))[:-1] @ [1, 1j] / MM


def measured(profile: Profile, seed: int = 0) -> np.ndarray:
    """Return the measured points (n,) of the rotor, as complex numbers (mm)."""
    random = np.random.default_rng(seed)
    points = complex_points(profile, 240)
    along = np.roll(points, -1) - np.roll(points, 1)
    normal = -1j * along / np.abs(along)
    radius = float(profile.pitch_radius) / MM
    above = np.clip((np.abs(points) - radius) / (np.max(np.abs(points)) - radius), 0, 1)
    lobe = np.round(np.angle(points) * profile.lobes / (2 * np.pi))
    error = FORM + LOBES * np.sin(2 * np.pi * lobe / profile.lobes)
    error = error * np.sin(np.pi * above) ** 2 + random.normal(0, NOISE, len(points))
    return (points + normal * error)[::-1] * np.exp(1j * np.radians(TURN))


def imported(config: Config, path: Path) -> Config:
    """Return `config` with the outline in the file `path` as its profile."""
    gone = dict.fromkeys(design_keys(config))
    found = {"family": "outline", "outline_file": str(path), "outline_smoothing_mm": NOISE}
    profile = config.profile.model_copy(update=gone | found)
    return config.model_copy(update={"profile": profile})


def off_um(points: np.ndarray, design: Profile) -> np.ndarray:
    """Return the normal distances (µm) of points (complex, mm) from the outline of a design."""
    fine = np.asarray(outline(design, 2000)) / MM
    return 1e3 * signed_distance(np.stack([np.real(points), np.imag(points)], axis=1), fine)


@dataclasses.dataclass(frozen=True)
class Results:
    """Results of the study.

    Fields: both profiles, the measured points in the axes of the design (mm), the gaps in rolling
    by name, and the record of all numbers.
    """

    config: Config
    design: Profile
    profile: Profile
    points: np.ndarray
    gaps: dict[str, Conjugacy]
    record: dict[str, Any]


def run(quick: bool, folder: ResultFolder, config: str = CIC) -> Results:
    """Make a measured rotor, import it, and compare it with its design.

    The points are written into `folder` as measured.csv, which the import reads. A reduced run
    omits the simulations.
    """
    settings = load(config)
    design = profile_of(settings)
    points = measured(design)
    columns = {"x_mm": np.real(points), "y_mm": np.imag(points)}
    other = imported(settings, folder.write_csv("measured.csv", columns).absolute())
    check_geometry(other)
    profile, checks = outline_of(other.profile)
    gaps = {"design": conjugacy(design), "measured": conjugacy(profile)}
    own = points * np.exp(1j * np.radians(checks.turned_deg))
    record: dict[str, Any] = {
        "outline": checks.record() | gaps["measured"].record(),
        "form_found_um": float(np.max(off_um(complex_points(profile, 240), design))),
        "form_given_um": FORM / MM,
    }
    if not quick:
        for name, one in (("design", settings), ("measured", other)):
            evaluation = evaluate(one)
            record[name] = {"status": evaluation.status.label} | evaluation.response
    return Results(settings, design, profile, own, gaps, record)
