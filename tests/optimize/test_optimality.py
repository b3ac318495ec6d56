"""What is known of an optimum: other optima, the number of unseen ones, vertices it may lie at."""

import json

import numpy as np
import pandas
import pytest
from scipy.spatial import HalfspaceIntersection

from rootsopt.commands.console import main
from rootsopt.config import load
from rootsopt.optimize.optimality import StartOutcome, distinct, unseen
from rootsopt.optimize.vertices import FeasibleSet
from rootsopt.scene.check import shape_of
from rootsopt.view.names import brief


def outcome(number, objective, *point):
    return StartOutcome(number, objective, 1e-9, "converged", 10, {}, np.array(point))


def test_optima_are_told_apart_by_objective_and_point():
    points = (0.9, 0.5), (0.8, 0.2), (0.8 + 1e-6, 0.2001), (0.8, 0.9)
    found = distinct([outcome(number, *one) for number, one in enumerate(points)])
    assert [(one.objective, one.found) for one in found] == [(0.8, 2), (0.8, 1), (0.9, 1)]
    # Two designs that agree in one parameter only are two.
    assert len(distinct([outcome(0, 0.8, 0.2, 0.1), outcome(1, 0.8, 0.2, 0.9)])) == 2


def test_unseen_optima_by_simulation():
    """The estimated share of unseen basins agrees with draws from the posterior of the formulas.

    The sizes are Dirichlet with a uniform prior for a known number of basins, averaged over many
    numbers."""
    expected = {"share_of_starts": 2 / 90, "expected_optima": 9 / 7}
    assert {key: unseen(10, 1)[key] for key in expected} == pytest.approx(expected)
    rng = np.random.default_rng(0)
    hidden, hits = 0.0, 0
    # Prior: any number of basins is equally likely (improper; cut at 60), sizes uniform.
    for _ in range(10_000):
        count = rng.integers(1, 61)
        sizes = rng.dirichlet(np.ones(count))
        seen = np.unique(rng.choice(count, 10, p=sizes))
        if len(seen) == 2:
            hits += 1
            hidden += 1 - sizes[seen].sum()
    assert hits > 100
    assert hidden / hits == pytest.approx(unseen(10, 2)["share_of_starts"], rel=0.2)


# Vertices of the feasible set, against half-space intersections and the geometry


OBJECTIVE = "objective={mean_weight: 0, peak_weight: 0, terms: {outer_radius_mm: 1}}"
SPARED = [
    f"--set=optimizer.{one}" for one in ("prove=false", "screening=4", "starts=1", "iterations=8")
]


@pytest.mark.parametrize("size", [2, 3, 4])
def test_all_vertices_of_a_polytope_are_found(size):
    """Random planes cut the unit box; SciPy (Qhull) intersects the half spaces."""
    rng = np.random.default_rng(size)
    normals = rng.normal(size=(3, size))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    depth = rng.uniform(0.2, 0.4, 3)
    middle = np.full(size, 0.5)

    def limits(point):
        return depth - normals @ (point - middle), -normals

    unit, none = np.eye(size), np.zeros((size, 1))
    planes = np.vstack([
        np.column_stack([normals, -depth - normals @ middle]),
        np.column_stack([unit, none - 1]), np.column_stack([-unit, none]),
    ])  # fmt: skip
    expected = np.unique(HalfspaceIntersection(planes, middle).intersections.round(9), axis=0)
    feasible = FeasibleSet(limits, size)
    first = feasible.vertex(expected[0])
    found = [first.point, *(one.point for one in feasible.vertices(first, 100))]
    np.testing.assert_allclose(np.unique(np.round(found, 9), axis=0), expected, atol=2e-9)
    assert feasible.vertex(middle) is None


def test_edges_may_be_curved():
    """Within a circle and right of a line through it, each end of an arc is a vertex."""
    feasible = FeasibleSet(
        lambda x: (np.array([0.16 - np.sum((x - 0.5) ** 2), x[0] - 0.5]),
                   np.array([-2 * (x - 0.5), [1.0, 0.0]])),
        2,
    )  # fmt: skip
    (other,) = feasible.vertices(feasible.vertex(np.array([0.5, 0.9])), 5)
    np.testing.assert_allclose(other.point, [0.5, 0.1], atol=1e-9)


def test_an_optimum_at_a_vertex_says_so(tmp_path, capsys, monkeypatch):
    """The other vertices meet the limits that hold them, and their objective is that of the
    geometry. No simulated design of the figure is better than the optimum."""
    out = tmp_path / "run"
    monkeypatch.setattr("rootsopt.view.figures.runs.optimization_figures", lambda *_: None)
    for nodes in ("_COARSE", "_NODES"):
        monkeypatch.setattr(f"rootsopt.optimize.vertices.{nodes}", 9)
    assert main(["optimize", "cic_drawn", "-o", str(out), "--set", OBJECTIVE, *SPARED]) == 0
    said = " ".join(capsys.readouterr().out.split())
    result = json.loads((out / "result.json").read_text())
    vertex, best = result["optimality"]["vertex"], result["optimized"]
    assert f"held by {vertex['limits'][0]}, {vertex['limits'][1]} and" in said
    assert f"the next best vertex has {brief(vertex['others'][0]['objective'])}" in said
    assert len(vertex["limits"]) == 3
    assert (out / "figures" / "feasible.png").stat().st_size > 10_000
    config = load("cic_drawn", [OBJECTIVE])
    objectives, base = [x["objective"] for x in vertex["others"]], result["baseline"]["geometry"]
    assert objectives == sorted(objectives)
    assert len(objectives) >= 3
    for one in vertex["others"]:
        shape = shape_of(config.with_design([*one["design"].values()]))
        radius = float(shape.outer_radius) * 1e3
        assert one["objective"] == pytest.approx(radius / base["outer_radius_mm"], rel=1e-9)
        places = {
            "seal width": (float(shape.seal_width) * 1e3, 2.0, 1e-6),
            "area efficiency": (float(shape.area_efficiency), base["area_efficiency"], 1e-7),
            "lower bound of pressure angle": (one["design"]["pressure_angle_deg"], 25.0, 1e-9),
        }
        for limit in places.keys() & {*one["limits"]}:
            value, expected, accuracy = places[limit]
            assert value == pytest.approx(expected, abs=accuracy)
    values = pandas.read_csv(out / "feasible.csv").objective.dropna()
    assert len(values) >= 4
    assert min(values) > best["geometry"]["outer_radius_mm"] / base["outer_radius_mm"] - 1e-9
