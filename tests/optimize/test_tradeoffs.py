"""Fronts of two and three terms.

They are compared with independent searches; domination, gaps, rates and files are checked."""

import functools
import itertools
import threading
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from rootsopt.config.study import BASELINE
from rootsopt.config.units import words
from rootsopt.errors import InputError
from rootsopt.optimize.design import pareto_front
from rootsopt.optimize.local import Group, certify
from rootsopt.optimize.tradeoffs import assembly
from rootsopt.optimize.tradeoffs.assembly import Node, points_of, selected
from rootsopt.optimize.tradeoffs.front import RHO, Scalar, Scale, dominated, keys, links
from rootsopt.optimize.tradeoffs.study import Aim, Sample, Study, aims_of, freed
from rootsopt.optimize.tradeoffs.trace import Tracer
from rootsopt.profiles import geometry
from rootsopt.scene import Scene
from rootsopt.status import Standing, Status
from tests.optimize.test_optimize import config
from tests.standins import evaluation_of, registered

RADIUS = "pareto.terms=[outer_radius_mm, area_efficiency]"
ANGLES = (
    "pareto.terms=[first, second]",
    "constraints.area_efficiency_min=0",
    "constraints.seal_width_min_mm=0",
    "optimizer.bounds={pressure_angle_deg: [30, 45], tip_arc_angle_deg: [0.5, 8]}",
)
"""Terms made up of a and b: both angles of the design, 0 at their lower bound and 1 at their upper
bound. An involute length other than 5 mm makes all of them worse."""


def made_up(value):
    """Return the formula of a term: `value(a, b)`, plus a penalty on lengths other than 5 mm."""

    def formula(profile, shape, forces):
        a = (jnp.degrees(profile.pressure_angle) - 30.0) / 15.0
        b = (jnp.degrees(profile.tip_arc_angle) - 0.5) / 7.5
        return value(a, b) + (200 * profile.involute_length - 1) ** 2

    return formula


def _concave(a, b):
    return jnp.sqrt(4 - 3 * a**2) + b


def _stepped(a, b):
    """Return a term with a hill before a step: designs on the hill are worse than those left of
    it."""
    fall = 0.6 / (1 + jnp.exp(-(a - 0.6) * 40))
    return 2 - 0.4 * a - fall + 0.5 * jnp.exp(-(((a - 0.45) / 0.12) ** 2)) + b


def _two_wells(a, b):
    """Return the better of two wells, which changes at a = 1/2.

    The term is continuous there, and the best design jumps."""
    return 3 - a + 40 * (b - 0.1) ** 2 * (b - 0.9) ** 2 + 0.4 * (a - 0.5) * (b - 0.5)


def front_of(points, second, first=lambda a, b: a + 1.0 + 0.0 * b, starts=1):
    counts = f"pareto.points={points}", f"optimizer.starts={starts}"
    with registered(first=made_up(first), second=made_up(second)):
        return pareto_front(config(*ANGLES, *counts))


@pytest.fixture(scope="module")
def front():
    """Return a front of geometry alone; nothing is simulated."""
    return pareto_front(config(RADIUS, "pareto.points=5"))


def test_front_of_geometry_is_that_of_another_search(front):
    """SciPy's COBYLA finds the same outer radius for the area efficiency of a point between the
    ends, without gradients, from starts of its own."""
    scene = Scene.from_config(config())
    low, high = np.array([25.0, 0.1, 0.5]), np.array([45.0, 1.0, 8.0])
    compiled = jax.jit(lambda design: geometry(scene.profile(design)))

    @functools.lru_cache
    def at(*z):
        angle, share, land = low + (high - low) * np.clip(z, 0, 1)
        longest = 33 * np.sin(np.radians(angle)) * (np.pi / 6 - np.radians(land))
        return compiled(jnp.array([angle, share * longest, land]))

    assert front.status is Status.GEOMETRY_ONLY
    assert [point.standing for point in front.points] == [Standing.CERTIFIED] * 5
    terms, best = front.points[1].terms, np.inf
    limits = [
        lambda z: 100 * (float(at(*z).area_efficiency) - terms["area_efficiency"]),
        lambda z: 1e3 * float(at(*z).seal_width) - 2.0,
        lambda z: 1e3 * float(at(*z).undercut_margin),
        *(lambda z, k=k: z[k] for k in range(3)),
        *(lambda z, k=k: 1 - z[k] for k in range(3)),
    ]
    for start in ((0.5, 0.5, 0.2), (0.9, 0.2, 0.6)):
        found = minimize(
            lambda z: 1e3 * float(at(*z).outer_radius),
            start,
            method="COBYLA",
            constraints=[{"type": "ineq", "fun": one} for one in limits],
            options={"rhobeg": 0.2, "tol": 1e-5, "maxiter": 1000},
        )
        if max(-min(one(found.x) for one in limits), 0) < 1e-5:
            best = min(best, found.fun)
    assert terms["outer_radius_mm"] == pytest.approx(best, abs=1e-3)


