"""Optimises a free form from the best CIC, and measures what it gains and where it departs.

The baseline of the config is the projection of the best CIC. Both designs are measured by the
objective of `configs/cic.yaml`, relative to the paper's CIC.
"""

import dataclasses
from typing import Any

import numpy as np

from experiments._common.driver import NoResultError
from experiments._common.scenes import CIC
from experiments._common.simulation import evaluate, objective, profile_of
from rootsopt.config import Config, load
from rootsopt.design.resemblance import likenesses
from rootsopt.optimize.search import Search
from rootsopt.profiles import Profile
from rootsopt.profiles.departure import departure, flank_points
from rootsopt.scene.families import with_design

CONFIG = "configs/free.yaml"
MM, UM = 1e-3, 1e-6


def signed_departures(profile: Profile, other: Profile) -> tuple[np.ndarray, np.ndarray]:
    """Measure how far the flank of `profile` departs from the flank of `other`.

    Returns radii (n,) in mm of points on the flank of `other`, and signed distances (n,) in µm from
    these points along the normal. A distance is NaN if the normal does not meet `profile`.
    """
    points = flank_points(other) / MM @ [1, 1j]
    line = flank_points(profile) / MM @ [1, 1j]
    along = np.gradient(points)
    normal = -1j * along / np.abs(along)
    away = np.full(len(points), np.nan)
    for k, (place, outward) in enumerate(zip(points, normal, strict=True)):
        local = (line - place) * np.conj(outward)
        cross = np.flatnonzero((local.imag[:-1] <= 0) != (local.imag[1:] <= 0))
        if len(cross):
            share = local.imag[cross] / (local.imag[cross] - local.imag[cross + 1])
            height = local.real[cross] + share * (local.real[cross + 1] - local.real[cross])
            away[k] = height[np.argmin(np.abs(height))] * MM / UM
    return np.abs(points), away


@dataclasses.dataclass(frozen=True)
class Results:
    """Results of the study.

    Fields: the profiles before and after the search, the result of the search, the config with the
    optimised design, and a record that compares both designs with the paper's.
    """

    start: Profile
    found: Profile
    config: Config
    record: dict[str, Any]


def run(quick: bool, config: str = CONFIG) -> Results:
    """Optimise the free form of a config, and compare it with its baseline and the paper's CIC.

    Raises `NoResultError` if the search finds no better design.
    """
    settings = load(config, ["optimizer.iterations=4"] if quick else [])
    paper = evaluate(load(CIC))
    result = Search(settings).run()
    if result.optimized is None:
        raise NoResultError("the search found nothing better; raise optimizer.iterations")
    start, found = (
        profile_of(settings, list(one.design.values()))
        for one in (result.baseline, result.optimized)
    )
    profile = with_design(settings.profile, list(result.optimized.design.values()))
    designs = {"paper": paper, "best CIC": result.baseline, "free form": result.optimized}
    record = {
        "designs": {
            name: {"objective": objective(one, paper.response), **one.response, **one.geometry}
            for name, one in designs.items()
        },
        "evaluations": len(result.history),
        "optimality": {} if result.optimality is None else result.optimality.record(),
        "departure_um": departure(found, start) / UM,
        "resembles": [] if quick else [one.record() for one in likenesses(found)],
    }
    return Results(start, found, settings.model_copy(update={"profile": profile}), record)
