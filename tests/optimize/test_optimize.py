"""Tests of the optimiser: space, constraints, projection, descent, small runs, and resumed ones."""

import _thread
import dataclasses
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
import types
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.commands.table import optimize as command
from rootsopt.commands.work import optimize as work
from rootsopt.config import parse
from rootsopt.errors import InputError
from rootsopt.optimize.infeasible import feasible_points
from rootsopt.optimize.limits import constraint_rows, limited
from rootsopt.optimize.problem import Problem
from rootsopt.optimize.robust_problem import Stage
from rootsopt.optimize.search import Search
from rootsopt.profiles import geometry
from rootsopt.profiles.soundness import margins
from rootsopt.response.evaluation import Evaluation
from rootsopt.response.journal import Checkpoint
from rootsopt.response.result import Seed
from rootsopt.runtime.threads import until_stopped
from rootsopt.scene import Scene
from rootsopt.scene.space import sobol
from rootsopt.status import Status
from rootsopt.view.runs import RunFolder
from tests.standins import evaluation_of

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


INVOLUTE, ANGLE = "optimizer.bounds.involute_length_mm", "optimizer.bounds.pressure_angle_deg"


def config(*overrides):
    return parse(SCENE, overrides)


def baseline(settings) -> Evaluation:
    """Return an evaluation with made-up forces; the space needs only its geometry."""
    shape = geometry(Scene.from_config(settings).profile(jnp.array([36.43, 8.0, 4.0])))
    return dataclasses.replace(
        evaluation_of(),
        design={"pressure_angle_deg": 36.43, "involute_length_mm": 8.0, "tip_arc_angle_deg": 4.0},
        geometry={"area_efficiency": float(shape.area_efficiency)},
        response={"mean_force_N": 50.0, "peak_force_N": 200.0, "rms_force_N": 80.0},
    )


def problem_of(*overrides):
    settings = limited(config(*overrides))
    return Problem.of(settings, Scene.from_config(settings), baseline(settings))


@jax.jit
def sizes(scene, design):
    """Return longest involute (mm), outer radius (mm) and reach of the normals (m) of a design."""
    profile = scene.profile(design)
    return (
        1e3 * profile.longest_involute,
        1e3 * geometry(profile).outer_radius,
        margins(profile).reach,
    )


def test_bounds_of_the_involute_replace_its_default_floor():
    """By default, the shortest involute is a tenth of the longest. A bound may be below this.

    A bound above the longest involute is a constraint."""
    for overrides, share, least in (([], 0.1, 0.0), ([f"{INVOLUTE}=[0.3, 30]"], 0.0, 0.3)):
        space = problem_of(*overrides).space
        design = space.design(jnp.array([0.5, 0.0, 0.5]))
        longest, *_ = map(float, sizes(space.scene, design))
        assert longest > 5
        assert float(design[1]) == pytest.approx(max(share * longest, least), rel=1e-12)
    space = problem_of(f"{INVOLUTE}=[0.001, 30]", f"{ANGLE}=[14, 45]").space
    for angle, tip in itertools.product((0.0, 0.1, 1.0), (0.0, 1.0)):
        design = space.design(jnp.array([angle, 0.0, tip]))
        # With a shorter one, normals of the tip arc would miss the pitch circle.
        assert float(sizes(space.scene, design)[2]) >= -1e-9
    problem = problem_of(f"{INVOLUTE}=[11, 30]")
    moved = [one for one in map(problem.project, sobol(16, 5)) if problem.feasible(one)]
    assert min(float(problem.design(one)[1]) for one in moved) >= 11 - 1e-5


def test_projection_makes_feasible_and_keeps_feasible_points():
    problem = problem_of()
    for one in map(problem.project, sobol(32, 3)):
        assert problem.feasible(one)
        assert np.all((one >= 0) & (one <= 1))
        np.testing.assert_array_equal(problem.project(one), one)


def test_rotor_stays_in_its_housing():
    """Lower and upper limit of the outer radius apply on their own sides, and are reported so."""
    limits = "constraints.outer_radius_min_mm=44.2", "constraints.outer_radius_max_mm=44.5"
    settings = config(*limits, "constraints.area_efficiency_min=0.4")
    scene, start = Scene.from_config(settings), baseline(settings)
    housed, sample = Problem.of(settings, scene, _with_radius(start, 44.3)), sobol(32, 3)
    free = [float(sizes(scene, housed.design(one))[1]) for one in sample]
    assert min(free) < 44.2 < 44.5 < max(free)
    for found in map(housed.project, sample):
        assert housed.feasible(found)
        assert 44.2 - 2e-6 < float(sizes(scene, housed.design(found))[1]) < 44.5 + 2e-6
    for outer, satisfied in ((44.8, {">=": True, "<=": False}), (44.0, {">=": False, "<=": True})):
        rows = constraint_rows(housed, _with_radius(start, outer))
        rows = [row for row in rows if row["name"] == "outer radius"]
        assert {row["sense"]: row["satisfied"] for row in rows} == satisfied