def test_floor_of_a_term_is_dropped_only_if_it_is_the_baselines(front):
    assert front.limits_dropped == ("area_efficiency",)
    least = min(point.terms["area_efficiency"] for point in front.points)
    assert least < front.baseline_terms["area_efficiency"] - 0.1
    for kept in (
        config(RADIUS, "constraints.area_efficiency_min=0.4"),
        config("pareto.terms=[mean_force_N, flow_ripple]"),
    ):
        assert freed(kept) == (kept, ())
    own = "{outer_radius_mm: {max: baseline, min: 30}, flow_ripple: {max: baseline}}"
    free, names = freed(
        config(RADIUS, "constraints.outer_radius_max_mm=baseline", f"constraints.terms={own}")
    )
    assert names == ("area_efficiency", "outer_radius_mm")
    given = free.constraints
    assert (given.area_efficiency_min, given.outer_radius_max_mm) == (0, None)
    assert given.terms == {"outer_radius_mm": {"min": 30}, "flow_ripple": {"max": BASELINE}}


def test_concave_front_is_reached_evenly():
    """A weighted sum finds nothing but the ends of a concave front."""
    front = front_of(4, _concave)
    values = np.array([[*point.terms.values()] for point in front.points])
    assert (len(values), front.certified, front.gaps) == (4, 4, ())
    np.testing.assert_allclose(values[:, 1], np.sqrt(4 - 3 * (values[:, 0] - 1) ** 2), atol=2e-6)
    np.testing.assert_allclose(values[[0, -1]], [[1, 2], [2, 1]], atol=2e-6)
    apart = np.linalg.norm(np.diff(values, axis=0), axis=1)
    assert max(apart) < 1.4 * min(apart)
    for (first, second), point in zip(values[1:-1], front.points[1:-1], strict=True):
        assert point.rates["second"] == pytest.approx(-second / (3 * (first - 1)), rel=1e-2)
    assert all(np.isnan(front.points[k].rates["second"]) for k in (0, -1))


def test_gap_is_that_of_a_dense_grid():
    front = front_of(8, _stepped)
    a = np.linspace(0, 1, 100_001)
    second = np.asarray(_stepped(a, 0.0))
    sides = np.flatnonzero(second > np.minimum.accumulate(second))
    left, right = a[sides[0] - 1] + 1, a[sides[-1] + 1] + 1
    assert right - left > 0.2
    (gap,) = front.gaps
    assert (gap.kind, gap.confirmed) == ("terms", True)
    assert gap.tried >= 1
    np.testing.assert_allclose(
        [front.points[k - 1].terms["first"] for k in (gap.first, gap.second)],
        [left, right],
        atol=5e-3,
    )
    assert (gap.first, gap.second) not in front.edges
    assert len(front.edges) == len(front.points) - 2
    assert not [one for one in front.points if left + 5e-3 < one.terms["first"] < right - 5e-3]


def test_jump_of_the_designs_is_recognised():
    front = front_of(5, _two_wells, starts=2)
    (gap,) = front.gaps
    assert gap.kind == "design"
    sides = [front.points[k - 1] for k in (gap.first, gap.second)]
    before, after = (point.design["tip_arc_angle_deg"] for point in sides)
    assert before > 6 > 2.5 > after
    assert np.mean([point.terms["first"] for point in sides]) == pytest.approx(1.5, abs=0.06)


@pytest.mark.long
def test_three_terms():
    names = "outer_radius_mm", "area_efficiency", "seal_width_mm"
    front = pareto_front(config(f"pareto.terms=[{', '.join(names)}]", "pareto.divisions=3"))
    assert front.certified == len(front.points) >= 8
    assert {point.end_of for point in front.points if point.end_of} == {*names}
    values = np.array([[*point.terms.values()] for point in front.points])
    values *= [aim.sign for aim in front.aims]
    width = np.ptp(values, axis=0)
    for one, other in itertools.permutations(values, 2):
        assert not np.all(one <= other - 1e-6 * width)
    assert len(front.edges) > len(front.points)


def test_domination_by_brute_force():
    for count in (2, 3):
        values = np.random.default_rng(1).integers(0, 6, size=(60, count)) / 5.0
        expected = [
            any(np.all(other <= one) and np.any(other < one) for other in values) for one in values
        ]
        np.testing.assert_array_equal(dominated(values), expected)


