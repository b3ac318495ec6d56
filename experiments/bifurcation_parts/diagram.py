"""Branches of one pair over one parameter: how they are found, and what is stable where."""

import dataclasses
import itertools
import sys
from collections.abc import Iterator

import numpy as np

from rootsopt import continuation
from rootsopt.config import Config
from rootsopt.continuation import Branch, End, Kind, Steps
from rootsopt.errors import InputError
from rootsopt.evaluate import Evaluator

QUIET = 4.0
"""An orbit is quiet up to this peak force, in units of the force that carries the load at the pitch
radius; beyond, the flanks hammer."""
POINTS, FEWEST = 100, 25
"""Mesh periods in all points of a branch, and the least number of points allowed."""
LONGEST, DOUBLED = 4, 2
"""Longest orbit followed where a simulation reaches it, and where another one doubles to it."""
CELLS = 570
"""Parts of a range in which quiet and noisy orbits are looked for."""


@dataclasses.dataclass
class Diagram:
    """Branches of one pair in one scene over one parameter; `seeds`: what the evaluations that
    looked for orbits came to, as (value, status)."""

    scene: str
    family: str
    parameter: str
    low: float
    high: float
    branches: list[Branch]
    seeds: list[tuple[float, str]]


def explore(
    scene: str, config: Config, parameter: str, low: float, high: float, seeds: int, starts: tuple
) -> Diagram:
    """Follow all orbits that can be reached from the starts at so many values."""
    diagram = Diagram(scene, config.profile.family, parameter, low, high, [], [])
    for value in np.linspace(low, high, seeds + 2)[1:-1]:
        here = continuation.with_value(config, parameter, float(value))
        patient, hasty = Evaluator(here), Evaluator(here, survey=True)
        found: list[tuple[float, float]] = []
        for number, start in enumerate(starts):
            # A chaotic motion takes long to tell, and need not be told from everywhere.
            evaluator = hasty if number else patient
            evaluation = evaluator(start=np.array(start), series=False)
            diagram.seeds.append((float(value), evaluation.status.label))
            if not evaluation.usable or evaluation.state is None:
                continue
            forces = evaluation.response["mean_force_N"], evaluation.response["peak_force_N"]
            if any(np.allclose(forces, other, rtol=1e-3) for other in found):
                continue
            found.append(forces)
            follow_on(diagram, here, evaluation.state, evaluation.steady_state["period"], forces)
    return diagram


def follow_on(diagram: Diagram, config: Config, state, period: int, forces) -> None:
    """Follow an orbit, and those it doubles to or came from, unless they are known."""
    value = continuation.value_of(config, diagram.parameter)
    if period > LONGEST or known(diagram, value, period, forces):
        return
    try:
        first = continuation.follow(
            config, diagram.parameter, state, period, limits(diagram, period)
        )
    except InputError as error:
        print(f"{value:g}: {error}", file=sys.stderr)
        return
    queue = [first]
    while queue:
        branch = queue.pop(0)
        diagram.branches.append(branch)
        note(diagram, branch)
        for special in branch.bifurcations:
            doubling = special.kind is Kind.PERIOD_DOUBLING
            # A longer orbit born where the simple one was unstable before is unstable too.
            if 2 * branch.period > DOUBLED or not doubling:
                continue
            if not any(p.stable for p in beside(branch, special)):
                continue
            doubled = continuation.follow_doubled(
                branch, special, limits(diagram, 2 * branch.period)
            )
            if doubled is not None and not known_branch([*diagram.branches, *queue], doubled):
                queue.append(doubled)
        for end, point in zip(branch.ends, (branch.points[0], branch.points[-1]), strict=True):
            if end is End.HALVED:
                here = continuation.with_value(config, diagram.parameter, point.value)
                half = branch.period // 2
                try:
                    simple = continuation.follow(
                        here, diagram.parameter, point.state, half, limits(diagram, half)
                    )
                except InputError:
                    continue
                if not known_branch([*diagram.branches, *queue], simple):
                    queue.append(simple)


def beside(branch: Branch, special) -> tuple:
    return branch.points[special.after : special.after + 2]


def limits(diagram: Diagram, period: int) -> Steps:
    return Steps(diagram.low, diagram.high, points=max(POINTS // period, FEWEST))


def known(diagram: Diagram, value: float, period: int, forces) -> bool:
    """Whether a branch of the diagram has this orbit."""
    return any(
        np.allclose(forces, (point.mean, point.peak), rtol=1e-3)
        for branch in diagram.branches
        if branch.period == period
        for point in branch.at(value)
    )


def known_branch(branches: list[Branch], new: Branch) -> bool:
    """Whether the middle of a branch lies on another one of the same period."""
    middle = new.points[len(new.points) // 2]
    return any(
        np.allclose((middle.mean, middle.peak), (point.mean, point.peak), rtol=1e-3)
        for branch in branches
        if branch.period == new.period
        for point in branch.at(middle.value)
    )


def note(diagram: Diagram, branch: Branch) -> None:
    ends = " and ".join(end.name.lower().replace("_", " ") for end in branch.ends)
    values = [point.value for point in branch.points]
    print(
        f"{diagram.scene} {diagram.family} {diagram.parameter}: period {branch.period}, "
        f"{len(values)} points in {min(values):.5g} … {max(values):.5g}, "
        f"{len(branch.bifurcations)} special, ends: {ends}",
        file=sys.stderr,
    )


def ranges(diagram: Diagram) -> dict[str, list[list[float]]]:
    """Ranges of the parameter with a stable quiet orbit, a stable noisy one, both, and none."""
    edges = np.linspace(diagram.low, diagram.high, CELLS + 1)
    centres = (edges[1:] + edges[:-1]) / 2
    quiet, noisy = np.zeros(CELLS, bool), np.zeros(CELLS, bool)
    for branch in diagram.branches:
        for old, new in itertools.pairwise(branch.points):
            if not (old.stable and new.stable):
                continue
            (low, a), (high, b) = sorted((p.value, peak_ratio(branch, p)) for p in (old, new))
            inside = (centres >= low) & (centres <= high)
            ratio = np.interp(centres[inside], [low, high], [a, b])
            quiet[inside] |= ratio <= QUIET
            noisy[inside] |= ratio > QUIET
    found = {"quiet": quiet, "noisy": noisy, "both": quiet & noisy, "none": ~(quiet | noisy)}
    return {name: list(runs(mask, edges)) for name, mask in found.items()}


def peak_ratio(branch: Branch, point) -> float:
    """Peak force in units of the static one."""
    torque = branch.config.scene.load.torque_N_m
    torque = point.value if branch.parameter == "torque_N_m" else torque
    assert torque is not None  # Scenes here have a constant load.
    return point.peak / (torque / (branch.config.profile.pitch_radius_mm * 1e-3))


def runs(mask: np.ndarray, edges: np.ndarray) -> Iterator[list[float]]:
    change = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    for begin, end in change.reshape(-1, 2):
        yield [float(edges[begin]), float(edges[end])]


def overlaps(diagram: Diagram) -> list[list[float]]:
    """Ranges in which more than one stable orbit exists, quiet or noisy."""
    edges = np.linspace(diagram.low, diagram.high, CELLS + 1)
    centres = (edges[1:] + edges[:-1]) / 2
    count = np.zeros(CELLS, int)
    for branch in diagram.branches:
        for old, new in itertools.pairwise(branch.points):
            if old.stable and new.stable:
                low, high = sorted((old.value, new.value))
                count += (centres > low) & (centres <= high)
    return list(runs(count > 1, edges))
