"""Follows the periodic orbits of both rotor pairs over speed, load, backlash and design.

The study simulates from rest and from up to five other states, at a few values of a parameter. It
follows every periodic orbit found over the whole range of the parameter, stable or not, through
folds and period doublings (`rootsopt.continuation`). It reports where a stable quiet orbit exists,
where a stable noisy orbit exists, and where both do.
"""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from experiments._common.driver import Run
from experiments._common.scenes import shipped
from experiments._common.simulation import evaluator_of
from experiments._common.tables import Row
from rootsopt.config import Config
from rootsopt.continuation import Branch, End, Kind, StepSizes, follow, follow_doubled
from rootsopt.errors import InputError

Say = Callable[[str], None]

# Scaled initial states (ε, dε/dt) tried at every value of the parameter.
STARTS = ((0.0, 0.0), (-0.2, -1.8), (-1.0, 0.0), (-3.0, 0.0), (0.8, 5.0), (-0.5, -8.0))
LIVELY = ("scene.timing_gear.backlash_mm=0.2", "scene.timing_gear.damping_ratio=0.2")
SPEED, TORQUE = "scene.speed_rpm", "scene.load.torque_N_m"
SCENES = {"shipped": (), "livelier": LIVELY}

# Lowest speed (rpm) studied, by pair. At lower speeds the livelier pair bounces so often per mesh
# period that its orbits can hardly be followed.
SLOWEST = {"shipped": 300, "livelier": 3500}

# Peak force (units of the static force that carries the load at the pitch radius) above which an
# orbit counts as noisy: the flanks hammer.
QUIET = 4.0

# Sum of the periods (mesh periods) of all points above which a branch ends. The second number is
# the number of points that every branch may have.
POINTS, FEWEST = 200, 25

# Longest orbits followed (mesh periods): if found by a simulation, and if born at a period
# doubling.
LONGEST, DOUBLED = 4, 2

# Number of cells into which a parameter's range is divided to find quiet and noisy orbits.
CELLS = 570


@dataclasses.dataclass
class Diagram:
    """Branches of one pair in one scene over one parameter, and what they are found from.

    `scene`: its name; `key`: dotted key of the parameter, from `low` to `high`; `values`: number of
    values of the parameter at which simulations begin; `starts`: scaled initial states tried at
    each value; `branches`: those followed; `seeds`: (value of the parameter, status) of each
    simulation that searched for orbits.
    """

    scene: str
    config: Config
    key: str
    low: float
    high: float
    values: int
    starts: tuple[tuple[float, float], ...]
    branches: list[Branch] = dataclasses.field(default_factory=list)
    seeds: list[tuple[float, str]] = dataclasses.field(default_factory=list)

    @property
    def names(self) -> Row:
        """Names of scene, family and parameter: the last part of its key."""
        family, parameter = self.config.profile.family, self.key.rpartition(".")[2]
        return {"scene": self.scene, "family": family, "parameter": parameter}

    @property
    def title(self) -> str:
        """The names in one line."""
        return " ".join(self.names.values())


def plans(quick: bool) -> list[Diagram]:
    """Return all diagrams of a full or reduced run, still empty."""
    if quick:
        config = shipped("cic", *LIVELY)
        spans = (SPEED, 3500, 4500), (TORQUE, 4.5, 5.0)
        return [Diagram("livelier", config, *span, 1, STARTS[1:2]) for span in spans]
    cic = shipped("cic")
    return [
        *(
            Diagram(scene, shipped(name, *more), SPEED, SLOWEST[scene], 6000, 6, STARTS[:3])
            for (scene, more), name in itertools.product(SCENES.items(), ("cic", "ee"))
        ),
        Diagram("shipped", cic, TORQUE, 0.5, 10.0, 2, STARTS[:2]),
        Diagram("shipped", cic, "scene.timing_gear.backlash_mm", 0.02, 0.4, 4, STARTS[:2]),
        Diagram("shipped", cic, "profile.involute_length_mm", 1.0, 9.0, 2, STARTS[:2]),
    ]


