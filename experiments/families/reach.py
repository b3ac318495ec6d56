"""Finds the feasible designs of a profile family in a housing, and the range of their area
efficiency.

The *reach* of a family is a set of feasible designs, including those with the least and the
greatest area efficiency. Only geometry is computed, no motion.
"""

from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from experiments._common.simulation import feasible, profile_of
from rootsopt.config import Config
from rootsopt.config.families import family_of
from rootsopt.config.study import limits_of
from rootsopt.config.units import MM
from rootsopt.optimize.problem import Problem
from rootsopt.profiles import geometry
from rootsopt.scene import Scene
from rootsopt.scene.space import Space, sobol

# Clearance (mm) between tip and bore above which a rotor does not fill the bore.
BAND_MM = 1e-3

# Number of points of a family's unit box from which starting designs are chosen.
SAMPLE = 256
STARTS = 4

# Smallest value (fraction of the upper bound) of a parameter that must not be 0.
_LEAST_SHARE = 1e-3

# Margin by which constraints must hold in the search for the extremes of area efficiency.
_CLOSE = 1e-7


class Reach(NamedTuple):
    """Feasible designs of a family: points (n, d) of its unit box, and area efficiencies (n,), best
    last."""

    points: NDArray[np.float64]
    efficiencies: NDArray[np.float64]


def of_family(reference: Config, family: str) -> Config:
    """Return the reference config with a profile of a classical `family` and the same pitch radius.

    The parameters of the profile are in the middle of their usual bounds.
    """
    size = reference.profile.pitch_radius_mm, reference.profile.lobes
    bounds: dict[str, Any] = {}
    for parameter in family_of(family).parameters:
        low, high = parameter.usually(*size)
        least = 0.0 if parameter.key == "tip_arc_angle_deg" else max(low, _LEAST_SHARE * high)
        bounds[parameter.key] = (least, high)
    middle = {key: sum(pair) / 2 for key, pair in bounds.items()}
    return changed(
        reference,
        profile={"family": family, "pitch_radius_mm": size[0], "lobes": size[1]} | middle,
        optimizer={"bounds": bounds},
    )


def changed(config: Config, **sections: dict[str, Any]) -> Config:
    """Return `config` with other values in some `sections`; the profile is replaced completely."""
    data = config.model_dump()
    for section, values in sections.items():
        data[section] = values if section == "profile" else data[section] | values
    return Config.model_validate(data)


def in_housing(
    config: Config, bore_radius_mm: float, area_efficiency: float, seal_width_mm: float
) -> Config:
    """Return `config` with the constraints of a housing.

    The rotors must fill the bore, and have at least the given area efficiency and tip land."""
    return changed(
        config,
        constraints={
            "area_efficiency_min": area_efficiency,
            "outer_radius_min_mm": bore_radius_mm - BAND_MM,
            "outer_radius_max_mm": bore_radius_mm,
            "seal_width_min_mm": seal_width_mm,
            "undercut_margin_min_mm": 0.0,
        },
    )


def problem_of(config: Config) -> Problem:
    """Return the design problem of a config for geometry alone, without an evaluated baseline."""
    return Problem(config, cast(Any, None), Space.of(config, Scene.from_config(config)))


def reach(config: Config, sample: int = SAMPLE) -> Reach | None:
    """Find feasible designs of a family in the housing of a config, at any area efficiency.

    `sample` points of a Sobol sequence are projected onto the constraints. From these designs, a
    search finds the maximum and minimum area efficiency. The result is `None` if the family does
    not fit into the housing.
    """
    size = len(config.design_keys)
    if size == 0:
        return _only(config)
    problem = problem_of(config)
    points = feasible(problem, sobol(sample, 0, size))
    if not points:
        return None
    order = np.argsort([_efficiency(problem, point) for point in points])
    ends = [points[k] for k in {*order[:STARTS], *order[-STARTS:]}]
    climbed = [_extreme(problem, point, sign) for point in ends for sign in (1.0, -1.0)]
    points += [point for point in climbed if problem.feasible(point)]
    found = np.array([_efficiency(problem, point) for point in points])
    order = np.argsort(found)
    return Reach(np.array(points)[order], found[order])


def _only(config: Config) -> Reach | None:
    """Return the reach of a family without design parameters, or `None` if it does not fit."""
    shape = geometry(profile_of(config))
    limits = config.constraints
    low, high = limits_of(limits.outer_radius_min_mm, limits.outer_radius_max_mm)
    if not low <= round(float(shape.outer_radius) / MM, 9) <= high:
        return None
    return Reach(np.zeros((1, 0)), np.array([float(shape.area_efficiency)]))


def _efficiency(problem: Problem, point) -> float:
    """Return the area efficiency at a point (d,) of the unit box, -inf if it is NaN."""
    first = problem.space.constraints[0]
    assert first.quantity == "area_efficiency"
    value = float(problem.look(point)[2][0]) * first.scale + float(first.limit)
    return value if np.isfinite(value) else -np.inf


def _extreme(problem: Problem, start, sign: float) -> NDArray[np.float64]:
    """Return the point with maximum (`sign` 1) or minimum (-1) area efficiency near `start`
    (d,)."""

    def goal(point):
        return -sign * problem.look(point)[2][0], -sign * problem.look(point)[3][0]

    found = minimize(
        goal,
        start,
        jac=True,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * len(start),
        constraints={
            "type": "ineq",
            "fun": lambda point: problem.look(point)[2][1:] - _CLOSE,
            "jac": lambda point: problem.look(point)[3][1:],
        },
        options={"maxiter": 60},
    )
    return problem.project(found.x if np.all(np.isfinite(found.x)) else start)