def _with_radius(one, outer):
    own = {"outer_radius_mm": outer, "undercut_margin_mm": 5.0, "seal_width_mm": 5.0}
    return dataclasses.replace(one, geometry=one.geometry | own)


def test_contradicting_constraints_are_explained():
    """If a rotor needs more area than its housing allows, both limits are named.

    Each can be met at the value that the other one leaves, found on a grid by projection."""
    area, seal = "constraints.area_efficiency_min=0.44", "constraints.seal_width_min_mm=0.1"
    problem = problem_of(
        "constraints.outer_radius_max_mm=42.0", area, seal, "optimizer.screening=4"
    )
    sample = Stage().sample(problem, np.full(3, 0.5), problem.config.optimizer)
    points, found = feasible_points(problem, sample)
    assert points == []
    alone = {one.name: one.alone for one in found.conflicts}
    assert {"area efficiency", "outer radius"} <= alone.keys()
    assert found.violation > 0.1
    assert "constraints" in found.message
    # With this radius there is a design, and with 0.1 mm less there is none.
    for shift, possible in ((1e-3, True), (-0.1, False)):
        radius = alone["outer radius"] + shift
        again = problem_of(area, f"constraints.outer_radius_max_mm={radius}", seal)
        assert any(again.feasible(again.project(p)) for p in sobol(8, 3)) == possible
        # A search that begins at a design outside finds it, too.
        begins = np.full(3, 0.5)
        assert not again.feasible(begins)
        points, reason = feasible_points(again, [begins])
        assert [again.feasible(point) for point in points] == [True] * possible
        assert (reason is None) == possible


def test_search_improves_within_the_constraints():
    seen = []
    result = Search(config(*SMALL), lambda done, expected, best: seen.append(done)).run()
    assert result.verification["holds_up"]
    assert result.problem.objective(result.baseline) == pytest.approx(1, abs=1e-12)
    reached = result.problem.objective(result.optimized)
    assert reached < 0.95
    assert all(row["satisfied"] for row in constraint_rows(result.problem, result.optimized))
    best = [row["best_objective"] for row in result.history]
    assert best == sorted(best, reverse=True)
    assert best[-1] == pytest.approx(reached, rel=0.01)
    assert seen == list(range(1, len(best) + 1))


SMALL = (
    "optimizer.screening=4",
    "optimizer.starts=1",
    "optimizer.iterations=6",
    "optimizer.prove=false",
)


def stopping(after, *overrides):
    """Return a search that is asked to stop after a number of evaluations."""
    stop = threading.Event()
    return Search(config(*overrides), lambda done, *_: stop.set() if done == after else None, stop)


def test_a_stopped_search_without_time_to_verify():
    """The best trial itself is returned, and the result says that it was not verified."""
    search = stopping(8, *SMALL)
    search._verification = lambda: time.sleep(600)
    assert until_stopped(search.run, search.stop, 0.0) is None
    result = search.so_far()
    assert (result.interrupted, result.verification["holds_up"]) == (True, None)
    trials = [row["objective"] for row in result.history if row["feasible"]]
    assert search.problem.objective(result.optimized) == min(trials) < 1
    assert all(row["satisfied"] for row in result.constraints)


def test_a_search_stopped_before_it_found_anything():
    """The search stops during the first screened design, and before the baseline is simulated."""
    search = Search(config(*SMALL))
    assert search.so_far() is None
    search._side_by_side = lambda *_: search.stop.set() or []
    result = search.run()
    assert (result.interrupted, result.baseline.usable) == (True, True)
    assert (result.optimized, result.history) == (None, [])


def test_a_search_stopped_while_it_screens_says_why_it_ended():
    result = stopping(
        30, "optimizer.screening=32", "optimizer.starts=1",
        "objective={mean_weight: 0, peak_weight: 0, terms: {outer_radius_mm: 1}}",
    ).run()  # fmt: skip
    assert (result.interrupted, result.improvement["objective"] > 0) == (True, True)
    optimality = result.optimality.record()
    assert (optimality["reason"], optimality["starts"]) == ("interrupted", [])


@pytest.fixture
def interruptible():
    """Let Ctrl-C raise, even if the tests were started with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_stops_a_search_and_a_second_one_the_wait(interruptible):
    """`KeyboardInterrupt` works as Python raises it where no command line owns the process."""
    stop = threading.Event()

    def interrupt():
        threading.Timer(0.2, _thread.interrupt_main).start()

    interrupt()
    assert until_stopped(lambda: stop.wait(60) and "kept", stop, 60.0) == "kept"
    interrupt()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        until_stopped(lambda: time.sleep(5), stop, 60.0)
    assert time.monotonic() - began < 4
    assert until_stopped(lambda: time.sleep(5), stop, 0.0) is None
    with pytest.raises(InputError, match="starts"):
        until_stopped(lambda: config("optimizer.starts=-1"), threading.Event(), 0.0)


INTERRUPTED = """
import os, signal, sys
from rootsopt.commands import door
from rootsopt.commands.table import optimize as command
from rootsopt.commands.work import searching
from rootsopt.optimize.search import Search
wanted, number = int(sys.argv.pop(1)), signal.Signals[sys.argv.pop(1)]
searching.PATIENCE = 600.0 if wanted else 0.0
evaluate, run = Search._evaluate, Search.run
def counted(self, *arguments, **options):
    found = evaluate(self, *arguments, **options)
    if len(self._trials) == wanted:
        os.kill(os.getpid(), number)
        self.stop.wait(60)
    return found
