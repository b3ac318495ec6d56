"""A measured rotor beside its design: form, gap in rolling, contact force.

    python experiments/measured.py [configs/cic.yaml] [-o DIR] [--quick]

Makes what a coordinate measuring machine might say of a rotor ground a little wrong: points along
the outline of the config's profile with a form error of its addenda, another for every lobe, and
noise, in a clockwise order and turned. Imports them as family `outline`, and compares with the
design. `--quick` leaves out the simulations. Writes measured.csv (the points), measured.json and
measured.png.
"""

import argparse
import sys
from pathlib import Path

from rootsopt.cli import use_float64

use_float64()

import numpy as np  # noqa: E402

from rootsopt import files  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.contact.nodes import signed_distance  # noqa: E402
from rootsopt.evaluate import Evaluator  # noqa: E402
from rootsopt.model import Model, check_geometry, design_keys, design_vector  # noqa: E402
from rootsopt.outline.conjugacy import Conjugacy, conjugacy, gaps_um  # noqa: E402
from rootsopt.outline.source import outline_of  # noqa: E402
from rootsopt.plot import BLUE, GREY, figure, plot_conjugacy  # noqa: E402
from rootsopt.profiles import Profile, outline  # noqa: E402

FORM, LOBES, NOISE = 20e-3, 3e-3, 1e-3
"""Form error of the addenda, of the lobes among each other, RMS noise (mm)."""
TURN = 17.0
"""Angle (deg) of a lobe in the coordinates of the measurement."""
MM = 1e-3


def complex_points(profile: Profile, points: int) -> np.ndarray:
    """A closed outline (mm) without the last point, counter-clockwise from a tip on +x."""
    return np.asarray(outline(profile, points))[:-1] @ [1, 1j] / MM


def measured(profile: Profile, seed: int = 0) -> np.ndarray:
    """Points of the rotor as measured (mm)."""
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
    """`config` with the outline in a file in the place of its profile."""
    gone = dict.fromkeys(design_keys(config))
    found = {"family": "outline", "outline_file": str(path), "outline_smoothing_mm": NOISE}
    profile = config.profile.model_copy(update=gone | found)
    return config.model_copy(update={"profile": profile})


def off_um(points: np.ndarray, design: Profile) -> np.ndarray:
    """Normal distance (µm) of points (mm) from a design."""
    fine = np.asarray(outline(design, 2000)) / MM
    return 1e3 * signed_distance(np.stack([np.real(points), np.imag(points)], axis=1), fine)


def draw(
    points: np.ndarray,
    profile: Profile,
    design: Profile,
    gaps: dict[str, Conjugacy],
    config: Config,
):
    """Deviation from the design over the radius, and the gap in rolling."""
    made, axes = figure(11, 4.2, 1, 2)
    left, right = axes[0]
    left.plot(np.abs(points), off_um(points, design), ".", color=GREY, ms=2, label="points")
    fitted = complex_points(profile, 240)
    fitted = fitted[(np.angle(fitted) >= 0) & (np.angle(fitted) <= np.pi / design.lobes)]
    left.plot(np.abs(fitted), off_um(fitted, design), color=BLUE, label="flank that is simulated")
    left.axvline(config.profile.pitch_radius_mm, color="black", ls="--", lw=0.9)
    left.annotate(
        "pitch circle", (config.profile.pitch_radius_mm, 0.97), (3, 0), ha="left", va="top",
        xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=9,
    )  # fmt: skip
    left.set(xlabel="radius (mm)", ylabel="deviation, outwards (µm)", title="From the design")
    left.grid(color="0.92", linewidth=0.6)
    left.legend(frameon=False, loc="upper left")
    plot_conjugacy(right, {name: gaps_um(one) for name, one in gaps.items()})
    right.legend(frameon=False)
    return made


def main() -> int:
    arguments = argparse.ArgumentParser(description="A measured rotor beside its design.")
    arguments.add_argument("config", nargs="?", default="configs/cic.yaml")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/measured"))
    arguments.add_argument("--quick", action="store_true", help="no simulations")
    options = arguments.parse_args()
    folder = files.ResultFolder(options.output)
    config = load(options.config)
    design = Model.of(config).profile(design_vector(config))
    points = measured(design)
    columns = {"x_mm": np.real(points), "y_mm": np.imag(points)}
    path = folder.write_csv("measured.csv", columns).absolute()
    other = imported(config, path)
    check_geometry(other)
    profile, checks = outline_of(other.profile)
    gaps = {"design": conjugacy(design), "measured": conjugacy(profile)}
    own = points * np.exp(1j * np.radians(checks.turned_deg))
    folder.write_figure("measured.png", draw(own, profile, design, gaps, config))
    fitted = complex_points(profile, 240)
    found = {
        "outline": checks.record() | gaps["measured"].record(),
        "form_found_um": float(np.max(off_um(fitted, design))),
        "form_given_um": FORM / MM,
    }
    if not options.quick:
        for name, one in (("design", config), ("measured", other)):
            evaluation = Evaluator(one)(series=False)
            found[name] = {"status": evaluation.status.label} | evaluation.response
    folder.write_json("measured.json", found | {"versions": files.versions()})
    for key, value in found.items():
        print(f"{key}: {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
