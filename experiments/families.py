"""Which profile family has the least contact force? All of them in the same housings.

    python experiments/families.py [configs/ee.yaml configs/cic.yaml] [-o DIR] [--jobs 2]
                                   [--families cic,arc] [--quick]

Every config is a reference: its pitch radius, its outer radius, taken for the housing's bore, and
its area efficiency. Each classical family is put into that housing: pitch radius and outer radius
as the reference, at least its area efficiency or, where the family cannot reach that, the most it
can; everything else of it is left to the optimiser, in the config's scene, with the mean of mean
and peak force, each relative to the reference's, for objective. The free form begins at the best of
them. What was found is simulated in further scenes.

`--quick` takes the last config and two families. Writes families.csv (a row each),
families.json, families.md (the tables), families.png (ranking) and families_profiles.png.
"""

import argparse
import functools
import itertools
import json
import multiprocessing
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from rootsopt.cli import use_cache, use_float64

use_float64()

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import ArrayLike  # noqa: E402

from experiments.families_parts.reach import (  # noqa: E402
    Reach,
    changed,
    in_housing,
    of_family,
    problem_of,
    reach,
)
from experiments.families_parts.show import profiles_figure, ranking_figure, tables  # noqa: E402
from rootsopt import files  # noqa: E402
from rootsopt.config import Config, load  # noqa: E402
from rootsopt.evaluate import Evaluation, Evaluator  # noqa: E402
from rootsopt.families import MM, classical, free_form_of, with_design  # noqa: E402
from rootsopt.model import Model, check_geometry, design_vector, outline_mm  # noqa: E402
from rootsopt.optimize.search import Search  # noqa: E402
from rootsopt.profiles import Profile  # noqa: E402
from rootsopt.profiles.departure import departure  # noqa: E402

FORCES = ("mean_force_N", "peak_force_N")
EQUAL = 5e-5
"""Difference of area efficiency that counts as none."""
TRIED = 6
"""Designs of different area efficiency of which the best begins a search."""
COEFFICIENTS = 12
"""Of the free form."""
SCENES: dict[str, dict[str, Any]] = {
    "1000 rpm": {"speed_rpm": 1000.0},
    "6000 rpm": {"speed_rpm": 6000.0},
    "20 N m": {"load": {"torque_N_m": 20.0}},
}
"""What is changed of the scene in which the designs were found."""
SEARCH = {"screening": 24, "starts": 4, "iterations": 40, "learning_rate": 0.06}
SEARCH_FREE = {"screening": 0, "starts": 1, "iterations": 100, "learning_rate": 0.005}
QUICK = ("cic", "arc")


def curvature(profile: Profile) -> dict[str, float]:
    """Least radius of curvature of the addendum, and of two flanks against each other where they
    touch (mm): 1 / (1/ρ1 + 1/ρ2); 0 at a cusp."""
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
    # Half an interval beside a cusp its radius is some micrometres.
    cusp = profile.cusp and float(profile.addendum_speed(profile.pitch_normal)) < 1e-9
    return {
        "least_radius_mm": 0.0 if cusp else addendum / MM,
        "least_relative_radius_mm": 0.0 if cusp else relative / MM,
    }


def objective(evaluation: Evaluation, reference: dict[str, float]) -> float:
    """Mean of mean and peak force, each relative to the reference's; NaN without a motion that
    repeats."""
    if not evaluation.usable:
        return float("nan")
    return float(np.mean([evaluation.response[key] / reference[key] for key in FORCES]))


def weighed(config: Config, response: dict[str, float], reference: dict[str, float]) -> Config:
    """A config whose objective, relative to its baseline's `response`, is proportional to
    `objective`."""
    shares = {key.split("_")[0]: response[key] / reference[key] for key in FORCES}
    total = sum(shares.values())
    return changed(
        config, objective={f"{name}_weight": share / total for name, share in shares.items()}
    )


def optimised(config: Config, reference: dict[str, float]) -> tuple[Config, int]:
    """The best design found from that of `config`, or that, and how many were simulated."""
    start = Evaluator(config)(series=False)
    if not start.usable:
        return config, 1
    result = Search(weighed(config, start.response, reference)).run()
    count = 1 + len(result.history)
    if result.optimized is None:
        return config, count
    return with_values(config, list(result.optimized.design.values())), count


def with_values(config: Config, design: ArrayLike) -> Config:
    """A config with another design."""
    return config.model_copy(update={"profile": with_design(config.profile, design)})


def placed(
    base: Config, found: Reach, reference: Evaluation, quick: bool
) -> tuple[Config, bool, int]:
    """The config with the floor of area efficiency and the best of some designs to begin with,
    whether the family reaches the floor asked for, and how many were simulated."""
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
    marks = [objective(Evaluator(one)(series=False), reference.response) for one in tried]
    best = int(np.argmin(np.nan_to_num(marks, nan=np.inf)))
    return tried[best], bool(reached), len(tried)


