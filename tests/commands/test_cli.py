"""Tests of the commands from outside: files, exit codes, messages, completion by a shell."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
import yaml

from rootsopt import profiles
from rootsopt.commands import cli, console
from rootsopt.commands.table import COMMANDS, profile
from rootsopt.config import Config, load
from rootsopt.config.explain import GROUPS, describe
from rootsopt.measured.loop import signed_area
from rootsopt.measured.reading import read
from rootsopt.runtime import programs
from rootsopt.scene import Scene, design_vector
from tests.runtime.test_environment import HARMLESS, SET_ASIDE

ROOT = Path(__file__).parents[2]
CIC = str(ROOT / "configs" / "cic_drawn.yaml")
EE = str(ROOT / "configs" / "ee.yaml")


@pytest.fixture
def command(capfd, monkeypatch):
    """Return a function that runs a command in this process: exit code, stdout and stderr."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("COLUMNS", "100")

    def run(*arguments):
        capfd.readouterr()
        code = console.main([*map(str, arguments)])
        return SimpleNamespace(returncode=code, **capfd.readouterr()._asdict())

    return run


def test_optimize_writes_the_contract(tmp_path, command):
    """`optimize` writes every promised file, a table and the times of compiling and running.

    The exit code is 0 and stderr is empty."""
    done = command(
        "optimize", CIC, "-o", tmp_path, "--export", "dxf", "--set=optimizer.screening=2",
        "--set=optimizer.starts=1", "--set=optimizer.iterations=2", "--set=optimizer.prove=false",
        "--set=assumptions.scenes=0",
    )  # fmt: skip
    assert (done.returncode, done.err) == (0, "")
    words = "baseline", "optimised", "pressure angle", "mean force", "periodic", "compile"
    assert [word for word in (*words, "Pump sheet") if word not in done.out] == []
    result = json.loads((tmp_path / "result.json").read_text())
    assert {"improvement", "constraints", "versions"} <= set(result)
    for name in ("baseline", "optimized"):
        record = result[name]
        assert record["status"] == record["steady_state"]["kind"] == "periodic"
        assert set(record["design"]) == set(record["gradient"]["mean_force_N"])
        assert [*pd.read_csv(tmp_path / f"profile_{name}.csv")] == ["x_mm", "y_mm"]
        force = pd.read_csv(tmp_path / f"response_{name}.csv").contact_force_N.mean()
        assert force == pytest.approx(record["response"]["mean_force_N"], rel=1e-3)
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["optimizer"]["screening"] == 2
    # Two iterations are too few for the first-order conditions.
    assert result["status"] in ("periodic", "not_converged")
    assert result["optimality"]["converged"] == (result["status"] == "periodic")
    assert len(result["optimality"]["starts"]) == 1
    assert all("multiplier" in row for row in result["constraints"])
    names = "profiles", "meshing", "force", "spectrum", "history", "comparison"
    assert {*os.listdir(tmp_path / "figures")} == {f"{name}.png" for name in names}
    assert (tmp_path / "history.csv").read_text().count("\n") >= 4
    # The optimised design, as a config and as a drawing, both read back.
    best, config = result["optimized"]["geometry"], load(tmp_path / "optimized.yaml")
    drawn = profiles.geometry(Scene.from_config(config).profile(design_vector(config)))
    assert float(drawn.area) * 1e6 == pytest.approx(best["area_mm2"], rel=1e-9)
    area = abs(signed_area(read(tmp_path / "rotor.dxf").points))
    assert area == pytest.approx(best["area_mm2"], rel=1e-3)


def test_profile_writes_one_record(tmp_path, command):
    """`profile` simulates nothing, and tells what looks like another unit."""
    odd = "--set=profile.lobes=2", "--set=scene.load.torque_N_m=4775"
    done = command("profile", EE, "-o", tmp_path, *odd)
    assert done.returncode == 0, done.err
    record = json.loads((tmp_path / "result.json").read_text())
    assert f"\n  rootsopt simulate {tmp_path / 'config.yaml'}\n" in done.out
    assert "rootsopt optimize" not in done.out  # EE has no design parameters.
    (note,) = record["notes"]  # A value that looks like another unit is told, not refused.
    assert done.err == f"rootsopt: {note}\n"
    assert "N·mm? write 4.775" in note
    assert record["geometry"]["area_efficiency"] == pytest.approx(0.5, abs=1e-12)
    assert record["response"] == {}
    assert record["margins"]["root_mm"] == pytest.approx(record["geometry"]["root_radius_mm"])
    # The roll angle advances by 1 / (1 + N) of the turn of an epicycloid's normal.
    assert record["margins"]["rolling"] == pytest.approx(1 / 3, abs=1e-9)


