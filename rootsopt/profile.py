"""`python -m rootsopt.profile CONFIG`: geometry only."""

import argparse
import sys
from collections.abc import Sequence

from rootsopt import cli, export
from rootsopt.config import Config

PURPOSE = "Geometry of one design: radii, area, inertia, margins; drawings, solids, animation."
EXPORT = "dxf,svg"
"""What is written if nothing is said: a drawing takes less than a second, a solid ten."""


def body(config: Config, options: argparse.Namespace) -> int:
    """Check, measure, write, print."""
    from rich.console import Console

    from rootsopt import files, report
    from rootsopt.evaluate import geometry_record
    from rootsopt.model import Model, check_geometry, design_keys, design_vector, outline_mm
    from rootsopt.outline import report as outline_report
    from rootsopt.profiles import geometry
    from rootsopt.status import Status

    formats = export.chosen(options.export)
    check_geometry(config)
    folder = files.ResultFolder(options.output)
    model, design = Model.of(config), design_vector(config)
    shape = geometry(model.profile(design))
    record = {
        "design": dict(zip(design_keys(config), map(float, design), strict=True)),
        "geometry": geometry_record(model, shape),
        "response": {},
        "gradient": {},
        "steady_state": {},
        "status": Status.GEOMETRY_ONLY.label,
        "message": Status.GEOMETRY_ONLY.value,
        "statistics": {},
    }
    record |= outline_report.record(config)
    files.write_config(folder, config)
    folder.write_csv("profile_design.csv", files.profile_columns(outline_mm(config)))
    folder.write_json("result.json", record | {"versions": files.versions()})
    export.write(folder, config, formats, record["design"])
    if not options.no_figures:
        from rootsopt import plot

        plot.profile_figures(folder, config, record)
    out = Console()
    out.print(report.geometry_table(record))
    outline_report.say(config, out)
    out.print(f"results in {options.output}", soft_wrap=True)
    return cli.OK


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run("profile", PURPOSE, body, argv, lambda p: export.add_option(p, EXPORT))


if __name__ == "__main__":
    sys.exit(main())
