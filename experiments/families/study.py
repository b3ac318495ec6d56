"""Puts every profile family into the same housings, and optimises each family there.

Every given config is a reference, which sets pitch radius, outer radius (the bore of the housing)
and area efficiency. Each classical family gets the pitch radius and the outer radius of the
reference. Its area efficiency must be at least that of the reference, or the family's maximum if
that is less. The other parameters are optimised in the config's scene. The objective is the average
of mean and peak force, each relative to the reference's. The free form starts from the best two
families. The optimised designs are then simulated in further scenes.
"""

import functools
import itertools
import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from experiments._common.driver import start_process
from experiments._common.scenes import FORCES
from experiments._common.simulation import evaluate, objective, profile_of
from experiments.families.reach import Reach, changed, in_housing, of_family, problem_of, reach
from rootsopt.config import Config, load, parse
from rootsopt.config.units import MM
from rootsopt.errors import InputError
from rootsopt.optimize.search import Search
from rootsopt.profiles import Profile
from rootsopt.profiles.departure import departure
from rootsopt.response.evaluation import Evaluation
from rootsopt.scene import check_geometry, design_vector, outline_mm
from rootsopt.scene.families import classical, free_form_of, with_design

Row = dict[str, Any]
REFERENCES = ("configs/ee.yaml", "configs/cic.yaml")
EQUAL = 5e-5
"""Difference of area efficiency below which two values count as equal."""
TRIED = 6
"""Number of designs of different area efficiency that are simulated to find the start of a
search."""
COEFFICIENTS = 12
"""Number of coefficients of the free form."""
STARTS = 2
"""Number of families from which a free form is optimised. The best result is kept."""
SCENES: dict[str, dict[str, Any]] = {
    "1000 rpm": {"speed_rpm": 1000.0},
    "6000 rpm": {"speed_rpm": 6000.0},
    "20 N m": {"load": {"torque_N_m": 20.0}},
}
"""Further scenes by name, as changes of the section `scene` of the optimisation."""
SEARCH = {"screening": 24, "starts": 4, "iterations": 40, "learning_rate": 0.06}
SEARCH_FREE = {"screening": 0, "starts": 1, "iterations": 100, "learning_rate": 0.005}
QUICK = ("cic", "arc")
"""Families of a reduced run."""


def curvature(profile: Profile) -> dict[str, float]:
    """Return the smallest radii of curvature (mm), by name: of the addendum, and of the contact.

    The radius of the contact of two flanks is 1 / (1/ρ1 + 1/ρ2). Both radii are 0 at a cusp.
    """
    addendum, relative = np.inf, np.inf
    for one in profile.segments():
        start, stop = float(one.start), float(one.stop)
        if stop - start < 1e-9:
            continue
        nu = jnp.asarray(start + (stop - start) * (np.arange(2000) + 0.5) / 2000)
        first = np.asarray(profile.addendum_speed(nu))
        addendum = min(addendum, first.min())
        if not one.land:
            bend = 1 / first + 1 / np.asarray(profile.dedendum_curvature_radius(nu))
            relative = min(relative, (1 / np.maximum(bend, 1e-9)).min())
    # Half an interval from a cusp, its radius is some micrometres.
    cusp = profile.cusp and float(profile.addendum_speed(profile.pitch_normal)) < 1e-9
    return {
        "least_radius_mm": 0.0 if cusp else addendum / MM,
        "least_relative_radius_mm": 0.0 if cusp else relative / MM,
    }


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


def optimised(config: Config, reference: dict[str, float]) -> tuple[Config, int]:
    """Optimise from the design of a config. Return the config with the best design, and the number
    of designs simulated."""
    start = evaluate(config)
    if not start.usable:
        return config, 1
    result = Search(weighed(config, start.response, reference)).run()
    count = 1 + len(result.history)
    if result.optimized is None:
        return config, count
    return with_values(config, list(result.optimized.design.values())), count


def with_values(config: Config, design: ArrayLike) -> Config:
    """Return `config` with another `design` (d,), in config units."""
    return config.model_copy(update={"profile": with_design(config.profile, design)})


def placed(
    base: Config, found: Reach, reference: Evaluation, quick: bool
) -> tuple[Config, bool, int]:
    """Choose the start of a search among designs of different area efficiency, by simulation.

    Returns the config of the start with its limit of area efficiency, whether the family reaches
    the reference's efficiency, and the number of designs simulated.
    """
    bore, floor = (reference.geometry[key] for key in ("outer_radius_mm", "area_efficiency"))
    reached = found.efficiencies[-1] >= floor - EQUAL
    least = (floor if reached else found.efficiencies[-1]) - EQUAL
    few = {"screening": 2, "starts": 1, "iterations": 3} if quick else SEARCH
    config = changed(in_housing(base, bore, float(least)), optimizer=few)
    if not found.points.shape[1]:
        return config, bool(reached), 0
    there = found.points[found.efficiencies >= least]
    places = np.unique(np.linspace(0, len(there) - 1, 1 if quick else TRIED).astype(int))
    problem = problem_of(config)
    tried = [with_values(config, problem.design(there[k])) for k in places]
    marks = [objective(evaluate(one), reference.response) for one in tried]
    best = int(np.argmin(np.nan_to_num(marks, nan=np.inf)))
    return tried[best], bool(reached), len(tried)


