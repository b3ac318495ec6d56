"""Writes the figures of a command's run into the run's result folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rootsopt.config import FAMILY_KEYS, Config
from rootsopt.config.families import is_list
from rootsopt.figures.comparison import plot_departure, plot_forces_together
from rootsopt.figures.force import plot_force, plot_spectrum
from rootsopt.figures.history import plot_history
from rootsopt.figures.optimum import plot_prices, plot_residual, plot_starts
from rootsopt.figures.profiles import plot_conjugacy, plot_flank, plot_meshing, plot_profiles
from rootsopt.figures.style import (
    figure,
)
from rootsopt.measured.conjugacy import conjugacy, gaps_um
from rootsopt.output.files import ResultFolder
from rootsopt.response.evaluation import Evaluation
from rootsopt.scene import design_keys, outline_mm


def profile_figures(folder: ResultFolder, config: Config, record: Mapping[str, Any]) -> list[str]:
    """Write the figures of one design's profile into `folder`; return the file names.

    `record`: the design's record in the result file. The figures are profiles.png, meshing.png and,
    for a profile read from a file, conjugacy.png."""
    points = _outline(config, record.get("design", {}))
    names = [
        _write(folder, "profiles", _profiles({config.profile.family.upper(): points}, config)),
        _write(folder, "meshing", _meshing(points, config)),
    ]
    if config.profile.from_file:
        from rootsopt.measured.source import outline_of  # For outlines only: it takes 0.5 s.

        made, axes = figure(8, 4.2)
        gaps = gaps_um(conjugacy(outline_of(config.profile)[0]))
        plot_conjugacy(axes[0, 0], {Path(config.profile.outline_file or "").name: gaps})
        axes[0, 0].legend(frameon=False)
        names.append(_write(folder, "conjugacy", made))
    return names


def simulation_figures(folder: ResultFolder, evaluation: Evaluation, config: Config) -> list[str]:
    """Write the profile and force figures of an evaluation into `folder`; return the file names."""
    names = profile_figures(folder, config, evaluation.record())
    return names + _force_figures(folder, {config.profile.family.upper(): evaluation}, config)


def optimization_figures(
    folder: ResultFolder,
    baseline: Evaluation,
    optimized: Evaluation,
    history: Sequence[Mapping[str, Any]],
    config: Config,
    given: Config | None = None,
) -> list[str]:
    """Write the figures of an optimisation into `folder`; return the file names.

    `baseline`, `optimized`: evaluations of the design before and after the optimisation. `history`:
    one row per evaluation, as in `plot_history`; if empty, its figure is omitted. `config`: config
    of the optimised design; `given`: that of the baseline, if its profile is of another family."""
    designs = {"baseline": baseline, "optimised": optimized}
    outlines = {
        "baseline": _outline(given or config, baseline.design),
        "optimised": _outline(config, optimized.design),
    }
    names = [
        _write(folder, "profiles", _profiles(outlines, config)),
        _write(folder, "meshing", _meshing(outlines["optimised"], config, "optimised rotors")),
    ]
    names += _force_figures(folder, designs, config)
    names.append(_write(folder, "comparison", _comparison(designs, outlines, config)))
    if history:
        keys = FAMILY_KEYS[config.profile.family]
        names.append(_write(folder, "history", _history(history, keys)))
    return names


def certificate_figure(
    folder: ResultFolder,
    history: Sequence[Mapping[str, Any]],
    constraints: Sequence[Mapping[str, Any]],
    optimality: Mapping[str, Any],
) -> str:
    """Write optimum.png, the figures of `rootsopt.figures.optimum`; return its name.

    `history`: as in `plot_residual`; `constraints`: as in `plot_prices`; `optimality`: entry of the
    result file."""
    made, axes = figure(14, 4.4, 1, 3, gridspec_kw={"width_ratios": [1, 1, 0.8]})
    plot_residual(axes[0, 0], history, optimality["required_residual"])
    plot_prices(axes[0, 1], constraints, optimality["converged"])
    plot_starts(axes[0, 2], optimality["starts"], optimality["optima"])
    made.suptitle("Certificate of the optimum")
    return _write(folder, "optimum", made)


def _outline(config, design):
    return outline_mm(config, np.asarray([design[key] for key in design_keys(config)]))


def _write(folder, name, made) -> str:
    file = f"figures/{name}.png"
    folder.write_figure(file, made)
    return file


def _profiles(outlines, config):
    radius = config.profile.pitch_radius_mm
    made, axes = figure(13, 5.7, 1, 2, gridspec_kw={"width_ratios": [1, 1.5]})
    plot_profiles(axes[0, 0], outlines, radius)
    plot_flank(axes[0, 1], outlines, config.profile.lobes, radius)
    lines, names = axes[0, 0].get_legend_handles_labels()
    made.legend(lines, names, loc="outside lower center", ncols=len(names), frameon=False)
    made.suptitle(f"Rotor profile{'s' if len(outlines) > 1 else ''}: {' and '.join(outlines)}")
    return made


def _comparison(designs, outlines, config):
    lobes, radius = config.profile.lobes, config.profile.pitch_radius_mm
    series = {name: one.series for name, one in designs.items() if one.series is not None}
    made, axes = figure(12, 4.8, 1, 1 + bool(series))
    before, after = outlines.values()
    plot_departure(axes[0, -1], before, after, lobes, radius)
    if series:
        periods = [one.steady_state.get("period") or lobes for one in designs.values()]
        plot_forces_together(axes[0, 0], series, 2 * np.pi / lobes * min(max(periods), lobes))
    made.suptitle("Optimised design and baseline")
    return made


def _meshing(points, config, what="rotors"):
    lobes = config.profile.lobes
    angles = np.arange(6) * 60 / lobes
    made, axes = figure(11, 5.6, 2, 3, sharex=True, sharey=True)
    plot_meshing(list(axes.ravel()), points, lobes, config.profile.pitch_radius_mm, angles)
    made.supxlabel("x (mm)")
    made.supylabel("y (mm)")
    made.suptitle(f"Meshing of the {what} over one lobe pitch ({360 / lobes:g}°)")
    return made


def _force_figures(folder, designs, config) -> list[str]:
    series = {name: one.series for name, one in designs.items() if one.series is not None}
    if not series:
        return []
    responses, speed = {k: designs[k].response for k in series}, config.scene.speed_rpm
    count, shared = len(series), {"sharex": True, "sharey": True}
    made, axes = figure(10, 1.2 + 2.6 * count, count, 1, **shared)
    plot_force(list(axes[:, 0]), series, responses)
    made.suptitle(f"Contact force over time at {speed:g} rpm")
    names = [_write(folder, "force", made)]
    made, axes = figure(10, 1.4 + 2.6 * count, count, 1, **shared)
    plot_spectrum(list(axes[:, 0]), series, config.profile.lobes * speed / 60)
    made.suptitle(f"Spectrum of the contact force at {speed:g} rpm")
    return [*names, _write(folder, "spectrum", made)]


def _history(history, keys):
    heights = [2.2, *(1.8 if is_list(key) else 1 for key in keys)]
    tall = 9 * sum(heights) / 5.2
    made, axes = figure(
        10, tall, len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights}
    )
    plot_history(list(axes[:, 0]), history, keys)
    made.suptitle("Optimisation history")
    return made