def test_no_usable_result_exits_3(tmp_path, command):
    weak = "--set=scene.timing_gear.stiffness_N_m_per_rad=1", "--set=scene.load.torque_N_m=40"
    for module in ("simulate", "optimize"):
        done = command(module, CIC, "--no-figures", *weak, "-o", tmp_path / module)
        assert done.returncode == 3, done.err
        assert "passed through" in done.out
        result = json.loads((tmp_path / module / "result.json").read_text())
        record = result if module == "simulate" else result["baseline"]
        assert (record["status"], record["response"]) == ("passed_through", {})


SPEEDS = "--over=scene.speed_rpm=1000:2000:2"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "missing.yaml"], ["missing.yaml", "no such file"]),
        (["simulate", CIC, "--set=profile.presure_angle_deg=30"], ["profile.pressure_angle_deg"]),
        (["simulate", CIC, "--set=profile.lobes=9"], ["profile.lobes", "6", "9"]),
        (["simulate", CIC, "--set=scene.speed_rpm=fast"], ["scene.speed_rpm", "number", "fast"]),
        (["simulate", CIC, "--set=profile.involute_length_mm=20"], ["involute_length_mm", "20"]),
        (["simulate", CIC, "--set", "scene.speed_rpm"], ["dotted.key=value"]),
        (
            ["simulate", CIC, "--set=scene.center_distance_error_mm=-0.1",
             "--set=pump={viscosity_mPa_s: 50, pressure_difference_Pa: 2.0e5}"],
            ["must not overlap", "raise `contact.clearance_mm`"],
        ),
        (["sweep", "cic", "--sobol=4", "--zip"], ["does not go with samples"]),
        (["sweep", "cic", "--over=scene.sped_rpm=1,2"], ["did you mean `scene.speed_rpm`"]),
        (["sweep", "cic", SPEEDS, "--over=scene.speed_rpm=3"], ["given twice"]),
        (["sweep", "cic", SPEEDS, "--seed=1"], ["--sample N"]),
        (["sweep", "cic", SPEEDS, "--zip", "--zip-keys=a,b"], ["remove one"]),
        (["sweep", "cic", SPEEDS, "--resume"], ["there is no"]),
        (["sweep", "cic", SPEEDS, "--tolerances=4"], ["remove one"]),
        (["sweep", "cic", "--tolerances=4"], ["section `tolerances`"]),
        (["sweep", "cic", SPEEDS, "--workers=0"], ["from 1"]),
    ],
)  # fmt: skip
def test_bad_input_exits_2_with_one_message(arguments, words, tmp_path, command):
    done = command(*arguments, "-o", tmp_path / "out")
    assert (done.returncode, done.out) == (2, "")
    assert done.err.strip().count("\n") == 0
    assert [word for word in words if word not in done.err] == []
    assert os.listdir(tmp_path) == []


def test_console_command(monkeypatch, capsys):
    """A file after `-h` is not a group of keys.

    An unknown command gets the nearest name as a suggestion, completion the shells that it takes,
    or the missing library."""
    with pytest.raises(SystemExit, match=r"^0$"):
        console.main(["simulate", "-h", CIC])
    assert "backlash_mm" in capsys.readouterr().out
    monkeypatch.setattr(cli.importlib.util, "find_spec", lambda name: None)
    for arguments, words in (
        (["optimise"], "`optimize`"),
        (["--completion", "tcsh"], "bash or zsh"),
        (["--completion", "bash"], "rootsopt[completion]"),
    ):
        assert console.main(arguments) == 2
        assert words in capsys.readouterr().err


