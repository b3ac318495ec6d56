"""What rounding the corners of contact law and timing gear changes, over many scenes.

    python experiments/smoothing.py [-o DIR] [--quick] [--count N] [--seed 0]

Random designs and scenes of both shipped pairs, the shipped configs themselves, those of the
paper, and a blower with all parts are brought to their orbit at the default `contact.smoothing_mm`,
which follows the scene. The orbit is closed again at that and at fixed smoothing lengths, at a
tight tolerance. Bias is the relative difference of mean, peak and RMS force from those at the least
length; the greatest of the three counts. Scenes whose orbit is not closed at a length are counted.
The gradient by differentiation is compared with central differences of tight orbits.

Writes smoothing.csv (a row for every scene and length), smoothing.json and smoothing.png.
"""

import argparse
import dataclasses
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# As the commands do, before equinox is first imported.
os.environ.setdefault("EQX_ON_ERROR", "off")

from rootsopt.cli import use_cache, use_float64

use_float64()
use_cache()

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from experiments.baselines import FD_STEPS  # noqa: E402
from experiments.extremes_parts.scenes import stacked  # noqa: E402
from rootsopt import files, plot  # noqa: E402
from rootsopt.batch import STATUSES, Batch, on_all_cores, respond  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.dynamics.flow import Integrator  # noqa: E402
from rootsopt.errors import InputError  # noqa: E402
from rootsopt.model import MM, Model, check_geometry, design_vector  # noqa: E402
from rootsopt.programs import Program  # noqa: E402

DEFAULT = 0.0
"""Stands for the default of `contact.smoothing_mm` among the smoothing lengths."""
WIDTHS = (1e-6, 1e-5, 3e-5, 1e-4, 1e-3, DEFAULT)
"""Smoothing lengths (mm); the first is the reference."""
COMPARED = (1e-6, 1e-5, DEFAULT)
"""Those at which gradients are compared."""
LIMIT = 1e-4
"""Bias that the default must stay below."""
USUAL, TIGHT = (1e-6, 1e-8), (1e-8, 1e-10)
"""Tolerances of transient and orbit, while an orbit is searched for and while it is measured."""
PERIODS = 200, 100
"""Mesh periods the transient may last, there."""
SAME = 0.02
"""Scaled distance at φ1 = 0 within which two orbits are one motion."""
FD_SHARE = 0.05
"""Steps of the central differences in units of `FD_STEPS`."""
SHAKY = (
    "scene.speed_rpm=1700",
    "scene.load.torque_N_m=3",
    "scene.timing_gear.backlash_mm=0.25",
    "scene.timing_gear.damping_ratio=0.3",
    "scene.timing_gear.stiffness_N_m_per_rad=9000",
    "profile.pressure_angle_deg=30.7",
    "profile.involute_length_mm=4",
    "profile.tip_arc_angle_deg=1.5",
)
"""A stable orbit of two mesh periods, which magnifies what is changed."""
KNOWN: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "cic": (("cic", ()), ("cic", SHAKY), ("paper_cic", ())),
    "ee": (("ee", ()), ("paper_ee", ())),
    "pump": (("pump", ()),),
}
COUNTS = {"cic": 60, "ee": 30, "pump": 5}
COLORS = {"cic": plot.BLUE, "ee": plot.VERMILION, "pump": plot.GREEN}
MARKS = {"cic": "o", "ee": "s", "pump": "^"}


def say(text: str) -> None:
    """Progress."""
    print(text, file=sys.stderr, flush=True)


