"""Compares a measured rotor with its design: form, gap in rolling, contact force.

The study makes points such as a coordinate measuring machine gives for a rotor with form errors.
The points lie along the outline of the config's profile, with a form error of the addenda, an error
of each lobe, and noise. They are in clockwise order, and turned by an angle. They are imported as
family `outline`.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments._common.driver import Run
from experiments._common.polygons import signed_distance
from experiments._common.scenes import CIC
from experiments._common.simulation import evaluate, profile_of
from experiments._common.style import BLUE, GREY, sheet
from experiments._common.tables import print_record
from rootsopt.config import Config, load
from rootsopt.measured.conjugacy import conjugacy
from rootsopt.measured.source import outline_of
from rootsopt.profiles import Profile, outline
from rootsopt.scene import check_geometry
from rootsopt.view.figures.designs import plot_conjugacy

# Form error of the addenda, differences between lobes, and RMS noise of the points (mm).
FORM, LOBES, NOISE = 20e-3, 3e-3, 1e-3

# Angle (deg) by which the measured points are turned.
TURN = 17.0
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
    gone = dict.fromkeys(config.design_keys)
    found = {"family": "outline", "outline_file": str(path), "outline_smoothing_mm": NOISE}
    profile = config.profile.model_copy(update=gone | found)
    return config.model_copy(update={"profile": profile})


def off_um(points: np.ndarray, design: Profile) -> np.ndarray:
    """Return the normal distances (µm) of points (complex, mm) from the outline of a design."""
    fine = np.asarray(outline(design, 2000)) / MM
    return 1e3 * signed_distance(np.stack([np.real(points), np.imag(points)], axis=1), fine)


def deviations(design: Profile, profile: Profile, points: np.ndarray, gaps: Any) -> Figure:
    """Draw the deviation from the design over the radius, and the gap in rolling.

    `profile`: that of the measured `points` (complex, mm); `gaps`: gaps in rolling, by name."""
    made, ((left, right),) = sheet(11, 4.2, 1, 2)
    left.plot(np.abs(points), off_um(points, design), ".", color=GREY, ms=2, label="points")
    fitted = complex_points(profile, 240)
    fitted = fitted[(np.angle(fitted) >= 0) & (np.angle(fitted) <= np.pi / design.lobes)]
    left.plot(np.abs(fitted), off_um(fitted, design), color=BLUE, label="flank that is simulated")
    pitch = float(design.pitch_radius) / MM
    left.axvline(pitch, color="black", ls="--", lw=0.9)
    left.annotate(
        "pitch circle", (pitch, 0.97), (3, 0), ha="left", va="top",
        xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=9,
    )  # fmt: skip
    left.set(xlabel="radius (mm)", ylabel="deviation, outwards (µm)", title="From the design")
    left.legend(frameon=False, loc="upper left")
    plot_conjugacy(right, gaps)
    right.legend(frameon=False)
    return made


def run(job: Run) -> None:
    """Make a measured rotor, import it, and compare it with its design.

    The points are written as measured.csv, which the import reads. A reduced run omits the
    simulations.
    """
    settings = load(CIC)
    design = profile_of(settings)
    points = measured(design)
    columns = {"x_mm": np.real(points), "y_mm": np.imag(points)}
    other = imported(settings, job.folder.write_csv("measured.csv", columns).absolute())
    check_geometry(other)
    profile, checks = outline_of(other.profile)
    gaps = {"design": conjugacy(design), "measured": conjugacy(profile)}
    record: dict[str, Any] = {
        "outline": checks.record() | gaps["measured"].record(),
        "form_found_um": float(np.max(off_um(complex_points(profile, 240), design))),
        "form_given_um": FORM / MM,
    }
    for name, one in {} if job.quick else {"design": settings, "measured": other}.items():
        found = evaluate(one)
        record[name] = {"status": found.status.label} | found.response
    own = points * np.exp(1j * np.radians(checks.turned_deg))
    job.figure("measured.png", deviations(design, profile, own, gaps))
    job.json("measured.json", record)
    print_record(record)
