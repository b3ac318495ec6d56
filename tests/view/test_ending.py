"""The end of a run: its sentences from results with known numbers, its commands in a shell."""

import io
import shlex
from pathlib import Path

import pytest
from rich.console import Console

from rootsopt.commands import cli
from rootsopt.commands.table import COMMANDS
from rootsopt.config import load
from rootsopt.status import Status
from rootsopt.view import terminal
from rootsopt.view.terminal import ending

DESIGN = dict(zip(load("cic_drawn").design_keys, (36.0, 9.0, 4.0), strict=True))
STEADY = {"kind": "periodic", "period": 2, "floquet_multiplier": -0.25, "residual": 3e-12}


def record(mean=50.0, peak=100.0, **more):
    return {
        "design": DESIGN,
        "response": {"mean_force_N": mean, "peak_force_N": peak},
        "gradient": {},
        "steady_state": STEADY,
        "status": "periodic",
        "message": Status.PERIODIC.value,
    } | more


def run_of(command, **more):
    return {"run": {"command": command}, "status": "periodic", "message": "Found."} | more


def optimum(**more):
    """Return an optimum: 40 % less mean force, 10 % more peak, half the seal width, two prices."""
    before = record(geometry={"seal_width_mm": 6.0, "polar_inertia_kg_m2": 2e-3},
                    pump={"leakage_fraction": 0.2})  # fmt: skip
    after = record(30.0, 110.0, geometry={"seal_width_mm": 3.0, "polar_inertia_kg_m2": 1.8e-3},
                   pump={"leakage_fraction": 0.0})  # fmt: skip
    row = {"sense": ">=", "limit": 3.0, "unit": "mm", "satisfied": True, "multiplier": 1.0}
    limits = [
        row | {"name": "seal width", "relaxed_by": -0.1, "relaxed_objective_percent": -0.5},
        row | {"name": "root radius", "relaxed_by": -0.1, "relaxed_objective_percent": -2.0},
        row | {"name": "outer radius", "baseline_satisfied": False, "multiplier": 0.0},
    ]
    found = {"converged": True, "residual": 2e-9, "required_residual": 1e-4, "message": "Yes.",
             "starts": [{}] * 3, "optima": [{"objective": 0.85, "found": 2}]}  # fmt: skip
    check = {"searched_objective": 0.8, "verified_objective": 0.84, "rejected": []}
    return run_of("optimize", baseline=before, optimized=after, improvement={"objective": 0.15},
                  constraints=limits, optimality=found, verification=check) | more  # fmt: skip


def facts_of(result, **more):
    return dict(ending(result, Path("run"), "cic", **more).facts)


def steps_of(result, place="run", source="cic", **more):
    return [*ending(result, Path(place), source, **more).steps]


def test_optimum_in_other_scenes():
    keys = [
        {"key": "contact.clearance_mm", "low": 0.0, "high": 0.04, "rank_correlation": 0.2,
         "worse": [[0.023, 0.04]]},
        {"key": "scene.load.torque_N_m", "low": 2.0, "high": 8.0, "rank_correlation": -0.75,
         "worse": [[2.0, 3.21], [5.0, 6.0]]},
    ]  # fmt: skip
    rival = {"design": {"pressure_angle_deg": 44.04}, "share_better": 0.375, "objective": 0.9,
             "rank_correlation": 0.5, "key": "contact.clearance_mm", "better": []}  # fmt: skip
    spread = {
        "compared": 31, "share_better": 30 / 31, "ends_better": 2, "ends_compared": 4,
        "objective_quantiles": {"quantile_5": 0.7, "median": 0.8, "quantile_95": 0.95},
        "worst": {"objective": 1.17}, "keys": keys, "decides": "scene.load.torque_N_m",
        "rivals": [rival],
        "not_compared": [{"status_baseline": "idle", "status_optimized": "chaotic"}] * 2,
    }  # fmt: skip
    assert facts_of(optimum(assumptions=spread))["Other scenes"] == (
        "The optimum is better than the baseline in 30 of 31 random scenes within the assumptions "
        "and at 2 of 4 ends of their ranges: objective 0.7 to 0.95 (5 % to 95 % of the random "
        "scenes), at worst 1.17. All else as given, it is worse where the clearance of the flanks "
        "is above 23 µm and where the load is below 3.21 N·m or is between 5 N·m and 6 N·m. "
        "Another design (pressure angle 44°) is better than the optimum in 37.5 % of the random "
        "scenes, mostly with more clearance of the flanks (rank correlation 0.5). "
        "Scenes that cannot be compared: 2 (baseline idle, optimum chaotic)."
    )
    for row in keys:
        row["worse"] = []
    rival["better"], rival["share_better"] = [[0.01, 0.04]], None
    told = facts_of(optimum(assumptions=spread))["Other scenes"]
    assert "Its objective rises most with less load (rank correlation −0.75)." in told
    assert "in – of the random scenes and, all else as given, where the clearance" in told