def drawn(kind: str, seed: int) -> Iterator[Config]:
    """Endless random scenes of a kind, and designs where it has them."""
    draw = np.random.default_rng([seed, *kind.encode()])

    def even_in_logarithm(low: float, high: float) -> float:
        return float(10 ** draw.uniform(np.log10(low), np.log10(high)))

    while True:
        backlash = even_in_logarithm(0.005, 0.5) if draw.uniform() < 0.9 else 0.0
        values = {
            "scene.speed_rpm": even_in_logarithm(600, 6000),
            "scene.timing_gear.stiffness_N_m_per_rad": even_in_logarithm(3e3, 1e6),
            "scene.timing_gear.damping_ratio": even_in_logarithm(0.02, 1),
            "scene.timing_gear.backlash_mm": backlash,
        }
        if kind == "pump":
            values["scene.load.pressure_difference_Pa"] = even_in_logarithm(5e3, 2e5)
            values["contact.friction.kinetic"] = float(draw.uniform(0, 0.15))
            values["scene.motor.slope_N_m_s_per_rad"] = even_in_logarithm(0.03, 1)
        else:
            values["scene.load.torque_N_m"] = even_in_logarithm(0.3, 30)
        if kind != "ee":
            values["profile.pressure_angle_deg"] = float(draw.uniform(26, 42))
            values["profile.tip_arc_angle_deg"] = float(draw.uniform(0.7, 6))
            values["profile.involute_length_mm"] = float(draw.uniform(1, 9))
        try:
            config = load(f"configs/{kind}.yaml", [f"{k}={v!r}" for k, v in values.items()])
            check_geometry(config)
        except InputError:
            continue
        yield config


def scenes(kind: str, count: int, seed: int) -> list[Config]:
    """The known scenes of a kind and `count` random ones."""
    known = [load(f"configs/{name}.yaml", [*changes]) for name, changes in KNOWN[kind]]
    return [*known, *(config for config, _ in zip(drawn(kind, seed), range(count), strict=False))]


@Program
def _respond(models: Model, designs, states, tolerances, periods, gradient: bool) -> Batch:
    def one(at):
        model, design, state = at
        transient, orbit = (Integrator("tsit5", tolerances[k], 4096) for k in range(2))
        return respond(model, design, state, transient, orbit, periods, gradient=gradient)

    return jax.lax.map(one, (models, designs, states))


def responses(
    models: Model, designs, states, tolerances: tuple[float, float], periods: int, slopes=True
) -> Batch:
    """Of n scenes, each with its own design and scaled state to begin from."""
    leaves, structure = jax.tree.flatten(models)

    def work(designs, states, *leaves):
        models = jax.tree.unflatten(structure, leaves)
        return _respond(
            models, designs, states, jnp.asarray(tolerances), jnp.asarray(periods), slopes
        )

    return jax.tree.map(np.asarray, on_all_cores(work, designs, states, *leaves))


def rounded(models: Model, width: float) -> Model:
    """The models with all corners rounded over `width` (mm), or as they are by default."""
    if width == DEFAULT:
        return models
    length = np.full_like(models.pitch_radius, width * MM)
    places = (length, length / models.pitch_radius)
    return eqx.tree_at(lambda m: (m.law.smoothing, m.gear.rounding), models, places)


def bias(found: Batch, truth: Batch) -> NDArray[np.float64]:
    """Greatest relative difference (n,) of mean, peak and RMS, NaN where one is not known or the
    motions are not the same."""
    same = np.max(np.abs(found.state - truth.state), axis=1) < SAME
    same &= found.usable & truth.usable & (found.period == truth.period)
    off = np.max(np.abs(found.response / truth.response - 1), axis=1)
    return np.where(same, off, np.nan)


def gradient_errors(models: Model, designs, found: Batch) -> NDArray[np.float64]:
    """Error (n, 3) of the gradients of mean, peak and RMS against central differences, relative
    to the greatest entry of each."""
    columns, same = [], np.asarray(found.usable)
    for k, step in enumerate(FD_STEPS):
        moved = np.eye(designs.shape[1])[k] * step * FD_SHARE
        up, down = (
            responses(models, designs + sign * moved, found.state, TIGHT, PERIODS[1], False)
            for sign in (1, -1)
        )
        for end in (up, down):
            same &= end.usable & (end.period == found.period)
            same &= np.max(np.abs(end.state - found.state), axis=1) < SAME
        columns.append((up.response - down.response) / (2 * step * FD_SHARE))
    truth = np.stack(columns, axis=2)
    off = np.max(np.abs(found.gradient - truth), axis=2) / np.max(np.abs(truth), axis=2)
    return np.where(same[:, None], off, np.nan)