def begun(self):
    if wanted == 0:
        os.kill(os.getpid(), number)
        import time; time.sleep(60)
    return run(self)
Search._evaluate, Search.run = counted, begun
door.leave(command.main())
"""


@pytest.mark.parametrize(
    ("after", "number"),
    [
        (8, "SIGINT"),
        *(pytest.param(*one, marks=pytest.mark.long) for one in ((0, "SIGINT"), (9, "SIGTERM"))),
    ],
)
def test_signals_to_the_command(tmp_path, after, number):
    (tmp_path / "scene.yaml").write_text(SCENE)
    arguments = [str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "run"), "--no-figures"]
    arguments += [f"--set={text}" for text in SMALL]
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, str(after), number, *arguments],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert "Interrupted: " in done.stdout
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["status"] == "interrupted"
    written = {*os.listdir(tmp_path / "run")}
    assert written == {*result["run"]["files"]}
    if after == 0:
        assert (result["baseline"], result["optimized"]) == (None, None)
        assert written == {"config.yaml", "result.json"}
    else:
        assert result["optimized"]["status"] == "periodic"
        assert result["verification"]["holds_up"]
        assert result["improvement"]["objective"] > 0
        assert {
            "history.csv",
            "optimized.yaml",
            "profile_optimized.csv",
            "response_optimized.csv",
        } <= written
    # If there are designs to continue with, the checkpoint is kept.
    kept = [".run.checkpoint"] if after else []
    assert sorted(os.listdir(tmp_path)) == [*kept, "run", "scene.yaml"]


# Interrupted and resumed searches, which equal an uninterrupted one to the last bit


HEADER = {"config": {"a": 1}, "versions": {"jax": "1"}}


def evaluation(value):
    start = Seed(np.array([value / 7, np.pi]), (np.array([[value]]), np.array(True)))
    return Evaluation(
        design={"a": value}, geometry={}, response={"mean_force_N": value / 3}, gradient={},
        steady_state={"period": 1}, status=Status.PERIODIC, message="", statistics={},
        series=None, start=start,
    )  # fmt: skip


def outcome(result):
    """Return everything that a search finds, without its run times."""
    rows = [{k: repr(v) for k, v in row.items()} for row in result.history]
    record = result.optimized.record() | {"statistics": None}
    return json.dumps([rows, record, result.optimality.record(), result.constraints])


def test_the_command_keeps_its_checkpoint_until_the_run_is_in_place(tmp_path, monkeypatch):
    """A kill while files are written does not lose the search, nor does an abandoned run."""
    kept, older = (tmp_path / f".run.checkpoint{end}" for end in ("", ".old"))
    kept.write_text("of an earlier run")

    def search_of(config, progress, stop, checkpoint, runs):
        checkpoint.add([((0, 0), ([0.0], evaluation(0.1)))])
        return types.SimpleNamespace(run=lambda: None, so_far=lambda: None)

    monkeypatch.setattr(work, "search_of", search_of)
    arguments = ["configs/cic_drawn.yaml", "-o", str(tmp_path / "run")]
    with mock.patch.object(RunFolder, "put_in_place", side_effect=InputError("no space")):
        assert command.main(arguments) == 2
    assert (older.read_text(), kept.exists()) == ("of an earlier run", True)
    command.main([*arguments, "--resume"])
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize(
    "more", [(), pytest.param(("objective.speeds_rpm=[2700, 3300]",), marks=pytest.mark.long)]
)
def test_a_resumed_search_equals_one_that_was_not_interrupted(tmp_path, more):
    """The file is cut at a random byte, as after a kill, and its lines are damaged at random.

    Orbits are closed from those of neighbours, which the file does not hold."""
    short = "screening=2", "starts=1", "iterations=2", "prove=false"
    settings, path = config(*(f"optimizer.{one}" for one in short), *more), tmp_path / "c"
    full = Checkpoint(HEADER, path)
    expected = outcome(Search(settings, checkpoint=full).run())
    assert b"from_neighbour" in path.read_bytes()
    full.close()
    data = path.read_bytes()
    head, rng = data.index(b"\n") + 1, np.random.default_rng(0)
    cut = data[: rng.integers(head + (len(data) - head) // 2, len(data))]
    flipped = bytearray(data)
    flipped[rng.integers(head)] ^= 1
    for place in rng.integers(head, len(data), 3):
        flipped[place] ^= 1 << rng.integers(8)
    for content in (cut, flipped):
        path.write_bytes(content)
        resumed = Checkpoint(HEADER, path, resume=True)
        assert outcome(Search(settings, checkpoint=resumed).run()) == expected
        assert resumed.reused > 0
        assert resumed.damage
        resumed.close()
