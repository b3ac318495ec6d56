"""`rootsopt profile`: compute the geometry of one design, and write drawings and figures."""

import argparse
from typing import Any

from rootsopt.commands import cli
from rootsopt.config.reading import Config
from rootsopt.measured import conjugacy
from rootsopt.profiles import Profile, geometry
from rootsopt.pump.sheet import sheet
from rootsopt.response.records import geometry_record
from rootsopt.scene.build import Scene
from rootsopt.scene.check import check_geometry, outline_mm
from rootsopt.scene.families import free_form_of, margins_of
from rootsopt.scene.reading import design_vector
from rootsopt.scene.resemblance import free_likeness, likenesses
from rootsopt.status import Status
from rootsopt.view import files
from rootsopt.view.figures import chosen
from rootsopt.view.figures.writing import write
from rootsopt.view.runs import RunFolder


def body(config: Config, options: argparse.Namespace, folder: RunFolder) -> cli.Outcome:
    """Run `rootsopt profile`: compute the geometry, and write files into `folder`.

    Return the `Outcome`. Raises `InputError` if the config or an option is invalid."""
    formats = chosen(options.export)
    check_geometry(config, simulated=False)
    scene, design = Scene.from_config(config), design_vector(config)
    shape = geometry(scene.profile(design))
    record = {
        "design": dict(zip(config.design_keys, map(float, design), strict=True)),
        "geometry": geometry_record(scene, shape),
        "response": {},
        "gradient": {},
        "steady_state": {},
        "status": Status.GEOMETRY_ONLY.label,
        "message": Status.GEOMETRY_ONLY.value,
        "statistics": {},
    }
    if margins := margins_of(config.profile):
        record["margins"] = margins
    record |= conjugacy.record(config)
    record["pump"] = sheet(scene, design)
    folder.write_csv("profile_design.csv", files.profile_columns(outline_mm(config)))
    write(folder, config, formats, record["design"])
    if not options.no_figures:
        from rootsopt.view.figures import runs

        runs.profile_figures(folder, config, record)
    alike = resembles(scene.profile(design)) if options.resembles else []
    if alike:
        record["resembles"] = alike
    lines = conjugacy.notes(config)
    if options.project is not None:
        lines.append(_projected(folder, config, options.project))
    return cli.Outcome(True, record, lines)


def resembles(profile: Profile) -> list[dict[str, Any]]:
    """Return the records of the member of each family that is nearest to a profile, nearest first.

    The families are the classical ones and, last, the free form."""
    named = likenesses(profile)
    free = free_likeness(profile, *named[:2])
    return [one.record() for one in (*named, *([] if free is None else [free]))]


def _projected(folder: RunFolder, config: Config, count: int) -> str:
    """Write free_form.yaml: the config with its profile approximated by a free form.

    `count`: number of coefficients of the free form. Return a message for the user."""
    profile, away = free_form_of(config.profile, count)
    folder.write_text("free_form.yaml", config.model_copy(update={"profile": profile}).to_yaml())
    return (
        f"as a free form of {count} coefficients, at most {away * 1e6:.3g} µm away from this "
        f"outline: {folder.path / 'free_form.yaml'}"
    )
