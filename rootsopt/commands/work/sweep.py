"""The work of `rootsopt sweep`."""

import argparse
import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import Progress

from rootsopt.commands import cli
from rootsopt.config import Config
from rootsopt.errors import InputError
from rootsopt.output import files, tables, terminal
from rootsopt.output.runs import RunFolder
from rootsopt.response import speeds
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.reducers import overall
from rootsopt.scene import check_geometry, design_keys, design_vector


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt sweep`: simulate the design at all speeds, and write files into `folder`.

    With `--over` or `--tolerances`, sweep any keys instead. Return the `Outcome`. Raises
    `InputError` if the config is invalid."""
    if options.over or options.tolerances is not None:
        from rootsopt.commands.work import over  # xarray and its figures take time to import.

        return over.body(config, options, folder)
    refuse_options(options)
    check_geometry(config)
    cli.load_figures(options, "speeds")
    swept = speeds.swept_speeds(config)
    with _progress(Console(stderr=True), len(swept)) as progress:
        evaluator = Evaluator.of_objective(speeds.alone(config)).without_gradient()
        parts = evaluator.swept(swept, progress=progress)
    rows = [part.row(whole=True) for part in parts]
    status, message = overall(parts)
    files.write_config(folder, config)
    folder.write_csv("sweep.csv", files.row_columns(rows))
    data = {
        "design": dict(zip(design_keys(config), map(float, design_vector(config)), strict=True)),
        "geometry": parts[0].evaluation.geometry,
        "speeds": rows,
        "status": status.label,
        "message": message,
        "versions": files.versions(),
    }
    folder.write_json("result.json", data)
    if not options.no_figures:
        from rootsopt.figures.sweep import speed_figure

        name = config.profile.family.upper()
        speed_figure(folder, {name: parts}, f"Contact force of the {name} pair over speed")

    def show(out: Console) -> None:
        out.print(terminal.shown(tables.tables_of(data, most=len(rows))))

    usable = any(part.evaluation.usable for part in parts)
    return cli.Outcome(cli.OK if usable else cli.NO_RESULT, show)


def refuse_options(options: argparse.Namespace) -> None:
    """Raise `InputError` if an option that needs `--over` is given without `--over`."""
    names = "zip", "zip_keys", "sample", "sobol", "seed", "data", "workers", "scheduler", "resume"
    for name in names:
        if getattr(options, name) not in (None, False, []):
            raise InputError(
                f"`--{name.replace('_', '-')}` needs keys to sweep; add `--over KEY=VALUES`, as in "
                "--over scene.speed_rpm=300:6000:39"
            )


@contextlib.contextmanager
def _progress(console, expected: int) -> Iterator[Callable[[int], None]]:
    """Yield a function (done) that updates a progress bar.

    If the console is not a terminal, there is no progress bar and the function does nothing."""
    if not console.is_terminal:
        yield lambda done: None
        return

    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("compiling and simulating", total=None)
        yield lambda done: bar.update(task, completed=done, total=expected)