def test_optimum_in_three_sentences():
    assert facts_of(optimum()) == {
        "Gained": "The objective is 15 % below the baseline's: mean force −40 %, leakage fraction "
        "−100 % and polar inertia −10 %; limits that the baseline violates are satisfied: outer "
        "radius.",
        "Costs": "Seal width −50 % and peak force +10 %; price of a limit, in objective: root "
        "radius ≥ 3 mm (−2 % for −0.1 mm) and seal width ≥ 3 mm (−0.5 % for −0.1 mm).",
        "How sure": "A certified optimum: first-order residual 2 × 10⁻⁹, at most 0.0001 required; "
        "2 of 3 local searches found it; simulated again from rest, its objective agrees to 0.05 "
        "(relative).",
    }


def test_optimum_that_is_none_says_so():
    given = optimum(status="not_converged", improvement={"objective": -0.05})
    given["optimality"] |= {"converged": False, "message": "Raise optimizer.iterations."}
    given["robustness"] = {"fresh": {
        name: {"scenes": 9, "objective": {"mean": mean}, "failed_share": lost}
        for name, mean, lost in (("baseline", 1.0, 0.0), ("robust", 0.9, 0.125))
    }}  # fmt: skip
    facts = facts_of(given)
    assert facts["Gained"].startswith("The objective is 5 % above the baseline's: ")
    assert "; rough price of a limit" in facts["Costs"]
    assert facts["How sure"].startswith("Not an optimum: first-order residual 2 × 10⁻⁹")
    assert "local searches" not in facts["How sure"]
    assert facts["How sure"].endswith(
        "mean objective in 9 fresh scenes that scatter: baseline 1 and robust 0.9, without a "
        "usable motion: baseline 0 % and robust 12.5 %. Raise optimizer.iterations."
    )
    same = record(geometry={"seal_width_mm": 6.0})
    assert facts_of(run_of("optimize", baseline=same, optimized=same, verification={})) == {
        "Gained": "No reported quantity is better.",
        "Costs": "No reported quantity is worse by 0.05 % or more.",
        "How sure": "The design has no certificate.",
    }


def test_simulation_says_how_sure_it_is():
    slow = f"{Status.PERIODIC.value} But a disturbance fades slowly."
    given = run_of("simulate", **record(gradient={"peak_force_N": dict(DESIGN)}, message=slow))
    given["statistics"] = {"gradient_disagreement": 4e-6}
    assert facts_of(given) == {
        "Contact force": "A mean of 50 N and a peak of 100 N, 2 times the mean; the motion repeats "
        "every 2 mesh periods.",
        "How sure": "The orbit is closed to a residual of 3 × 10⁻¹²; its largest Floquet "
        "multiplier is 0.25; halving the steps changes its derivatives by 4 × 10⁻⁶ (relative). But "
        "a disturbance fades slowly.",
    }
    given["steady_state"] = STEADY | {"mean_force_standard_error_N": 1.5}
    assert "; standard errors: mean force 1.5 N. But" in facts_of(given)["How sure"]


