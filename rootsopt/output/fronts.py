"""Writes a front into a result folder: front.csv, and the config of each point."""

from rootsopt.output.files import ResultFolder, row_columns
from rootsopt.tradeoffs.front import Front


def design_file(point: int) -> str:
    """Return the name of the file with the config of the point with this number."""
    return f"designs/point_{point:02d}.yaml"


def write_front(folder: ResultFolder, front: Front) -> None:
    """Write front.csv and one config per point into `folder`; do nothing without points."""
    if not front.points:
        return
    folder.write_csv("front.csv", row_columns([point.row() for point in front.points]))
    for point in front.points:
        folder.write_text(design_file(point.number), front.config_of(point).to_yaml())


__all__ = ["design_file", "write_front"]
