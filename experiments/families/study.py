"""Puts every profile family into the same housings, and optimises each family there.

Every config of `HOUSINGS` is a reference, which sets pitch radius, area efficiency and tip land.
Each classical family gets its pitch radius, and the outer radius of the housing. The land must be
at least that of the reference. So must the area efficiency; a family that cannot reach it gets its
own maximum. All flanks have the same clearance. The other parameters are optimised in the config's
scene. The objective is the average of mean and peak force, each relative to the reference's. The
free form starts from the best two families. The optimised designs are then simulated in further
scenes.
"""

import contextlib
import functools
import itertools
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from experiments._common.driver import Run, start_process
from experiments._common.scenes import FORCES
from experiments._common.simulation import evaluate, objective, profile_of
from experiments._common.tables import Row, show
from experiments.families.reach import Reach, changed, in_housing, of_family, problem_of, reach
from rootsopt.config import Config, load, parse
from rootsopt.errors import InputError
from rootsopt.optimize.search import Search
from rootsopt.profiles.geometry import departure
from rootsopt.response.result import Evaluation
from rootsopt.scene import check_geometry, design_vector, outline_mm
from rootsopt.scene.families import classical, free_form_of

# Outer radius (mm) of a rotor that fills the bore, by shipped config: the EE rotor's own, which
# every family can reach, and the limit of `configs/cic.yaml`.
HOUSINGS = {"ee": 44.0, "cic": 45.2}

# Override of both: each flank is cut within 10 µm of its drawing.
CLEARANCE = "contact.clearance_mm=0.02"

# Entries of a row that the CSV file omits.
LONG = ("design", "outline_mm", "config")

# Difference of area efficiency below which two values count as equal.
EQUAL = 5e-5

# Number of designs of different area efficiency that are simulated to find the start of a search.
TRIED = 6

# Number of coefficients of the free form.
COEFFICIENTS = 12

# Number of families from which a free form is optimised. The best result is kept.
STARTS = 2

# Further scenes by name, as changes of the section `scene` of the optimisation.
SCENES: dict[str, dict[str, Any]] = {
    "1000 rpm": {"speed_rpm": 1000.0},
    "6000 rpm": {"speed_rpm": 6000.0},
    "20 N m": {"load": {"torque_N_m": 20.0}},
}
SEARCH = {"screening": 12, "starts": 2, "iterations": 40}
SEARCH_FREE = {"screening": 0, "starts": 1, "iterations": 100}

# Families of a reduced run.
QUICK = ("cic", "arcs_epicycloid")


def weighed(config: Config, response: dict[str, float], reference: dict[str, float]) -> Config:
    """Set the weights of mean and peak force, so that the search minimises the wanted objective.

    The objective is the average of both forces relative to `reference`. The search itself divides
    the forces by its baseline's `response`, so the weights must differ.
    """
    shares = {key.split("_")[0]: response[key] / reference[key] for key in FORCES}
    total = sum(shares.values())
    return changed(
        config, objective={f"{name}_weight": share / total for name, share in shares.items()}
    )


def optimised(config: Config, reference: dict[str, float]) -> Config:
    """Optimise from the design of a config. Return the config with the best design."""
    start = evaluate(config)
    if not start.usable:
        return config
    best = Search(weighed(config, start.response, reference)).run().optimized
    return config if best is None else config.with_design([*best.design.values()])


def placed(
    base: Config, bore: float, found: Reach, reference: Evaluation, quick: bool
) -> tuple[Config, bool]:
    """Choose the start of a search among designs of different area efficiency, by simulation.

    Returns the config of the start with its limit of area efficiency, and whether the family
    reaches the reference's efficiency.
    """
    floor, land = (reference.geometry[key] for key in ("area_efficiency", "seal_width_mm"))
    most = float(found.efficiencies[-1])
    reached, least = most >= floor - EQUAL, min(floor, most) - EQUAL
    few = {"screening": 2, "starts": 1, "iterations": 3} if quick else SEARCH
    config = changed(in_housing(base, bore, least, land), optimizer=few)
    if not found.points.shape[1]:
        return config, reached
    there = found.points[found.efficiencies >= least]
    places = np.unique(np.linspace(0, len(there) - 1, 1 if quick else TRIED).astype(int))
    problem = problem_of(config)
    tried = [config.with_design(np.asarray(problem.design(there[k]))) for k in places]
    marks = [objective(evaluate(one), reference.response) for one in tried]
    return tried[int(np.argmin(np.nan_to_num(marks, nan=np.inf)))], reached


def row_of(study: str, config: Config, reference: dict[str, float]) -> dict[str, Any]:
    """Return a row with all numbers of one design; `study`: name of the housing."""
    check_geometry(config)
    here = evaluate(config)
    row: dict[str, Any] = {
        "study": study,
        "family": config.profile.family,
        "lobes": config.profile.lobes,
        "pitch_radius_mm": config.profile.pitch_radius_mm,
        "objective": objective(here, reference),
        **{key: here.response.get(key, float("nan")) for key in FORCES},
        "status": here.status.label,
        **{key: here.geometry[key] for key in ("outer_radius_mm", "area_efficiency")},
        **{key: here.geometry[key] for key in ("seal_width_mm", "undercut_margin_mm")},
        "design": here.design,
        "outline_mm": outline_mm(config, design_vector(config)).tolist(),
    }
    for name, change in SCENES.items():
        there = evaluate(changed(config, scene=change))
        row |= {f"{name}: {key}": there.response.get(key, float("nan")) for key in FORCES}
        row[f"{name}: status"] = there.status.label
    return row