def row_of(study: str, config: Config, reference: dict[str, float]) -> dict[str, Any]:
    """Return a row with all numbers of one design; `study`: name of the housing."""
    check_geometry(config)
    profile = profile_of(config)
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
        **curvature(profile),
    }
    for name, change in SCENES.items():
        there = evaluate(changed(config, scene=change))
        for key in FORCES:
            row[f"{name}: {key}"] = there.response.get(key, float("nan"))
        row[f"{name}: status"] = there.status.label
    row["design"] = here.design
    row["outline_mm"] = outline_mm(config, design_vector(config)).tolist()
    return row


@functools.cache
def reference_of(path: str) -> tuple[Config, Evaluation]:
    """Load and simulate a reference config. Return config and evaluation."""
    config = load(path)
    return config, evaluate(config)


def one_family(path: str, family: str, quick: bool) -> dict[str, Any] | None:
    """Return the row of a family's best design in the housing of the reference at `path`.

    The result is `None` if the family does not fit."""
    began = time.perf_counter()
    reference, base = reference_of(path)
    config = in_housing(of_family(reference, family), base.geometry["outer_radius_mm"], 0.0)
    found = reach(config, 24) if quick else reach(config)
    if found is None:
        return None
    config, reached, count = placed(config, found, base, quick)
    if found.points.shape[1]:
        config, more = optimised(config, base.response)
        count += more
    return {
        **row_of(Path(path).stem, config, base.response),
        "reached": reached,
        "least_efficiency": float(found.efficiencies[0]),
        "most_efficiency": float(found.efficiencies[-1]),
        "evaluations": count,
        "seconds": time.perf_counter() - began,
        "config": config.to_yaml(),
    }


def free_starts(rows: list[Row], count: int) -> list[tuple[Row, Config, Config]]:
    """Return the best `count` of the `rows` that a free form can follow, each with its config and
    the free form's.

    A flank that meshes all at once, such as the arc of `circle_epicycloid`, has no sound free form.
    """
    found: list[tuple[Row, Config, Config]] = []
    refusal: InputError | None = None
    for row in sorted(rows, key=lambda row: row["objective"]):
        config = parse(row["config"])
        profile, _ = free_form_of(config.profile, COEFFICIENTS)
        try:
            free = changed(config, profile=profile.model_dump())
            check_geometry(free)
        except InputError as error:
            refusal = error
        else:
            found.append((row, config, free))
        if len(found) == count:
            break
    if not found and refusal is not None:
        raise refusal
    return found


def free_form(path: str, start: tuple[Row, Config, Config], quick: bool) -> Row:
    """Optimise a free form from one of the `free_starts`. Return its row."""
    began = time.perf_counter()
    _, base = reference_of(path, quick)
    best, given, config = start
    followed = profile_of(given)
    settings: dict[str, Any] = {"bounds": {"tip_arc_angle_deg": (0.0, 45 / given.profile.lobes)}}
    settings |= SEARCH_FREE | ({"iterations": 2} if quick else {})
    config = changed(
        config,
        optimizer=settings,
    )
    config, count = optimised(config, base.response)
    made = profile_of(config)
    return {
        **row_of(Path(path).stem, config, base.response),
        "reached": best["reached"],
        "begun_at": best["family"],
        "departure_um": departure(made, followed) / 1e-6,
        "evaluations": count,
        "seconds": time.perf_counter() - began,
        "config": config.to_yaml(),
    }


def run(
    quick: bool,
    paths: Sequence[str] = REFERENCES,
    families: Sequence[str] | None = None,
    jobs: int = 2,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Study all families in all housings, `jobs` at a time in their own processes.

    `paths`: reference configs; `families`: by default all classical families. Returns the records
    of the references, and a row per design, with free forms last. A reduced run takes the last
    housing and the families `QUICK`.
    """
    paths, families = (paths[-1:], QUICK) if quick else (paths, families or classical())
    references = {Path(path).stem: reference_of(path, quick)[1].record() for path in paths}
    tasks = list(itertools.product(paths, families))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        jobs, mp_context=context, initializer=start_process, initargs=(True,)
    ) as pool:
        pending = [pool.submit(one_family, *task, quick) for task in tasks]
        rows: list[Row] = []
        for (path, family), future in zip(tasks, pending, strict=True):
            row = future.result()
            found = "does not fit" if row is None else f"{row['objective']:.4f}, {row['status']}"
            say(f"{Path(path).stem:8s} {family:18s} {found}")
            rows += [row] if row else []
        free = []
        for path in paths:
            own = [row for row in rows if row["study"] == Path(path).stem and row["reached"]]
            own = [row for row in own if np.isfinite(row["objective"])]
            starts = free_starts(own, 1 if quick else STARTS) if own else []
            free.append([pool.submit(free_form, path, start, quick) for start in starts])
        for futures in free:
            found = [future.result() for future in futures]
            for row in found:
                say(f"{row['study']:8s} free_form {row['objective']:.4f} from {row['begun_at']}")
            rows += sorted(found, key=lambda row: np.nan_to_num(row["objective"], nan=np.inf))[:1]
    return {"references": references, "rows": rows}
