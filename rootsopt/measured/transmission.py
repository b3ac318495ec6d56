"""Reads the measured transmission error of a timing gear."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.sources import FILES, reason, regular_file
from rootsopt.config.units import DEG, UM
from rootsopt.errors import InputError
from rootsopt.measured.table import named_columns

KEY = "scene.timing_gear.transmission_error_file"
"""Key that names the file."""
_COLUMNS = "rotation_deg", "error_um"
_FEWEST, _WIDEST, _MOST = 8, 60.0, 1000.0
"""Least number of rows of a table, greatest step between them (°), greatest error (µm)."""
_SAME = 1e-6, 1e-3
"""Differences of rotation (°) and error (µm) up to which the last row repeats the first."""
_DEGREE = 5
"""Degree of the spline. A lower one would have kinks that slow the closing of orbits."""


def transmission_error(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (knots, powers) of the periodic spline through a table of the transmission error.

    Columns of the table: rotation of rotor 1 (°), and by how much the middle of the backlash is
    ahead on rotor 2 at the pitch circle (µm). `knots` (n,): rotations (rad); `powers` (6, n):
    coefficients (m/rad^k) of the polynomials that continue each knot, highest power first.

    Raises `InputError` if the file cannot be read, or the table is not that of one turn."""
    try:
        data = regular_file(path, FILES[KEY][1]).read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(
            f"`{KEY}` must be a file that can be read, but is {str(path)!r}: {reason(error)}; a "
            "path in a config is relative to the config's folder"
        ) from None
    turned, error = named_columns(data, path.name, _COLUMNS).T
    whole = len(turned) > 1 and abs(turned[-1] - turned[0] - 360) < _SAME[0]
    apart = float(abs(error[-1] - error[0])) if whole else 0.0
    turned, error = (x[: len(x) - whole] for x in (turned, error))
    steps = np.diff(turned, append=turned[:1] + 360)
    widest, most = (float(np.max(x, initial=0)) for x in (steps, np.abs(error)))
    fall = int(np.argmin(steps)) + 1 if len(steps) and np.min(steps) <= 0 else 0
    for holds, wanted, found in (
        (apart <= _SAME[1], "repeat its first error after 360°", f"differs by {apart:g} µm"),
        (len(turned) >= _FEWEST, f"have at least {_FEWEST} rows", f"has {len(turned)}"),
        (not fall, "go once round, with rising rotations", f"does not at row {fall}"),
        (widest <= _WIDEST, f"have a row every {_WIDEST:g}° or less", f"has a gap of {widest:g}°"),
        (most <= _MOST, f"have errors of at most {_MOST:g} µm", f"has one of {most:g} µm"),
    ):
        if not holds:
            raise InputError(f"{path.name}: must {wanted}, but {found}; correct the table")
    from scipy.interpolate import make_interp_spline  # Slow import.

    knots = turned * DEG
    around = np.append(knots, knots[0] + 2 * math.pi), np.append(error, error[0]) * UM
    spline = make_interp_spline(*around, k=_DEGREE, bc_type="periodic")
    orders = range(_DEGREE, -1, -1)
    return knots, np.array([spline(knots, order) / math.factorial(order) for order in orders])


__all__ = ["transmission_error"]