def test_terms_without_conflict_have_one_best_design():
    """Both terms are best at the upper bound of a."""
    front = front_of(3, _concave, lambda a, b: 2.0 - a + 0.0 * b)
    (point,) = front.points
    assert "not in conflict" in front.message
    assert (front.gaps, front.certified) == ((), 1)
    assert [*point.terms.values()] == pytest.approx([1.0, 1.0], abs=1e-5)
    assert {one.standing for one in front.dropped} <= {Standing.REPEATED, Standing.DOMINATED}


def test_senses():
    given = "pareto.terms=[area_mm2, seal_width_mm, rms_force_N]"
    assert [aim.sign for aim in aims_of(config(given))] == [1, -1, 1]
    turned = config(given, "pareto.senses={seal_width_mm: min, area_mm2: max}")
    assert [aim.sense for aim in aims_of(turned)] == ["max", "min", "min"]


def test_interrupted_front_keeps_its_points():
    stop = threading.Event()

    def progress(done, expected):
        assert done <= expected
        if done >= 6:
            stop.set()

    tracer = Tracer(config(RADIUS), progress, stop)
    assert tracer.so_far().points == ()
    front = tracer.run()
    assert front.status is Status.INTERRUPTED
    assert 2 <= len(front.points) < 11
    assert {point.standing for point in front.points} == {Standing.NOT_VERIFIED}
    assert [p.design for p in tracer.so_far().points] == [p.design for p in front.points]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("pareto.terms=[peak_force_N]", "two or three"),
        ("pareto.terms=[area_mm2, area_mm2]", "two or three"),
        ("pareto.terms=[outer_radius_mm, area_mm2, rms_force_N, mean_force_N]", "two or three"),
        ("pareto.senses={seal_width_mm: min}", "seal_width_mm"),
        ("pareto.points=2", "at least 3"),
        ("pareto.terms=[noise, area_mm2]", "pareto.terms.*registered.*noise"),
        ("pareto.terms=[peak_norm_force_N, area_mm2]", "objective.peak_norm"),
        ("pareto.terms=[line_0_force_N, area_mm2]", "line_2_force_N"),
        ("objective.motion=worst", "objective.motion.*reached"),
        ("objective.speeds_rpm=[1000]", "objective.speeds_rpm.*empty"),
        ("objective.over=assumptions", "objective.over.*nominal"),
    ],
)
def test_refused_configs(override, words):
    with pytest.raises(InputError, match=words):
        pareto_front(config(override))


def test_peaks_are_branches_of_one_group():
    """At a corner of the scaled maximum, two equal peaks share the weight of their term."""
    groups = (
        Group(np.array([[0.0, 0.2], [0.0, 0.7]]), np.array([4.0, 4.0]), np.eye(2)),
        Group(np.array([[1.0, 0.0]]), np.array([3.0]), np.array([[-1.0, -1.0]])),
    )
    point = np.array([0.5, 0.5])
    sample = Sample(point, evaluation_of(), groups, (True, False), np.zeros(0), np.zeros((0, 2)))
    scalar = Scalar(Scale(np.array([2.0, 1.0]), np.array([2.0, 2.0])), np.array([0.5, 0.5]), (0, 1))
    local = scalar.local(sample)
    assert scalar.value(sample.values) == pytest.approx(local.objective, abs=1e-15)
    assert local.objective == pytest.approx(0.5 + RHO * 2.0)
    assert len(local.groups) == 2
    assert scalar.weights(sample, certify(local, point)) == pytest.approx(
        [2 / 3, 1 / 3], abs=2 * RHO
    )


def test_rates_have_the_signs_of_the_terms_themselves():
    """On the plane a = b/2 - 2c, a rises by 1/2 per unit of b and falls by 2 per unit of c.

    Of a and c more is better, of b less: a greater a costs more b, and less of c."""
    slopes = {("a", "max"): [0.5, -2.0], ("b", "min"): [1.0, 0.0], ("c", "max"): [0.0, 1.0]}
    aims, point = [Aim(*one) for one in slopes], np.array([0.5, 0.5])
    groups = [
        Group(np.array([[float(k), 0.0]]), np.zeros(1), aim.sign * np.array([slope]))
        for k, (aim, slope) in enumerate(zip(aims, slopes.values(), strict=True))
    ]
    scale = Scale(np.zeros(3), np.array([4.0, 2.0, 1.0]))
    sample = Sample(point, evaluation_of(), tuple(groups), (False,) * 3, np.zeros(0),
                    np.zeros((0, 2)))  # fmt: skip
    scalar = Scalar(scale, np.zeros(3), (0, 1, 2))
    node = Node(scalar, sample, certify(scalar.local(sample), point), "converged")
    study = object.__new__(Study)
    free = types.SimpleNamespace(
        space=types.SimpleNamespace(constraints=()),
        config=types.SimpleNamespace(design_keys=("b", "c")),
    )
    vars(study).update(aims=tuple(aims), problem=free, term_values=lambda found: {})
    ((found,), dropped) = points_of(study, [node], selected([node], scale), scale)
    assert dropped == []
    assert found.rates == pytest.approx({"b": 0.5, "c": -2.0}, rel=0.02)


