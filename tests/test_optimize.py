"""Optimiser: space, constraints, projection, descent directions, and a whole small run."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import parse
from rootsopt.errors import InputError
from rootsopt.evaluate import Evaluation
from rootsopt.model import Model
from rootsopt.optimize.problem import Problem, sobol
from rootsopt.optimize.search import Search
from rootsopt.profiles import geometry
from rootsopt.status import Status

SCENE = """
profile: {family: cic, lobes: 3, pitch_radius_mm: 33.0, pressure_angle_deg: 36.43,
          involute_length_mm: 8.0, tip_arc_angle_deg: 4.0}
rotor: {length_mm: 100.0, density_kg_m3: 7800.0}
contact: {stiffness_N_per_mm_e: 2.0e5, exponent: 2.2, max_damping_N_s_per_mm: 0.25,
          full_damping_depth_mm: 0.01}
scene:
  speed_rpm: 3000.0
  load: {torque_N_m: 4.775}
  timing_gear: {stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.5, backlash_mm: 0.1}
constraints: {seal_width_min_mm: 2.0}
"""


def config(*overrides):
    return parse(SCENE, overrides)


def baseline(settings) -> Evaluation:
    """An evaluation with made-up forces: the space needs only its geometry."""
    model = Model.of(settings)
    design = {"pressure_angle_deg": 36.43, "involute_length_mm": 8.0, "tip_arc_angle_deg": 4.0}
    shape = geometry(model.profile(jnp.asarray(list(design.values()))))
    return Evaluation(
        design=design,
        geometry={"area_efficiency": float(shape.area_efficiency)},
        response={"mean_force_N": 50.0, "peak_force_N": 200.0, "rms_force_N": 80.0},
        gradient={},
        steady_state={},
        status=Status.PERIODIC,
        message="",
        statistics={},
        series=None,
    )


@pytest.fixture(scope="module")
def problem():
    settings = config()
    return Problem.of(settings, Model.of(settings), baseline(settings))


def test_unit_box_and_design_are_inverse(problem):
    """point(design(x)) = x inside the box, and both ends are reached."""
    for point in np.random.default_rng(0).uniform(size=(20, 3)):
        design = problem.space.design(jnp.asarray(point))
        np.testing.assert_allclose(problem.space.point(design), point, atol=1e-12)
    low = np.asarray(problem.space.design(jnp.zeros(3)))
    high = np.asarray(problem.space.design(jnp.ones(3)))
    assert (low[0], low[2]) == (25.0, 0.5)
    np.testing.assert_allclose([high[0], high[2]], [45.0, 8.0])


def test_involute_never_exceeds_its_longest(problem):
    """u ≤ u_max at every point of the unit box."""
    for point in np.random.default_rng(1).uniform(size=(30, 3)):
        design = problem.space.design(jnp.asarray(point))
        longest = problem.space.model.profile(design).longest_involute
        assert float(design[1]) <= float(longest) * 1e3 * (1 + 1e-12)


def test_projection_makes_feasible_and_keeps_feasible_points(problem):
    """Projected points satisfy the constraints; feasible ones are not moved."""
    for point in sobol(32, 3):
        projected = problem.project(point)
        assert problem.feasible(projected)
        assert np.all((projected >= 0) & (projected <= 1))
        np.testing.assert_array_equal(problem.project(projected), projected)
    inside = next(p for p in sobol(256, 4) if problem.feasible(p))
    np.testing.assert_array_equal(problem.project(inside), inside)


def test_rotor_stays_in_its_housing(problem):
    """Floor and ceiling of the outer radius bind on their own sides, and are reported as such."""
    limits = "constraints.outer_radius_min_mm=44.2", "constraints.outer_radius_max_mm=44.5"
    settings = config(*limits, "constraints.area_efficiency_min=0.4")
    model, start = Model.of(settings), baseline(settings)
    start = dataclasses.replace(start, geometry=start.geometry | _radii(44.3))
    housed = Problem.of(settings, model, start)
    free = [float(_outer(model, problem.design(p))) * 1e3 for p in sobol(32, 3)]
    assert min(free) < 44.2
    assert max(free) > 44.5
    for point in sobol(32, 3):
        found = housed.project(point)
        assert housed.feasible(found)
        assert 44.2 - 2e-6 < float(_outer(model, housed.design(found))) * 1e3 < 44.5 + 2e-6
    wide = dataclasses.replace(start, geometry=start.geometry | _radii(44.8))
    narrow = dataclasses.replace(start, geometry=start.geometry | _radii(44.0))
    for one, floor, ceiling in ((wide, True, False), (narrow, False, True)):
        rows = [r for r in housed.constraint_rows(one) if r["name"] == "outer radius"]
        satisfied = {row["sense"]: row["satisfied"] for row in rows}
        assert satisfied == {">=": floor, "<=": ceiling}
        assert not any(row["active"] for row in rows)
    at_ceiling = dataclasses.replace(start, geometry=start.geometry | _radii(44.5 - 5e-5))
    rows = [r for r in housed.constraint_rows(at_ceiling) if r["name"] == "outer radius"]
    assert {row["sense"]: row["active"] for row in rows} == {">=": False, "<=": True}
    with pytest.raises(InputError, match=r"outer_radius_max_mm` must be greater"):
        config("constraints.outer_radius_min_mm=44.5", "constraints.outer_radius_max_mm=44.2")


@jax.jit
def _outer(model, design):
    return geometry(model.profile(design)).outer_radius


def _radii(outer):
    return {"outer_radius_mm": outer, "undercut_margin_mm": 5.0, "seal_width_mm": 5.0}


def test_descent_respects_active_constraints(problem):
    """The stripped slope leads into no active constraint and vanishes at a KKT point."""
    rng = np.random.default_rng(5)
    on_edge = [problem.project(p) for p in sobol(64, 6) if not problem.feasible(p)]
    assert on_edge
    for point in on_edge[:10]:
        _, _, slack, jacobian = problem.look(point)
        active = slack < 1e-4
        slope = rng.normal(size=3)
        direction = -problem.descent(point, slope)
        assert np.all(jacobian[active] @ direction >= -1e-9)
        # The stripped slope is still one of descent.
        assert slope @ direction <= 1e-12
        outward = jacobian[active].sum(axis=0)
        np.testing.assert_allclose(problem.descent(point, outward), 0, atol=1e-9)


def test_contradicting_constraints_are_bad_input():
    """No feasible design: one message, before anything is searched."""
    settings = config("constraints.area_efficiency_min=0.9", "optimizer.screening=4")
    search = Search(settings)
    search.problem = Problem.of(settings, Model.of(settings), baseline(settings))
    with pytest.raises(InputError, match=r"constraints\.area_efficiency_min"):
        search._feasible(np.full(3, 0.5))


def test_ee_has_nothing_to_optimise():
    """A family without design parameters is refused by name."""
    text = SCENE.replace("family: cic", "family: ee").replace("pressure_angle_deg: 36.43,", "")
    text = text.replace("involute_length_mm: 8.0, tip_arc_angle_deg: 4.0", "")
    with pytest.raises(InputError, match=r"profile\.family"):
        Search(parse(text))


def test_search_improves_within_the_constraints():
    """A small run: better than the baseline, feasible, verified, best-so-far monotone."""
    settings = config(
        "optimizer.screening=4",
        "optimizer.starts=1",
        "optimizer.iterations=6",
        "solver.map_rolls=96",
        "solver.map_relatives=16",
    )
    seen = []
    result = Search(settings, lambda done, expected, best: seen.append((done, best))).run()
    assert result.optimized is not None
    assert result.verification["holds_up"]
    assert result.problem.objective(result.baseline) == pytest.approx(1, abs=1e-12)
    assert result.problem.objective(result.optimized) < 0.95
    assert all(row["satisfied"] for row in result.problem.constraint_rows(result.optimized))
    best = [row["best_objective"] for row in result.history]
    assert all(b <= a for a, b in itertools.pairwise(best))
    assert best[-1] == pytest.approx(result.problem.objective(result.optimized), rel=0.01)
    assert [done for done, _ in seen] == list(range(1, len(result.history) + 1))
    gains = result.improvement
    reduction = (
        1 - result.optimized.response["mean_force_N"] / (result.baseline.response["mean_force_N"])
    )
    assert gains["mean_force_N"] == pytest.approx(reduction)


def test_objective_slope_agrees_with_finite_differences():
    """The gradient in the unit box, chain rule included, against central differences."""
    settings = config("solver.rtol=1e-10")
    search = Search(settings)
    base = search.exact(series=False)
    problem = Problem.of(settings, search.exact.model, base)
    # Away from designs whose peak falls on a corner of the force (see test_steady).
    point = np.array([0.2, 0.3, 0.4])

    def objective(at):
        return problem.objective(search.exact(problem.design(at), series=False))

    slope = problem.slope(search.exact(problem.design(point), series=False), jnp.asarray(point))
    step = 1e-4
    for i, unit in enumerate(np.eye(3)):
        difference = (objective(point + step * unit) - objective(point - step * unit)) / (2 * step)
        assert slope[i] == pytest.approx(difference, rel=1e-3, abs=1e-5)