@functools.cache
def reference_of(name: str) -> tuple[Config, Evaluation]:
    """Load and simulate a reference config. Return config and evaluation."""
    config = load(name, [CLEARANCE])
    return config, evaluate(config)


def one_family(name: str, family: str, quick: bool) -> dict[str, Any] | None:
    """Return the row of a family's best design in the housing of the reference at `name`.

    The result is `None` if the family does not fit."""
    reference, base = reference_of(name)
    bore, land = HOUSINGS[name], base.geometry["seal_width_mm"]
    config = in_housing(of_family(reference, family), bore, 0.0, land)
    found = reach(config, 24) if quick else reach(config)
    if found is None:
        return None
    config, reached = placed(config, bore, found, base, quick)
    if found.points.shape[1]:
        config = optimised(config, base.response)
    return {
        **row_of(name, config, base.response),
        "reached": reached,
        "least_efficiency": float(found.efficiencies[0]),
        "most_efficiency": float(found.efficiencies[-1]),
        "config": config.to_yaml(),
    }


def free_starts(rows: list[Row], count: int) -> list[tuple[Row, Config, Config]]:
    """Return the best `count` of the `rows` that a free form can follow, each with its config and
    the free form's.

    A flank that meshes all at once, such as the arc of `circle_epicycloid`, has no sound free form.
    """
    found: list[tuple[Row, Config, Config]] = []
    for row in sorted(rows, key=lambda row: row["objective"]):
        config = parse(row["config"])
        profile, _ = free_form_of(config.profile, COEFFICIENTS)
        with contextlib.suppress(InputError):
            free = changed(config, profile=profile.model_dump())
            check_geometry(free)
            found.append((row, config, free))
    return found[:count]


def free_form(name: str, start: tuple[Row, Config, Config], quick: bool) -> Row:
    """Optimise a free form from one of the `free_starts`. Return its row."""
    _, base = reference_of(name)
    best, given, config = start
    bounds = {"bounds": {"tip_arc_angle_deg": (0.0, 45 / given.profile.lobes)}}
    settings = SEARCH_FREE | bounds | ({"iterations": 2} if quick else {})
    config = optimised(changed(config, optimizer=settings), base.response)
    return {
        **row_of(name, config, base.response),
        "reached": best["reached"],
        "begun_at": best["family"],
        "departure_um": departure(profile_of(config), profile_of(given)) / 1e-6,
        "config": config.to_yaml(),
    }


def by_study(data: dict[str, Any]) -> dict[str, list[Row]]:
    """Return the rows of each housing, sorted with the best first.

    Designs that reach the reference's area efficiency come first, then designs that do not, then
    designs without a periodic motion.
    """
    ranked = sorted(
        data["rows"],
        key=lambda row: (np.isnan(row["objective"]), not row["reached"], row["objective"]),
    )
    return {name: [row for row in ranked if row["study"] == name] for name in data["references"]}


def title(name: str, reference: Row) -> str:
    """Return a title for a housing: bore, area efficiency, tip land, and `name` of the config."""
    shape = reference["geometry"]
    return (
        f"Bore {2 * HOUSINGS[name]:.1f} mm; area efficiency {shape['area_efficiency']:.4f} and tip "
        f"land {shape['seal_width_mm']:.1f} mm of {name}.yaml"
    )


# Columns of the printed tables.
SHOWN = (
    *("family", "objective", "status", *FORCES),
    *(f"{scene}: {key}" for scene in SCENES for key in (*FORCES, "status")),
    *("area_efficiency", "least_efficiency", "most_efficiency", "reached"),
    *("seal_width_mm", "undercut_margin_mm", "begun_at", "departure_um"),
)


def run(job: Run) -> None:
    """Study all families in all housings, two at a time in their own processes.

    Free forms come last. A reduced run takes the last housing and the families `QUICK`.
    """
    from experiments.families import figures

    quick = job.quick
    names, families = ([*HOUSINGS][-1:], QUICK) if quick else ([*HOUSINGS], classical())
    tasks = list(itertools.product(names, families))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        2, mp_context=context, initializer=start_process, initargs=(True,)
    ) as pool:
        rows: list[Row] = []
        made = pool.map(one_family, *zip(*tasks, strict=True), itertools.repeat(quick))
        for (name, family), row in zip(tasks, made, strict=True):
            found = "does not fit" if row is None else f"{row['objective']:.4f}, {row['status']}"
            job.say(f"{name:8s} {family:18s} {found}")
            rows += [row] if row else []
        for name in names:
            own = [row for row in rows if row["study"] == name and row["reached"]]
            own = [row for row in own if not np.isnan(row["objective"])]
            starts = free_starts(own, 1 if quick else STARTS)
            made = [*pool.map(free_form, [name] * len(starts), starts, itertools.repeat(quick))]
            for row in made:
                job.say(f"{row['study']:8s} free_form {row['objective']:.4f}, {row['begun_at']}")
            rows += sorted(made, key=lambda row: np.nan_to_num(row["objective"], nan=np.inf))[:1]
    references = {name: reference_of(name)[1].record() for name in names}
    data = {"references": references, "rows": rows}
    job.json("families.json", data)
    job.csv("families.csv", rows, [key for key in rows[0] if key not in LONG])
    job.figure("families.png", figures.ranking_figure(data))
    job.figure("families_profiles.png", figures.profiles_figure(data))
    job.figure("overview.png", figures.overview())
    for name, ranked in by_study(data).items():
        show(f"### {title(name, references[name])}", ranked, SHOWN)
