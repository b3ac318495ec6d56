"""An optimum over the spread of assumptions: scenes one by one, statistics, other designs."""

import functools
import json
import math

import numpy as np
import pandas
import pytest
import scipy.stats

import rootsopt
from rootsopt.commands.console import main
from rootsopt.config import load
from rootsopt.config.tolerances import Span
from rootsopt.optimize.assumptions import _change, _known, compared
from rootsopt.optimize.design import search_of
from rootsopt.optimize.outcome import BASELINE, OPTIMIZED, Assumed
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.robust_problem import RobustProblem
from rootsopt.response.reducers import over_scenes
from rootsopt.response.result import Part
from rootsopt.response.scatter import assumed, in_conditions
from rootsopt.scene import Scene
from rootsopt.scene.space import Space
from rootsopt.status import Status
from tests.standins import evaluation_of

CLEARANCE, LOAD = "contact.clearance_mm", "scene.load.torque_N_m"
HELD = (
    "{scene.speed_rpm: null, scene.timing_gear.stiffness_N_m_per_rad: null, "
    "scene.timing_gear.backlash_mm: null, scene.timing_gear.damping_ratio: null, "
    "contact.stiffness_N_per_mm_e: null, contact.clearance_mm: {range: [0, 0.06]}}"
)
QUICK = (
    "optimizer.screening=12",
    "optimizer.starts=1",
    "optimizer.prove=false",
    "optimizer.iterations=8",
    "assumptions.scenes=8",
    f"assumptions.over={HELD}",
)


@functools.cache
def spread():
    """Return the config of a short search over clearance and load, its outcome, its spread."""
    config = load("cic_drawn", QUICK)
    result = search_of(config).run()
    return config, result, result.assumptions


@functools.cache
def alone(scene, name):
    """Return the evaluation of a design in one scene, given as a config of its own, from rest."""
    config, _, found = spread()
    values = dict(scene) if isinstance(scene, tuple) else found.scenes[scene]
    return rootsopt.evaluate(config.replaced(values), [*found.designs[name].values()])


def by_hand(scene, name):
    """Return the objective of a design in a scene, NaN if neither it nor the baseline touches."""
    base, one, given = alone(scene, BASELINE), alone(scene, name), alone("as given", BASELINE)
    if not (base.usable and one.usable) or base.status is one.status is Status.IDLE:
        return math.nan
    forces = [[x.response[k] for k in ("mean_force_N", "peak_force_N")] for x in (one, base, given)]
    return 1 + sum(0.5 * (f - f0) / max(f0, 0.1 * fn) for f, f0, fn in zip(*forces, strict=True))


def test_scenes_agree_with_configs_one_by_one():
    """Ends and drawn scenes give what `evaluate` gives for a config with these values, from rest.

    With a clearance of 60 µm, no flanks touch: there is nothing to compare."""
    _, _, found = spread()
    assert [*found.scenes][:5] == [
        "as given", f"{LOAD}=2.865", f"{LOAD}=7.64", f"{CLEARANCE}=0", f"{CLEARANCE}=0.06"
    ]  # fmt: skip
    for k in (0, 1, 4, 5):
        scene = [*found.scenes][k]
        for name in (BASELINE, OPTIMIZED):
            assert found.statuses[name][k] == alone(scene, name).status.label
        # The length that smooths the contact follows load and stiffness in a config of its own.
        assert found.objectives[OPTIMIZED][k] == pytest.approx(
            by_hand(scene, OPTIMIZED), rel=2e-3, nan_ok=True
        )
    assert found.statuses[BASELINE][4] == "idle"
    assert math.isnan(found.objectives[OPTIMIZED][4])


def test_record_counts_the_scenes():
    _, _, found = spread()
    record, values = found.record(), found.objectives[OPTIMIZED]
    known = np.isfinite(values[5:])
    some = values[5:][known]
    assert (record["scenes"], record["compared"]) == (8, len(some))
    assert (record["ends"], record["ends_compared"]) == (4, 3)
    assert record["share_better"] == np.mean(some < 1)
    assert record["objective_quantiles"]["quantile_95"] == pytest.approx(
        scipy.stats.mstats.mquantiles(some, 0.95, alphap=1, betap=1)[0]
    )
    assert record["worst"]["objective"] == np.nanmax(values)
    lost = {one["scene"]: one["status_baseline"] for one in record["not_compared"]}
    assert (lost[f"{CLEARANCE}=0.06"], len(lost)) == ("idle", np.sum(~np.isfinite(values)))
    x = np.array([found.scenes[name][LOAD] for name in [*found.scenes][5:]])
    assert record["keys"][0]["rank_correlation"] == pytest.approx(
        scipy.stats.spearmanr(x[known], some).statistic
    )
    assert found.columns()["objective_optimized"] == pytest.approx(values.tolist(), nan_ok=True)


def test_where_it_is_worse_and_which_design_wins():
    _, result, found = spread()
    rivals = found.record()["rivals"]
    assert rivals
    pieces = [
        (other, span, part)
        for other, parts in ((None, found.worse), *found.wins.items())
        for span in found.spans
        for part in parts[span.key]
    ]
    checked = 0
    for other, (key, low, high), (start, stop) in pieces:
        assert lead(key, (start + stop) / 2, other) > 0
        for outside in (start - 0.05 * (high - low), stop + 0.05 * (high - low)):
            if low < outside < high:
                # Beyond an unknown motion nothing is claimed.
                assert not lead(key, outside, other) >= 1e-3
                checked += 1
    assert checked
    problem = result.problem
    for one in rivals:
        assert problem.feasible(problem.point([*one["design"].values()]))
        best = np.nanargmax(found.objectives[OPTIMIZED] - found.objectives[one["name"]])
        scene = [*found.scenes][best]
        assert by_hand(scene, one["name"]) < by_hand(scene, OPTIMIZED)


