"""`rootsopt identify`: fit quantities of a scene to a measured record, and write the files."""

import argparse

from rootsopt.commands import cli
from rootsopt.config.reading import Config
from rootsopt.errors import InputError
from rootsopt.identification.fit import identify
from rootsopt.view.runs import RunFolder


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt identify`: fit quantities to the record, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if the config, the record or an option is invalid."""
    for name, example in (
        ("data", "record.csv"),
        ("fit", "scene.timing_gear.backlash_mm=0.02:0.4"),
    ):
        if not getattr(options, name):
            raise InputError(f"`--{name}` is missing; add it, as in --{name} {example}")
    with cli.waiting("compiling and simulating") as progress:
        fit = identify(
            config, options.data, options.fit, gains=[text.split(",") for text in options.gain],
            constants=options.constant, profiles=options.profile, starts=options.starts,
            seed=options.seed, progress=progress,
        )  # fmt: skip
    if fit.parameters:
        folder.write_text("identified.yaml", fit.config.to_yaml())
        folder.write_csv("residuals.csv", fit.residuals)
    if fit.parameters and not options.no_figures:
        from rootsopt.view.figures.force import identified_figure

        identified_figure(folder, fit)

    return cli.Outcome(fit.status.usable, fit.record())