@pytest.mark.parametrize("command", ["simulate", "optimize", "pareto", "attractors"])
@pytest.mark.parametrize("status", [Status.CHAOTIC, Status.NOT_IMPROVED, Status.PASSED_THROUGH])
def test_run_without_a_result_says_why_and_what_to_change(command, status):
    alone = record(steady_state={"kind": "transient", "window_mesh_periods": 300})
    given = run_of(command, **(alone if command == "simulate" else {}))
    given |= {"status": status.label, "message": status.value}
    name, rest = status.label.replace("_", " ").capitalize(), status.value.partition(". ")[2]
    facts = facts_of(given)
    assert [*facts.items()][:1] == [("Status", f"{name}: {status.meaning}")]
    assert steps_of(given, source="cic --set a=1") == [
        (rest, ""), ("Then run it again", f"rootsopt {command} cic --set a=1")
    ]  # fmt: skip
    if command == "simulate":
        assert facts["How sure"] == "The numbers are those of a window of 300 mesh periods."


@pytest.mark.parametrize(("pump", "term"), [({}, "flow_ripple"), ({"volumetric_efficiency": 0.9},
                                            "leakage_fraction")])  # fmt: skip
def test_flanks_that_stay_apart_are_a_result(pump, term):
    """The ending says what keeps them apart, how many machines touch, and what to minimise."""
    said = "The timing gear keeps the flanks apart. Their least gap is 120 µm."
    given = run_of("simulate", **record(message=said)) | {"status": "idle", "pump": pump}
    given["response"] = {"mean_force_N": 0.0, "peak_force_N": 0.0, "gear_force_N": 254.4}
    keys = [{"key": "contact.clearance_mm"}]
    given["touching"] = {"machines": 10000, "touching_share": 0.016, "keys": keys}
    assert facts_of(given)["Flanks"] == (
        f"{said} The teeth of the timing gear carry up to 254.4 N; the motion repeats every 2 mesh "
        "periods."
    )
    assert facts_of(given)["How sure"].endswith(
        "Of 10000 machines within tolerances, 1.6 % touch; clearance costs most of the reserve."
    )
    steps = dict(steps_of(given))
    assert f"{{{term}: 1}}" in steps.pop("Optimise the design")
    assert all(term not in step for step in steps.values())


def test_constraints_in_conflict_are_part_of_the_status():
    told, advice = "No design does. In conflict: width >= 25 mm.", "Relax one of these."
    given = run_of("optimize", status="infeasible", message=f"{told} {advice}")
    assert facts_of(given) == {"Status": f"Infeasible: {told}"}
    assert steps_of(given)[0] == (advice, "")


def test_the_reserve_is_part_of_what_was_gained():
    response = {"mean_force_N": 0.0, "peak_force_N": 0.0, "contact_reserve_um": 12.5}
    striking = run_of("simulate", **record(response=response | {"contact_reserve_um": -3.0}))
    assert "the reserve against contact is −3 µm" in facts_of(striking)["Contact force"]
    closer = record(response=response | {"contact_reserve_um": 20.0})
    given = run_of("optimize", baseline=record(response=response), optimized=closer)
    assert "contact goes from 12.5 µm to 20 µm" in facts_of(given)["Gained"]


FRONT = run_of(
    "pareto",
    terms=[
        {"name": "peak_force_N", "sense": "min"}, {"name": "area_efficiency", "sense": "max"}
    ],
    points=[
        {"point": k, "terms": {"peak_force_N": 100.0 * k, "area_efficiency": 0.4 + 0.01 * k},
         "rates": {"area_efficiency": rate}, "design": DESIGN}
        for k, rate in ((1, None), (2, 2500.0), (3, None))
    ],
    baseline=record(),
    message="Certified.",
)  # fmt: skip
SWEEP = [{"scene.speed_rpm": 1e3 * k, "peak_force_N": force, "status": status}
         for k, force, status in ((1, 50.0, "periodic"), (2, 60.0, "periodic"),
                                  (3, None, "chaotic"))]  # fmt: skip