def row_of(study: str, config: Config, reference: dict[str, float]) -> dict[str, Any]:
    """Everything about one design."""
    check_geometry(config)
    profile = Model.of(config).profile(design_vector(config))
    here = Evaluator(config)(series=False)
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
        there = Evaluator(changed(config, scene=change))(series=False)
        for key in FORCES:
            row[f"{name}: {key}"] = there.response.get(key, float("nan"))
        row[f"{name}: status"] = there.status.label
    row["design"] = here.design
    row["outline_mm"] = outline_mm(config, design_vector(config)).tolist()
    return row


@functools.cache
def reference_of(path: str, quick: bool) -> tuple[Config, Evaluation]:
    """A reference and its forces."""
    config = load(path, ["solver.fidelity=linear"] if quick else [])
    return config, Evaluator(config)(series=False)


def one_family(path: str, family: str, quick: bool) -> dict[str, Any] | None:
    """The best design of a family in the housing of a reference; None where it does not fit."""
    began = time.perf_counter()
    reference, base = reference_of(path, quick)
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


def free_form(path: str, best: dict[str, Any], quick: bool) -> dict[str, Any]:
    """The free form that begins at the `best` of the families."""
    from rootsopt.config import parse

    began = time.perf_counter()
    _, base = reference_of(path, quick)
    config = parse(best["config"])
    start = Model.of(config).profile(design_vector(config))
    profile, _ = free_form_of(config.profile, COEFFICIENTS)
    settings: dict[str, Any] = {"bounds": {"tip_arc_angle_deg": (0.0, 45 / config.profile.lobes)}}
    settings |= SEARCH_FREE | ({"iterations": 2} if quick else {})
    config = changed(
        config,
        profile=profile.model_dump(),
        optimizer=settings,
        solver={"gradient": "reverse"},
    )
    config, count = optimised(config, base.response)
    made = Model.of(config).profile(design_vector(config))
    return {
        **row_of(Path(path).stem, config, base.response),
        "reached": best["reached"],
        "begun_at": best["family"],
        "departure_um": departure(made, start) / 1e-6,
        "evaluations": count,
        "seconds": time.perf_counter() - began,
        "config": config.to_yaml(),
    }


def _own_process() -> None:
    use_float64()
    use_cache()


def study(
    paths: Sequence[str], families: Sequence[str], jobs: int, quick: bool
) -> list[dict[str, Any]]:
    """The rows of all families in all housings, the free form of each last."""
    tasks = list(itertools.product(paths, families))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_own_process) as pool:
        pending = [pool.submit(one_family, *task, quick) for task in tasks]
        rows = []
        for (path, family), future in zip(tasks, pending, strict=True):
            row = future.result()
            say = "does not fit" if row is None else f"{row['objective']:.4f}, {row['status']}"
            print(f"{Path(path).stem:8s} {family:18s} {say}", flush=True)
            rows += [row] if row else []
        free = []
        for path in paths:
            own = [row for row in rows if row["study"] == Path(path).stem and row["reached"]]
            own = [row for row in own if np.isfinite(row["objective"])]
            if own:
                best = min(own, key=lambda row: row["objective"])
                free.append(pool.submit(free_form, path, best, quick))
        for future in free:
            row = future.result()
            print(f"{row['study']:8s} free_form {row['objective']:.4f} from {row['begun_at']}")
            rows.append(row)
    return rows


def main() -> int:
    arguments = argparse.ArgumentParser(description="All profile families in the same housings.")
    arguments.add_argument("configs", nargs="*", default=["configs/ee.yaml", "configs/cic.yaml"])
    arguments.add_argument("-o", "--output", type=Path, default=Path("results/families"))
    arguments.add_argument("--families", default=",".join(classical()), help="comma-separated")
    arguments.add_argument("--jobs", type=int, default=2, help="families side by side")
    arguments.add_argument("--quick", action="store_true", help="one housing, two families")
    arguments.add_argument("--show", type=Path, help="families.json of an earlier run to show")
    options = arguments.parse_args()
    folder = files.ResultFolder(options.output)
    if options.show:
        data = json.loads(options.show.read_text())
    else:
        paths = options.configs[-1:] if options.quick else options.configs
        families = list(QUICK) if options.quick else options.families.split(",")
        _own_process()
        references = {
            Path(path).stem: reference_of(path, options.quick)[1].record() for path in paths
        }
        rows = study(paths, families, options.jobs, options.quick)
        data = {"references": references, "rows": rows, "versions": files.versions()}
        folder.write_json("families.json", data)
    rows = data["rows"]
    plain = [key for key in rows[0] if key not in ("design", "outline_mm", "config")]
    folder.write_csv("families.csv", {key: [row.get(key, "") for row in rows] for key in plain})
    folder.write_text("families.md", tables(data))
    folder.write_figure("families.png", ranking_figure(data))
    folder.write_figure("families_profiles.png", profiles_figure(data))
    print(tables(data))
    return 0


if __name__ == "__main__":
    sys.exit(main())