@dataclasses.dataclass(frozen=True)
class Measured:
    """Scenes of a kind that settle, and their orbit at every smoothing length."""

    kind: str
    tried: int
    configs: list[Config]
    orbits: dict[float, Batch]
    gradients: dict[float, NDArray[np.float64]]

    def bias(self, width: float) -> NDArray[np.float64]:
        """Bias (n,) at a smoothing length (mm)."""
        return bias(self.orbits[width], self.orbits[WIDTHS[0]])


def measure(kind: str, count: int, seed: int, widths, compared, differentiated: int) -> Measured:
    """Bring the scenes of a kind to their orbits, and those to other smoothing lengths."""
    configs = scenes(kind, count, seed)
    models = stacked(configs, "float64")
    designs = np.stack([np.asarray(design_vector(config)) for config in configs])
    rest = np.zeros((len(configs), 11 if kind == "pump" else 2))
    began = time.perf_counter()
    first = responses(models, designs, rest, USUAL, PERIODS[0])
    held = np.flatnonzero(first.usable)
    say(f"{kind}: {len(held)} of {len(configs)} settle ({time.perf_counter() - began:.0f} s)")
    models, designs, states = jax.tree.map(lambda x: x[held], (models, designs, first.state))
    orbits, gradients = {}, {}
    for width in widths:
        changed = rounded(models, width)
        orbits[width] = responses(changed, designs, states, TIGHT, PERIODS[1])
        said = f"{kind}: {width:g} mm, {np.sum(orbits[width].usable)} closed"
        if width in compared and kind == "cic":
            some = slice(differentiated)
            picked = jax.tree.map(lambda x: x[some], (changed, designs, orbits[width]))  # noqa: B023
            gradients[width] = gradient_errors(*picked)
            said += f", gradients {np.nanmedian(gradients[width], axis=0)}"
        say(f"{said} ({time.perf_counter() - began:.0f} s)")
    return Measured(kind, len(configs), [configs[i] for i in held], orbits, gradients)


def rows_of(measured: Measured) -> list[dict[str, Any]]:
    """A row for every scene and smoothing length."""
    rows = []
    for width, orbit in measured.orbits.items():
        for k, config in enumerate(measured.configs):
            gear, load_ = config.scene.timing_gear, config.scene.load
            assert gear is not None
            mean, peak, rms = orbit.response[k]
            rows.append(
                {
                    "kind": measured.kind,
                    "scene": k,
                    "speed_rpm": config.scene.speed_rpm,
                    "torque_N_m": load_.torque_N_m,
                    "pressure_difference_Pa": load_.pressure_difference_Pa,
                    "gear_stiffness_N_m_per_rad": gear.stiffness_N_m_per_rad,
                    "gear_damping_ratio": gear.damping_ratio,
                    "backlash_mm": gear.backlash_mm,
                    "smoothing_mm": width,
                    "status": STATUSES[orbit.status[k]].label,
                    "period": orbit.period[k],
                    "mean_force_N": mean,
                    "peak_force_N": peak,
                    "rms_force_N": rms,
                    "bias": measured.bias(width)[k],
                    "solver_steps": orbit.steps[k],
                }
            )
    return rows


def summary(measured: Measured) -> dict[str, Any]:
    """Counts, quantiles of the bias and of the gradient's error, by smoothing length."""
    by_width = {}
    for width, orbit in measured.orbits.items():
        known = measured.bias(width)
        known = known[np.isfinite(known)]
        row: dict[str, Any] = {
            "closed": int(np.sum(orbit.usable)),
            "compared": len(known),
            "median_bias": float(np.median(known)),
            "ninth_decile_bias": float(np.quantile(known, 0.9)),
            "greatest_bias": float(np.max(known)),
            "beyond_limit": int(np.sum(known > LIMIT)),
            "median_steps": float(np.median(orbit.steps[orbit.usable])),
        }
        if width in measured.gradients:
            off = measured.gradients[width]
            off = off[np.all(np.isfinite(off), axis=1)]
            row["gradients"] = len(off)
            row["median_gradient_error"] = np.median(off, axis=0).tolist()
            row["greatest_gradient_error"] = np.max(off, axis=0).tolist()
        by_width["default" if width == DEFAULT else f"{width:g}"] = row
    return {"scenes": measured.tried, "settled": len(measured.configs), "by_width": by_width}


