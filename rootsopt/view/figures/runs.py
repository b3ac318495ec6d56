"""Writes the figures of a command's run into the run's result folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rootsopt.config.families import family_of, is_list
from rootsopt.config.reading import Config
from rootsopt.measured.conjugacy import conjugacy
from rootsopt.response.result import Evaluation
from rootsopt.scene.check import outline_mm
from rootsopt.view.figures.designs import (
    plot_conjugacy,
    plot_departure,
    plot_feasible,
    plot_flank,
    plot_forces_together,
    plot_history,
    plot_meshing,
    plot_profiles,
)
from rootsopt.view.figures.force import plot_force, plot_gap, plot_spectrum
from rootsopt.view.figures.style import figure, write
from rootsopt.view.files import ResultFolder


def profile_figures(folder: ResultFolder, config: Config, record: Mapping[str, Any]) -> None:
    """Write the figures of one design's profile into `folder`.

    `record`: the design's record in the result file. The figures are profiles.png, meshing.png and,
    for a profile read from a file, conjugacy.png."""
    points = outline_mm(config, [*record["design"].values()])
    _profiles(folder, {config.profile.family.upper(): points}, config)
    _meshing(folder, points, config)
    if config.profile.from_file:
        from rootsopt.measured.source import outline_of  # For outlines only: it takes 0.5 s.

        made, axes = figure(8, 4.2)
        mesh = conjugacy(outline_of(config.profile)[0])
        plot_conjugacy(axes[0, 0], {Path(config.profile.outline_file or "").name: mesh})
        axes[0, 0].legend(frameon=False)
        write(folder, "conjugacy", made, "")


def simulation_figures(folder: ResultFolder, evaluation: Evaluation, config: Config) -> None:
    """Write the profile and force figures of an evaluation into `folder`."""
    profile_figures(folder, config, evaluation.record())
    _force_figures(folder, {config.profile.family.upper(): evaluation}, config)


def optimization_figures(
    folder: ResultFolder,
    baseline: Evaluation,
    optimized: Evaluation,
    history: Sequence[Mapping[str, Any]],
    config: Config,
    given: Config | None = None,
) -> None:
    """Write the figures of an optimisation into `folder`.

    `baseline`, `optimized`: evaluations of the design before and after the optimisation. `history`:
    one row per evaluation, as in `plot_history`; if empty, its figure is omitted. `config`: config
    of the optimised design; `given`: that of the baseline, if its profile is of another family."""
    designs = {"baseline": baseline, "optimised": optimized}
    outlines = {
        "baseline": outline_mm(given or config, [*baseline.design.values()]),
        "optimised": outline_mm(config, [*optimized.design.values()]),
    }
    _profiles(folder, outlines, config)
    _meshing(folder, outlines["optimised"], config, "optimised rotors")
    _force_figures(folder, designs, config)
    _comparison(folder, designs, outlines, config)
    if history:
        keys = family_of(config.profile.family).keys
        write(folder, "history", _history(history, keys), "Optimisation history")


def feasible_figure(
    folder: ResultFolder,
    columns: Mapping[str, Sequence[float]],
    design: Mapping[str, float],
    vertex: Mapping[str, Any],
) -> None:
    """Write feasible.png, the designs that the limits leave.

    `columns`: those of `feasible.csv`; `design`: the optimum; `vertex`: entry of the result
    file."""
    made, axes = figure(7.5, 5)
    plot_feasible(axes[0, 0], columns, design, vertex["others"])
    entries = axes[0, 0].get_legend_handles_labels()[0]
    write(folder, "feasible", made, "Designs that satisfy all limits", entries, 3)


def _profiles(folder, outlines, config):
    radius = config.profile.pitch_radius_mm
    made, axes = figure(13, 5.7, 1, 2, gridspec_kw={"width_ratios": [1, 1.5]})
    plot_profiles(axes[0, 0], outlines, radius)
    plot_flank(axes[0, 1], outlines, config.profile.lobes, radius)
    title = f"Rotor profile{'s' if len(outlines) > 1 else ''}: {' and '.join(outlines)}"
    write(folder, "profiles", made, title, axes[0, 0].get_legend_handles_labels()[0])


def _comparison(folder, designs, outlines, config):
    lobes, radius = config.profile.lobes, config.profile.pitch_radius_mm
    series = {name: one.series for name, one in designs.items() if one.series is not None}
    made, axes = figure(12, 4.8, 1, 1 + bool(series))
    before, after = outlines.values()
    plot_departure(axes[0, -1], before, after, lobes, radius)
    if series:
        periods = [one.steady_state.get("period") or lobes for one in designs.values()]
        plot_forces_together(axes[0, 0], series, 2 * np.pi / lobes * min(max(periods), lobes))
    write(folder, "comparison", made, "Optimised design and baseline")


def _meshing(folder, points, config, what="rotors"):
    lobes = config.profile.lobes
    angles = np.arange(6) * 60 / lobes
    made, axes = figure(11, 5.6, 2, 3, grid=False, sharex=True, sharey=True)
    plot_meshing(list(axes.ravel()), points, lobes, config.profile.pitch_radius_mm, angles)
    made.supxlabel("x (mm)")
    made.supylabel("y (mm)")
    write(folder, "meshing", made, f"Meshing of the {what} over one lobe pitch ({360 / lobes:g}°)")


def _force_figures(folder, designs, config) -> None:
    series = {name: one.series for name, one in designs.items() if one.series is not None}
    if not series:
        return
    responses, speed = {k: designs[k].response for k in series}, config.scene.speed_rpm
    count, shared = len(series), {"sharex": True, "sharey": True}
    made, axes = figure(10, 1.2 + 2.6 * count, count, 1, **shared)
    if not any(np.any(one.force) for one in series.values()):
        plot_gap(list(axes[:, 0]), series)
        write(folder, "gap", made, f"Gap of flanks that stay apart at {speed:g} rpm")
        return
    plot_force(list(axes[:, 0]), series, responses)
    write(folder, "force", made, f"Contact force over time at {speed:g} rpm")
    made, axes = figure(10, 1.4 + 2.6 * count, count, 1, **shared)
    plot_spectrum(list(axes[:, 0]), series, config.profile.lobes * speed / 60)
    write(folder, "spectrum", made, f"Spectrum of the contact force at {speed:g} rpm")


def _history(history, keys):
    heights = [2.2, *(1.8 if is_list(key) else 1 for key in keys)]
    tall = 9 * sum(heights) / 5.2
    made, axes = figure(
        10, tall, len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights}
    )
    plot_history(list(axes[:, 0]), history, keys)
    return made