def test_neighbours_on_the_grid_differ_by_one_step():
    """One step from one term to another, in every pair of terms; found by comparing all points."""
    for count, divisions in ((2, 5), (3, 4)):
        grid = keys(count, divisions)
        apart = np.sum(np.abs(np.array(grid)[:, None] - np.array(grid)), axis=2)
        expected = {(i, j) for i, j in np.argwhere(apart == 2).tolist() if i < j}
        assert sorted(tuple(sorted(pair)) for pair in links(grid)) == sorted(expected)


def test_halves_of_divided_neighbours_know_how_often_they_were_tried():
    """A gap states how many searches looked for a point between its sides, also before a half."""
    search = assembly.Bisections([(0, 3), (3, 4)], {(0, 3): 2})
    search.divided((0, 3), 5)
    assert sorted(search.pairs) == [(0, 5), (3, 4), (3, 5)]
    assert [search.tried[pair] for pair in ((0, 5), (3, 5))] == [2, 2]


def test_limits_of_a_point_are_those_on_which_it_lies(front):
    """A point that a lower bound holds lies at 0 in the unit box, one that an upper holds at 1."""
    keys = [words(key) for key in front.config.design_keys]
    held = [(name.split(" bound of "), multiplier, point.point) for point in front.points
            for name, multiplier in point.limits.items() if " bound of " in name]  # fmt: skip
    for (side, key), multiplier, place in held:
        assert multiplier > 0
        assert place[keys.index(key)] == pytest.approx(float(side == "upper"), abs=1e-6)
    assert {side for (side, _), *_ in held} == {"lower", "upper"}


@pytest.mark.parametrize(
    ("off", "reason", "standing"),
    [
        (0.005, "converged", "certified"),
        (0.005, "no_progress", "not_certified"),
        (0.02, "converged", "not_held_up"),
    ],
)
def test_a_point_holds_up_only_if_all_its_terms_do(off, reason, standing):
    """After the simulation from rest, one term that is more than 1 % off is enough to drop it.

    Otherwise the conditions count that hold with the new terms: here, both lead by as much. They
    certify nothing where the search promises a better compromise nearby."""
    point = np.array([0.5, 0.0])

    def sample(second):
        groups = [
            Group(np.array([[float(k), 0.0]]), np.array([value]), np.array([[slope, 1.0]]))
            for k, (value, slope) in enumerate(((4.0, 1.0), (second, -1.0)))
        ]
        return Sample(point, evaluation_of(), tuple(groups), (False, False), np.zeros(0),
                      np.zeros((0, 2)))  # fmt: skip

    scale = Scale(np.array([3.0, 1.0]), np.ones(2))
    scalar = Scalar(scale, np.array([0.0, 2.0 * off]), (0, 1))
    searched = sample(2.0)
    node = Node(scalar, searched, certify(scalar.local(searched), point), reason)
    tracer = Tracer(config(RADIUS))
    tracer.scale = scale
    tracer.study = study = object.__new__(Study)
    vars(study)["verified"] = lambda point: sample(2.0 * (1 + off))
    checked = tracer._checked(node)
    assert (checked.standing.label, checked.reason) == (standing, reason)
    # Of two equal designs, the one whose search has converged counts.
    worse = node._replace(reason="evaluations")
    assert assembly.better(worse, node) is (node if reason == "converged" else worse)
    assert assembly.better(node, worse) is node
    vars(study)["verified"] = lambda point: None
    assert tracer._checked(node).standing is Standing.NOT_HELD_UP


def test_a_point_divides_neighbours_if_it_lies_between_them():
    """It does not at an end, or farther from one of them than they are apart."""
    one, other = np.array([0.0, 1.0]), np.array([1.0, 0.0])
    both = np.stack([one, other]), np.zeros((2, 3))
    (edge,) = assembly.Selection(*both, [], [-1, -1], [0, 1]).edges([])
    assert edge.distance == pytest.approx(2**0.5)
    assert [
        assembly.divides(edge, np.array(place), one, other)
        for place in ([0.5, 0.5], [0.2, 0.7], one, other, [0.001, 0.999], [1.5, -0.5], [2.0, 2.0])
    ] == [True, True, False, False, False, False, False]