def lead(key, value, other):
    scene = ((key, value),)
    return by_hand(scene, OPTIMIZED) - (1.0 if other is None else by_hand(scene, other))


def test_changes_of_sign_and_lost_motions():
    """A line has its root, and a motion lost above 0.8 is found to a sixteenth of the range."""
    assert _change(lambda x: x - 0.23, 0.0, 1.0) == pytest.approx(0.23, abs=0.02)
    assert _change(lambda x: math.nan if 0 < x < 1 else x - 0.23, 0.0, 1.0) is None

    def lost(x):
        return math.nan if x > 0.8 else x

    assert 0.8 - 1 / 16 < _known(lost, 1.0, 0.0) <= 0.8
    assert _known(lost, 0.0, 1.0) == 0.0


def of(forces):
    """Return the evaluation of a design with these forces in scenes; in the nominal one, 1."""
    return over_scenes([Part({}, evaluation_of(force)) for force in (1.0, *forces)])


def test_objective_over_assumptions_by_hand():
    """Mean, worst and regret of three scenes, each relative to the baseline in the same scene.

    Regret: its distance from that of the baseline is the distance of the objectives from 1."""
    config = load("cic_drawn", ["constraints.area_efficiency_min=0.4"])
    spans, scenes = (Span("x", 0, 1),), {f"random {k}": {"x": float(k)} for k in range(4)}
    ratios = np.array([0.5, 0.75, 1.2, math.nan])
    rival = np.array([0.4, 0.7, 1.1, 1.0])
    given = {BASELINE: np.array([1, 1, 1, math.nan]), OPTIMIZED: ratios, "design 1": rival}
    found = Assumed(spans, scenes, {}, given, {}, {}, {})
    space = Space.of(config, Scene.from_config(config))
    base, moved = of([2.0, 4.0, 1.0]), of([1.0, 3.0, 1.2])

    bases = tuple(part.evaluation for part in base.samples)
    regrets = [np.max(x - np.minimum(rival, 1)[:3]) for x in (ratios[:3], np.ones(3))]
    for combine, regret, expected in (
        ("mean_plus_k_sigma", False, np.mean(ratios[:3])),
        ("worst", False, 1.2),
        ("worst", True, 1 + regrets[0] - regrets[1]),
    ):
        kept, offsets = found.sample(regret)
        assert [*kept] == ["random 0", "random 1", "random 2"]
        at = in_conditions(config, kept, combine=combine, k=0.0)
        problem = RobustProblem(at, base.nominal, space, offsets=offsets, bases=bases)
        assert problem.combined(base).value == pytest.approx(1)
        assert problem.objective(moved) == pytest.approx(expected)


@pytest.mark.parametrize(("own", "unit"), [(50.0, 50.0), (2.0, 10.0), (0.0, 10.0)])
def test_a_baseline_that_hardly_strikes_is_no_unit(own, unit):
    """Forces are 100 N as given, `own` in the scene, and those of the design there 4 N more."""
    config = load("cic_drawn")
    nominal, base, one = map(evaluation_of, (100.0, own, own + 4.0))
    whole = Problem(config, nominal, Space.of(config, Scene.from_config(config)))
    problem = whole.beside(base)
    assert [*map(problem.objective, (base, one))] == pytest.approx([1, 1 + 4 / unit])
    # Constraints are evaluated once for all scenes.
    assert problem.limits_at(np.full(3, 0.5))[0] is whole.limits_at(np.full(3, 0.5))[0]


def test_scenes_are_named_and_seeded():
    config = load("cic_drawn", ["assumptions.scenes=4"])
    found = assumed(config)
    assert len(found) == 1 + 2 * len(config.spans) + 4
    assert found != assumed(config.replaced({"optimizer.seed": 1}))
    for key, low, high in config.spans:
        drawn = np.array([found[f"random {k}"][key] for k in range(1, 5)])
        # A Sobol sample has one point in each quarter.
        assert {*np.floor(4 * (drawn - low) / (high - low))} == {0, 1, 2, 3}


def test_nothing_without_a_motion_or_after_a_stop():
    config, result, _ = spread()
    assert compared(config, result, stop=lambda: True) is None
    still = (
        "optimizer.screening=0", "optimizer.starts=1", "optimizer.iterations=2",
        "objective={mean_weight: 0, peak_weight: 0, terms: {flow_ripple: 1}}",
    )  # fmt: skip
    assert search_of(load("cic_drawn", still)).run().assumptions is None


@pytest.mark.long
def test_command_optimises_over_assumptions(tmp_path, capsys):
    sets = [f"--set={one}" for one in (*QUICK, "objective.over=assumptions")]
    assert main(["optimize", "cic_drawn", "-o", str(tmp_path), *sets]) == 0
    assert "Other scenes: The optimum is better than the baseline in" in " ".join(
        capsys.readouterr().out.split()
    )
    result = json.loads((tmp_path / "result.json").read_text())
    rows = pandas.read_csv(tmp_path / "assumptions.csv")
    values = rows[rows.scene.str.startswith("random")].filter(regex="^objective").dropna()
    assert result["assumptions"]["share_better"] == np.mean(values.objective_optimized < 1)
    reached = values.objective_optimized.mean()
    assert reached <= values.mean().min() + 1e-3
    assert reached == pytest.approx(1 - result["improvement"]["objective"], abs=5e-3)
    assert (tmp_path / "figures" / "assumptions.png").read_bytes()[:4] == b"\x89PNG"