def explore(diagram: Diagram, say: Say) -> None:
    """Simulate from all starts of a diagram, and add the branch of every orbit found."""
    for value in np.linspace(diagram.low, diagram.high, diagram.values + 2)[1:-1]:
        here = diagram.config.moved({diagram.key: float(value)})
        found: list[tuple[float, float]] = []
        for number, start in enumerate(diagram.starts):
            # A chaotic motion takes long to recognise, and one start is enough for that.
            evaluator = evaluator_of(here, give_up_early=number > 0)
            evaluation = evaluator(start=np.array(start), series=False)
            diagram.seeds.append((float(value), evaluation.status.label))
            if not evaluation.usable or evaluation.state is None:
                continue
            forces = evaluation.response["mean_force_N"], evaluation.response["peak_force_N"]
            if any(np.allclose(forces, other, rtol=1e-3) for other in found):
                continue
            found.append(forces)
            period = evaluation.steady_state["period"]
            follow_on(diagram, (here, float(value)), evaluation.state, period, forces, say)


def follow_on(
    diagram: Diagram, at: tuple[Config, float], state, period: int, forces, say: Say
) -> None:
    """Follow an orbit, and the orbits related to it by period doubling, unless they are known.

    `at`: config, and value of the parameter; `state` (scaled), `period` and `forces` identify the
    orbit. Branches are added to `diagram`."""
    config, value = at
    if period > LONGEST or known(diagram.branches, value, period, forces):
        return

    def followed(config: Config, state: Any, period: int) -> Branch | None:
        sizes = StepSizes(diagram.low, diagram.high, points=points(period))
        try:
            return follow(config, diagram.key, state, period, sizes)
        except InputError as error:
            return say(f"{value:g}: {error}")

    def already(branch: Branch) -> bool:
        middle = branch.points[len(branch.points) // 2]
        own = middle.value, branch.family.period, (middle.mean, middle.peak)
        return known(diagram.branches, *own)

    first = followed(config, state, period)
    queue = [first]
    while queue:
        branch = queue.pop(0)
        if branch is None or (branch is not first and already(branch)):
            continue
        diagram.branches.append(branch)
        say(f"{diagram.title}: {described(branch)}")
        half, twice = branch.family.period // 2, 2 * branch.family.period
        for special in branch.bifurcations:
            # If the orbit of single period was unstable before, the doubled orbit is unstable too.
            stable = any(point.stable for point in beside(branch, special))
            if twice <= DOUBLED and special.kind is Kind.PERIOD_DOUBLING and stable:
                queue.append(follow_doubled(branch, special, points(twice)))
        for end, point in zip(branch.ends, (branch.points[0], branch.points[-1]), strict=True):
            if end is End.HALVED:
                here = config.moved({diagram.key: point.value})
                queue.append(followed(here, point.state, half))


def beside(branch: Branch, special) -> tuple:
    """Return the two points of a branch on both sides of a `special` point."""
    return branch.points[special.after : special.after + 2]


def points(period: int) -> int:
    """Return the maximum number of points of a branch of this `period`."""
    return max(POINTS // period, FEWEST)


def known(branches: list[Branch], value: float, period: int, forces) -> bool:
    """Return whether one of the `branches` contains the orbit with this `period` and `forces`."""
    return any(
        np.allclose(forces, (point.mean, point.peak), rtol=1e-3)
        for branch in branches
        if branch.family.period == period
        for point in branch.at(value)
    )


def described(branch: Branch) -> str:
    """Describe a branch in one line."""
    ends = " and ".join(end.name.lower().replace("_", " ") for end in branch.ends)
    values = [point.value for point in branch.points]
    return (
        f"period {branch.family.period}, "
        f"{len(values)} points in {min(values):.5g} … {max(values):.5g}, "
        f"{len(branch.bifurcations)} special, ends: {ends}"
    )


def ranges(diagram: Diagram) -> dict[str, list[list[float]]]:
    """Return the ranges of the parameter with stable orbits.

    Keys: `quiet`, `noisy`, `both`, `none`, and `several` for more than one, quiet or noisy."""
    edges = np.linspace(diagram.low, diagram.high, CELLS + 1)
    centres = (edges[1:] + edges[:-1]) / 2
    # Numbers of stable orbits in each cell: quiet and noisy ones.
    counts = np.zeros((2, CELLS), int)
    for branch in diagram.branches:
        for pair in itertools.pairwise(branch.points):
            if all(point.stable for point in pair):
                (low, a), (high, b) = sorted((p.value, peak_ratio(branch, p)) for p in pair)
                inside = (centres > low) & (centres <= high)
                noise = np.interp(centres, [low, high], [a, b]) > QUIET
                counts += inside & np.stack([~noise, noise])
    quiet, noisy = counts > 0
    found = {"quiet": quiet, "noisy": noisy, "both": quiet & noisy, "none": ~(quiet | noisy)}
    found["several"] = counts.sum(axis=0) > 1
    return {name: runs(mask, edges) for name, mask in found.items()}


def peak_ratio(branch: Branch, point) -> float:
    """Return the ratio of an orbit's peak force to the static force that carries the load."""
    config = branch.family.config
    torque = point.value if branch.family.key == TORQUE else config.scene.load.torque_N_m
    assert torque is not None  # Scenes here have a constant load.
    return point.peak / (torque / (config.profile.pitch_radius_mm * 1e-3))


def runs(mask: np.ndarray, edges: np.ndarray) -> list[list[float]]:
    """Return both ends of every run of true cells; `edges`: ends of all cells."""
    change = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return edges[change].reshape(-1, 2).tolist()


# Rows and record


def tables_of(diagrams: list[Diagram]) -> tuple[list[Row], list[Row]]:
    """Return a row for every point of every branch, and for every bifurcation and corner."""
    points, specials = [], []
    for diagram in diagrams:
        for number, branch in enumerate(diagram.branches):
            where = diagram.names | {"branch": number}
            points += [where | orbit_row(point) for point in branch.points]
            for special in branch.bifurcations:
                kind = {"kind": special.kind.name.lower()}
                specials.append(where | kind | orbit_row(special.point))
    return points, specials


def orbit_row(point) -> Row:
    """Return the columns of a row that describe an orbit."""
    parts = np.stack([np.real(point.multipliers), np.imag(point.multipliers)], axis=1).ravel()
    names = (f"multiplier_{k}_{x}" for k in range(1, 1 + len(parts) // 2) for x in ("real", "imag"))
    return {
        "value": point.value,
        "period": point.period,
        "mean_force_N": point.mean,
        "peak_force_N": point.peak,
        "rms_force_N": point.rms,
        "stable": point.stable,
        "residual": point.residual,
        **dict(zip(names, parts.tolist(), strict=True)),
    }


def summary(diagrams: list[Diagram], points: list[Row]) -> dict[str, Any]:
    """Return ranges, branches, and the simulations that led to no periodic orbit.

    `points`: rows of all points."""
    return {
        "quiet_up_to_static_forces": QUIET,
        "diagrams": [
            diagram.names
            | {
                "range": [diagram.low, diagram.high],
                "stable": ranges(diagram),
                "branches": [
                    {
                        "period": branch.family.period,
                        "points": len(branch.points),
                        "ends": [end.name.lower() for end in branch.ends],
                    }
                    for branch in diagram.branches
                ],
                "without_periodic_orbit": sorted(
                    {seed for seed in diagram.seeds if seed[1] != "periodic"}
                ),
            }
            for diagram in diagrams
        ],
        "largest_residual": max((row["residual"] for row in points), default=None),
    }


def run(job: Run) -> None:
    """Follow all branches; write and print everything known after every parameter."""
    from experiments.bifurcation import figures

    diagrams: list[Diagram] = []
    for diagram in plans(job.quick):
        explore(diagram, job.say)
        diagrams.append(diagram)
        points, specials = tables_of(diagrams)
        job.csv("bifurcation.csv", points)
        job.csv("special_points.csv", specials)
        job.json("bifurcation.json", summary(diagrams, points))
        for name, figure in figures.pictures(diagrams).items():
            job.figure(f"bifurcation_{name}.png", figure)
        print(f"{diagram.title}: {ranges(diagram)}", flush=True)