@pytest.mark.parametrize("command", ["optimize", "sweep", "new"])
def test_groups_of_the_help_have_every_key(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")

    def printed(*group):
        with pytest.raises(SystemExit, match=r"^0$"):
            COMMANDS[command].main(["--help", *group])
        return capsys.readouterr().out

    assert {*re.findall("--help ([a-z |]+)$", printed(), re.M)[-1].split(" | ")} == set(GROUPS)
    every = [line for group in GROUPS for line in printed(group).splitlines()]
    assert sorted(every) == sorted(describe(Config).splitlines())
    assert set(every) < set(printed("all").splitlines())


@pytest.mark.long
def test_simulate_in_an_odd_environment_with_the_programs_of_a_plain_one(tmp_path):
    """A second run finds every program in the cache, and gives the same numbers to the last bit.

    It has a copy of the cache, which no other process writes to. All variables are odd. Those that
    would change numbers or stop the run are named in a line on stderr."""
    cache, kept, answers = Path(os.environ["ROOTSOPT_CACHE"]), {}, []
    for run, variables in {"plain": {}, "odd": SET_ASIDE | HARMLESS}.items():
        if run == "odd":
            unfinished = shutil.ignore_patterns(".*")
            cache = Path(shutil.copytree(cache, tmp_path / "cache", ignore=unfinished))
            kept = {path.name: path.stat().st_ino for path in cache.iterdir()}
        done = subprocess.run(
            [sys.executable, "-m", "rootsopt", "simulate", EE, "--no-figures",
             "-o", str(tmp_path / run)],
            capture_output=True, text=True, cwd=ROOT, check=False,
            env=os.environ | {"COLUMNS": "100"} | variables | {"ROOTSOPT_CACHE": str(cache)},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        named = set(re.findall(r"\b([A-Z][A-Z0-9_]+)=", done.stderr))
        assert named == set(variables) & set(SET_ASIDE), done.stderr
        record = json.loads((tmp_path / run / "result.json").read_text())
        answers.append({key: record[key] for key in ("design", "geometry", "gradient", "response")})
    assert {"motion_from", "pair_and_tangents"} <= {name.split("-")[0] for name in kept}
    assert kept == {path.name: path.stat().st_ino for path in cache.iterdir()}
    assert answers[0] == answers[1]


def test_no_programs_are_kept_if_told_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(programs, "_store", None)
    monkeypatch.setenv("ROOTSOPT_CACHE", str(tmp_path / "cache"))
    arguments = EE, "-o", str(tmp_path / "p"), "--no-figures", "--export", "none"
    for more in (["--no-cache"], []):
        assert not (tmp_path / "cache").exists()
        assert profile.main([*arguments, *more]) == 0
        assert capsys.readouterr().err == ""
    assert (tmp_path / "cache").is_dir()


@pytest.fixture(scope="module")
def bash():
    return cli.completion("bash")


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("words", "first"),
    [
        (["si"], ["simulate"]),
        (["optimize", "--res"], ["--resume"]),
        (["simulate", "--set", "scene.timing_gear.b"], ["scene.timing_gear.backlash_mm="]),
        (["simulate", "ci"], ["cic", "cic_drawn"]),
    ],
)
def test_commands_options_and_keys_are_completed(bash, words, first):
    script = f"{bash}\nCOMP_WORDS=(rootsopt {' '.join(words)}); COMP_CWORD={len(words)}; "
    script += '_rootsopt 2>/dev/null; printf "%s\\n" "${COMPREPLY[@]}"'
    assert subprocess.check_output(["bash", "--norc", "-c", script], text=True).split() == first


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_of_the_help_is_in_the_script(command, bash, capsys):
    """The script has a command's own options, not only those that all commands share."""
    with pytest.raises(SystemExit, match=r"^0$"):
        console.main([command, "--help"])
    help_text = capsys.readouterr().out
    wanted = {*re.findall(r"^  (?:-\w[^,]*, )?(--[\w-]+)", help_text, re.M)} - {"--help"}
    own = {"explore": {"--set", "--port"}, "new": {"--lobes"}}.get(command, {"--set", "--report"})
    assert own <= wanted
    (line,) = re.findall(rf"^_shtab_rootsopt_{command}_option_strings=\((.*?)\)$", bash, re.M)
    assert wanted <= {word.strip("'") for word in line.split()}


def test_zsh_has_a_script():
    text = cli.completion("zsh")
    assert text.startswith("#compdef rootsopt")
    assert "scene.timing_gear.backlash_mm=" in text