MOTIONS = run_of(
    "attractors",
    attractors=[record(share=share, reached=share > 0.5) for share in (0.75, 0.2)],
    lost={"chaotic": 0.05},
)
GEOMETRY = run_of(
    "profile",
    design=DESIGN,
    geometry={"outer_radius_mm": 45.0, "area_efficiency": 0.4345},
    pump={"displaced_volume_cm3": 555.0, "flow_ripple": 0.16},
    status="geometry_only",
)


def test_short_endings():
    assert facts_of(FRONT) == {
        "Best compromises": "3 points: peak force from 100 to 300 N and area efficiency from 0.41 "
        "to 0.43.",
        "Costs": "The peak force at point 2: +25 N for +0.01 of area efficiency.",
        "How sure": "Certified.",
    }
    assert facts_of(run_of("sweep", status="chaotic"), rows=SWEEP) == {
        "Peak force": "It is lowest, 50 N, at speed 1000 rpm; highest, 60 N, at speed 2000 rpm.",
        "How sure": "2 of 3 scenes have a steady state. The others: 1 chaotic.",
    }
    assert facts_of(MOTIONS) == {
        "Motions": "2 motions coexist; motion 1 (periodic): peak force 100 N, 75 % of the initial "
        "states, reached from rest; motion 2 (periodic): peak force 100 N, 20 % of the initial "
        "states.",
        "How sure": "5 % of the initial states lead to no reported motion.",
    }
    assert facts_of(GEOMETRY) == {
        "Rotor": "Outer radius 45 mm; 43.45 % of the circle of this radius pumps; displaced volume "
        "555 cm³; flow ripple 0.16.",
        "How sure": "Found.",
    }


ROWS = [{"point": 0, "scene.load.torque_N_m": 4.8, "profile.family": "it's", "peak_force_N": 9.0,
         "status": "periodic"}]  # fmt: skip


@pytest.mark.parametrize(
    ("result", "rows", "count"),
    [
        (optimum(), (), 3),
        (run_of("simulate", **record()), (), 3),
        (FRONT, (), 2),
        (MOTIONS, (), 1),
        (GEOMETRY, (), 2),
        (run_of("sweep"), ROWS, 2),
        (run_of("sweep"), SWEEP, 2),
        (run_of("pareto", status="interrupted"), (), 1),
    ],
)
def test_every_command_parses(result, rows, count):
    """Paths and values are quoted for a shell, files of `--import` come along."""
    place = "-my runs/{a}'é"
    source = shlex.join(["cic", "-o", place])
    steps = steps_of(result, place, source, imports=["my file.py"], rows=rows)
    assert len(steps) == count
    for _, step in steps:
        program, name, *arguments = shlex.split(step)
        options = cli.parser(COMMANDS[name]).parse_args(arguments)
        assert program == "rootsopt"
        assert options.imports == ["my file.py"] or options.resume
        assert str(options.config) == "cic" or options.config.parent.is_relative_to(place)


def test_commands_set_what_they_are_about():
    (_, first), _ = steps_of(run_of("sweep"), rows=ROWS)
    assert shlex.split(first)[3:] == [
        "--set", "scene.load.torque_N_m=4.8", "--set", "profile.family=it's"
    ]  # fmt: skip
    assert "--set scene.speed_rpm=2000" in steps_of(run_of("sweep"), rows=SWEEP)[0][1]
    assert steps_of(MOTIONS)[0][1].endswith("config.yaml --set objective.motion=worst")
    assert "optimize" not in str(steps_of(run_of("simulate", **record(design={}))))


def test_terminal_prints_commands_in_lines_of_their_own():
    out = Console(width=40, file=io.StringIO())
    end = ending(
        optimum(), Path("a folder with a long name that no line of this width holds, é"), "cic"
    )
    terminal.show_ending(out, end)
    text = out.file.getvalue()
    assert {f"  {command}" for _, command in end.steps} <= {*text.splitlines()}
    told = " ".join(text.split())
    facts = [f"{heading}: {terminal.ascii_text(sentences)}" for heading, sentences in end.facts]
    assert [fact for fact in facts if fact not in told] == []
