"""Evaluations as labelled arrays (`xarray.Dataset`)."""

from typing import TYPE_CHECKING

import xarray

if TYPE_CHECKING:
    from rootsopt.response.evaluation import Evaluation

# Columns of the dataset, keyed by the field of a `Series`. Each entry holds the name in CSV files,
# the unit, a long name, and the factor from SI units to this unit.
_COLUMNS = {
    "rotation": ("rotation_deg", "deg", "rotation of rotor 1", 57.29577951308232),
    "relative": ("relative_rotation_rad", "rad", "relative rotation of rotor 2", 1.0),
    "rate": ("relative_speed_rad_s", "rad/s", "relative angular speed of rotor 2", 1.0),
    "drive_force": ("drive_flank_force_N", "N", "normal force on the drive flank", 1.0),
    "coast_force": ("coast_flank_force_N", "N", "normal force on the coast flank", 1.0),
    "force": ("contact_force_N", "N", "contact force: sum of the normal forces", 1.0),
    "depth": ("penetration_m", "m", "greatest penetration; negative: least gap", 1.0),
}


def dataset(evaluation: "Evaluation") -> xarray.Dataset:
    """Return the series of an `evaluation` as a dataset over time, with units and long names.

    Design, geometry, response and status are attributes of the dataset."""
    series = evaluation.series
    assert series is not None
    columns = {
        name: ("time_s", factor * getattr(series, field), {"units": unit, "long_name": long})
        for field, (name, unit, long, factor) in _COLUMNS.items()
    }
    time = ("time_s", series.time, {"units": "s", "long_name": "time"})
    attributes = {
        "status": evaluation.status.label,
        "message": evaluation.message,
        **{f"design_{name}": value for name, value in evaluation.design.items()},
        **evaluation.geometry,
        **evaluation.response,
    }
    return xarray.Dataset(columns, coords={"time_s": time}, attrs=attributes)
