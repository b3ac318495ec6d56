"""Measures what rounding the corners of contact law and timing gear changes, over many scenes.

The scenes are random designs and scenes of both shipped pairs, the shipped configs, the paper's
configs, and a blower with all parts. Each scene is simulated to its orbit at the default
`contact.smoothing_mm`, which depends on the scene. The orbit is then closed again at the default
and at fixed smoothing lengths, at a tight tolerance. *Bias* is the largest relative difference of
mean, peak and RMS force from the forces at the smallest length. Scenes whose orbit does not close
at a length are counted. Derivatives are compared with central differences of tight orbits.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments._common.batch import Batch, coarse, on_all_cores, respond
from experiments._common.driver import Run
from experiments._common.engines import FD_STEPS
from experiments._common.scenes import FORCES, SHAKY, shipped
from experiments._common.simulation import stacked
from experiments._common.style import BLUE, GREEN, VERMILION, grid_below, sheet
from rootsopt.config import Config
from rootsopt.config.units import MM
from rootsopt.dynamics.integrator import Integrator
from rootsopt.errors import InputError
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene, check_geometry, design_vector
from rootsopt.status import Status

Say = Callable[[str], None]

# Value that stands for the default of `contact.smoothing_mm` among the smoothing lengths (mm).
DEFAULT = 0.0

# Smoothing lengths (mm) at which orbits are closed. The first length is the reference.
WIDTHS = (1e-6, 1e-5, 3e-5, 1e-4, 1e-3, DEFAULT)

# Smoothing lengths (mm) at which gradients are compared.
COMPARED = (1e-6, 1e-5, DEFAULT)

# Relative bias above which the default is too wide.
LIMIT = 1e-4

# Tolerances (transient, orbit): first for finding an orbit, then for measuring its forces.
USUAL, TIGHT = (1e-6, 1e-8), (1e-8, 1e-10)

# Longest transients (mesh periods): first for finding an orbit, then for measuring its forces.
PERIODS = 200, 100

# Scaled distance at φ1 = 0 above which two orbits count as different motions.
SAME = 0.02

# Size of the steps of central differences, as a fraction of `FD_STEPS`.
FD_SHARE = 0.05
KNOWN: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "cic": (("cic", ()), ("cic", SHAKY), ("paper_cic", ())),
    "ee": (("ee", ()), ("paper_ee", ())),
    "pump": (("pump", ()),),
}

# Number of random scenes of each kind.
COUNTS = {"cic": 60, "ee": 30, "pump": 5}


def drawn(kind: str) -> Iterator[Config]:
    """Yield random scenes of a `kind` (key of `COUNTS`) without end.

    Designs are random as well if the profile family has parameters."""
    draw = np.random.default_rng([0, *kind.encode()])

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
            config = shipped(kind, *(f"{k}={v!r}" for k, v in values.items()))
            check_geometry(config)
        except InputError:
            continue
        yield config


def scenes(kind: str, count: int) -> list[Config]:
    """Load the known scenes of a kind and draw `count` random ones."""
    known = [shipped(name, *changes) for name, changes in KNOWN[kind]]
    return [*known, *(config for config, _ in zip(drawn(kind), range(count), strict=False))]


@CachedFunction
def _respond(models: Scene, designs, states, tolerances, periods, gradient: bool) -> Batch:
    def one(at):
        model, design, state = at
        transient, orbit = (Integrator("tsit5", tolerances[k], 4096) for k in range(2))
        solver = dataclasses.replace(coarse(model, transient, orbit), max_periods=periods)
        return respond(model, design, state, solver, gradient)

    return jax.lax.map(one, (models, designs, states))


def responses(
    models: Scene, designs, states, tolerances: tuple[float, float], periods: int, slopes=True
) -> Batch:
    """Simulate n scenes, each with its own design and scaled initial state.

    `models`: scenes, stacked along a leading axis; `tolerances` of transient and orbit; `periods`:
    longest transient (mesh periods); `slopes`: whether to compute gradients."""
    leaves, structure = jax.tree.flatten(models)

    def work(designs, states, *leaves):
        models = jax.tree.unflatten(structure, leaves)
        return _respond(
            models, designs, states, jnp.asarray(tolerances), jnp.asarray(float(periods)), slopes
        )

    return jax.tree.map(np.asarray, on_all_cores(work, designs, states, *leaves))


def rounded(models: Scene, width: float) -> Scene:
    """Round all corners of the scenes `models` over `width` (mm); `DEFAULT` changes nothing."""
    if width == DEFAULT:
        return models
    length = np.full_like(models.pitch_radius, width * MM)
    places = (length, length / models.pitch_radius)
    return eqx.tree_at(lambda m: (m.law.smoothing, m.gear.rounding), models, places)


def bias(found: Batch, truth: Batch) -> NDArray[np.float64]:
    """Return the largest relative difference (n,) of mean, peak and RMS force.

    The result is NaN where a force is unknown, or where the motions differ.
    """
    same = np.max(np.abs(found.state - truth.state), axis=1) < SAME
    same &= found.usable & truth.usable & (found.period == truth.period)
    off = np.max(np.abs(found.response / truth.response - 1), axis=1)
    return np.where(same, off, np.nan)


def gradient_errors(models: Scene, designs, found: Batch) -> NDArray[np.float64]:
    """Compare the gradients of mean, peak and RMS force with central differences.

    Returns errors (n, 3), relative to the largest entry of each gradient.
    """
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
class Size:
    """Size of a run.

    Fields, in order: number of random scenes of each kind, smoothing lengths (mm), lengths (mm) at
    which gradients are compared, and number of scenes whose gradients are compared.
    """

    counts: dict[str, int]
    widths: tuple[float, ...] = WIDTHS
    compared: tuple[float, ...] = COMPARED
    differentiated: int = 20


QUICK = Size({"cic": 5}, (1e-6, 1e-4, DEFAULT), (DEFAULT,), 2)


@dataclasses.dataclass(frozen=True)
class Measured:
    """Scenes of one kind that settle, and their orbits at every smoothing length."""

    kind: str
    tried: int
    configs: list[Config]
    orbits: dict[float, Batch]
    gradients: dict[float, NDArray[np.float64]]

    def bias(self, width: float) -> NDArray[np.float64]:
        """Return the bias (n,) at a smoothing length (mm)."""
        return bias(self.orbits[width], self.orbits[WIDTHS[0]])


def measure(kind: str, size: Size, say: Say) -> Measured:
    """Simulate the scenes of a kind to their orbits, then close the orbits at all smoothing
    lengths.
    """
    configs = scenes(kind, size.counts[kind])
    models = stacked(configs)
    designs = np.stack([np.asarray(design_vector(config)) for config in configs])
    rest = np.zeros((len(configs), 11 if kind == "pump" else 2))
    began = time.perf_counter()
    first = responses(models, designs, rest, USUAL, PERIODS[0])
    held = np.flatnonzero(first.usable)
    say(f"{kind}: {len(held)} of {len(configs)} settle ({time.perf_counter() - began:.0f} s)")
    models, designs, states = jax.tree.map(lambda x: x[held], (models, designs, first.state))
    orbits, gradients = {}, {}
    some = slice(size.differentiated)
    for width in size.widths:
        changed = rounded(models, width)
        orbits[width] = responses(changed, designs, states, TIGHT, PERIODS[1])
        said = f"{kind}: {width:g} mm, {np.sum(orbits[width].usable)} closed"
        if width in size.compared and kind == "cic":
            picked = jax.tree.map(lambda x: x[some], (changed, designs, orbits[width]))
            gradients[width] = gradient_errors(*picked)
            said += f", gradients {np.nanmedian(gradients[width], axis=0)}"
        say(f"{said} ({time.perf_counter() - began:.0f} s)")
    return Measured(kind, len(configs), [configs[i] for i in held], orbits, gradients)


def rows_of(measured: Measured) -> list[dict[str, Any]]:
    """Return a row for every scene at every smoothing length."""
    return [
        {
            "kind": measured.kind,
            "scene": k,
            "scene_values": config.scene.model_dump_json(exclude_none=True),
            "smoothing_mm": width,
            "status": Status.of(int(orbit.status[k])).label,
            "period": orbit.period[k],
            **dict(zip((*FORCES, "rms_force_N"), orbit.response[k], strict=True)),
            "bias": measured.bias(width)[k],
            "solver_steps": orbit.steps[k],
        }
        for width, orbit in measured.orbits.items()
        for k, config in enumerate(measured.configs)
    ]


def summary(measured: Measured) -> dict[str, Any]:
    """Return counts, and quantiles of the bias and of the gradient errors, by smoothing length."""
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


ORDER = (BLUE, VERMILION, GREEN)
COLORS: dict[str, str] = {"cic": BLUE, "ee": VERMILION, "pump": GREEN}
NAMES = {"cic": "CIC", "ee": "EE", "pump": "pump"}
MARKS = {"cic": "o", "ee": "s", "pump": "^"}


def lengths(found: list[Measured]) -> Figure:
    """Draw the bias of the forces and the error of the gradients over the smoothing length."""
    made, axes = sheet(12, 6, 1, 2)
    (left, right) = axes[0]
    for measured in found:
        kind, color = measured.kind, COLORS[measured.kind]
        widths = np.array(sorted(set(measured.orbits) - {DEFAULT}))
        beyond = widths[1:]
        known = [measured.bias(width) for width in beyond]
        for share, style in ((1.0, "-"), (0.5, ":")):
            level = [np.nanquantile(values, share) for values in known]
            name = "greatest" if share == 1 else "median"
            left.loglog(
                beyond, np.maximum(level, 1e-13), style, marker=MARKS[kind], color=color,
                label=f"{NAMES[kind]}: {name} of {len(measured.configs)}",
            )  # fmt: skip
        own = [config.contact.rounding_mm for config in measured.configs]
        left.loglog(
            own, np.maximum(measured.bias(DEFAULT), 1e-13), MARKS[kind], color=color, mfc="none",
            ms=5, label=f"{NAMES[kind]}: default, each scene",
        )  # fmt: skip
        for number, name in enumerate(("mean", "peak", "RMS")):
            for width, off in measured.gradients.items():
                values = off[:, number]
                places = np.array(own[: len(values)]) if width == DEFAULT else width
                right.loglog(
                    places * 1.25 ** (number - 1) * np.ones_like(values),
                    np.maximum(values, 1e-12),
                    "os^"[number],
                    color=ORDER[number],
                    mfc="none",
                    ms=4,
                    label=name if width == DEFAULT else None,
                )
    left.axhline(LIMIT, color="black", linestyle="--", linewidth=1, label="limit")
    left.set_ylabel(f"relative bias of the forces, against {WIDTHS[0]:g} mm")
    right.set_ylabel("relative error of the gradient (CIC scenes)")
    for ax in axes[0]:
        ax.set_xlabel("contact.smoothing_mm (mm)")
        grid_below(ax)
        ax.legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    return made


def run(job: Run) -> bool:
    """Measure all kinds of scenes. Returns whether the default's bias is below the limit."""
    size = QUICK if job.quick else Size(COUNTS)
    found: list[Measured] = []
    for kind in size.counts:
        found.append(measure(kind, size, job.say))
        # Save after each kind: the last one compiles for long.
        job.csv("smoothing.csv", [row for one in found for row in rows_of(one)])
        job.json("smoothing.json", {one.kind: summary(one) for one in found})
        job.figure("smoothing.png", lengths(found))
        part = summary(found[-1])
        print(f"{kind}: {part['settled']} of {part['scenes']} scenes settle")
        for width, row in part["by_width"].items():
            print(f"  {width} mm: {row}")
    return bool(max(np.nanmax(one.bias(DEFAULT)) for one in found) < LIMIT)