def draw_figure(all_measured: list[Measured]) -> Figure:
    """Bias, orbits closed and gradient error over the smoothing length."""
    made, axes = plot.figure(13, 4.4, 1, 3)
    (left, middle, right) = axes[0]
    for measured in all_measured:
        kind, color = measured.kind, COLORS[measured.kind]
        widths = np.array(sorted(set(measured.orbits) - {DEFAULT}))
        beyond = widths[1:]
        known = [measured.bias(width) for width in beyond]
        for share, style in ((1.0, "-"), (0.5, ":")):
            level = [np.nanquantile(values, share) for values in known]
            name = "greatest" if share == 1 else "median"
            left.loglog(
                beyond, np.maximum(level, 1e-13), style, marker=MARKS[kind], color=color,
                label=f"{kind}: {name} of {len(measured.configs)}",
            )  # fmt: skip
        own = [config.contact.rounding_mm for config in measured.configs]
        left.loglog(
            own, np.maximum(measured.bias(DEFAULT), 1e-13), MARKS[kind], color=color, mfc="none",
            ms=5, label=f"{kind}: default, each scene",
        )  # fmt: skip
        closed = [100 * np.mean(measured.orbits[width].usable) for width in widths]
        middle.semilogx(widths, closed, marker=MARKS[kind], color=color, label=kind)
        for number, name in enumerate(("mean", "peak", "RMS")):
            for width, off in measured.gradients.items():
                values = off[:, number]
                places = np.array(own[: len(values)]) if width == DEFAULT else width
                right.loglog(
                    places * 1.25 ** (number - 1) * np.ones_like(values),
                    np.maximum(values, 1e-12),
                    "os^"[number],
                    color=(plot.BLUE, plot.VERMILION, plot.GREEN)[number],
                    mfc="none",
                    ms=4,
                    label=name if width == DEFAULT else None,
                )
    left.axhline(LIMIT, color="black", linestyle="--", linewidth=1, label="limit")
    left.set_ylabel(f"relative bias of the forces, against {WIDTHS[0]:g} mm")
    middle.set(ylabel="orbits closed at 1e-10 (% of those that settle)", ylim=(0, 104))
    right.set_ylabel("relative error of the gradient (cic)")
    for ax in axes[0]:
        ax.set_xlabel("contact.smoothing_mm (mm)")
        ax.grid(color="0.92", linewidth=0.6)
        ax.legend(fontsize=8, frameon=False)
    return made


def main() -> int:
    arguments = argparse.ArgumentParser(description="Bias of rounding the corners.")
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/smoothing"))
    arguments.add_argument("--quick", action="store_true", help="a few scenes of CIC")
    arguments.add_argument("--count", type=int, help="random scenes of CIC; fewer of the others")
    arguments.add_argument("--seed", type=int, default=0)
    options = arguments.parse_args()
    folder = files.ResultFolder(options.output)
    share = 1.0 if options.count is None else options.count / COUNTS["cic"]
    counts = {kind: round(share * count) for kind, count in COUNTS.items()}
    widths, compared, differentiated = WIDTHS, COMPARED, 20
    if options.quick:
        counts, widths, compared, differentiated = {"cic": 5}, (1e-6, 1e-4, DEFAULT), (DEFAULT,), 2
    found: list[Measured] = []
    record: dict[str, Any] = {}
    for kind, count in counts.items():
        found.append(measure(kind, count, options.seed, widths, compared, differentiated))
        # Written after every kind: the last one compiles for long.
        rows = [row for measured in found for row in rows_of(measured)]
        folder.write_csv("smoothing.csv", files.row_columns(rows))
        record[kind] = summary(found[-1])
        folder.write_json("smoothing.json", record | {"versions": files.versions()})
        folder.write_figure("smoothing.png", draw_figure(found))
    for kind, part in record.items():
        print(f"{kind}: {part['settled']} of {part['scenes']} scenes settle")
        for width, row in part["by_width"].items():
            print(f"  {width} mm: {row}")
    print(f"written to {options.output}")
    worst = max(np.nanmax(measured.bias(DEFAULT)) for measured in found)
    return 0 if worst < LIMIT else 3


if __name__ == "__main__":
    sys.exit(main())
