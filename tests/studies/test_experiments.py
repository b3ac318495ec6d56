"""All studies are listed and say what they are.

Run with `--quick`, they write their files and give sane numbers."""

import csv
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from experiments import __main__ as command
from experiments._common import engines
from experiments._common.engines.scipy_nodes import ScipyNodes
from rootsopt.config import load
from tests.weight import ROOT

PNG = b"\x89PNG"
EXPERIMENTS = ROOT / "experiments"
KNOWN = command.studies()
STUDIES = sorted(path.name for path in EXPERIMENTS.glob("[!_.]*") if path.is_dir())
LONGEST = 400
"""Number of lines of study.py and its further modules up to which they are one file."""
FROM_COMMANDS = {"basins", "drawing", "explore", "force", "pareto", "report", "sweep"}
"""Figures of the docs pages that commands make, not studies."""


@pytest.mark.parametrize("study", STUDIES)
def test_files(study):
    """A study is one file, or several where that would be too long. `run(job)` runs it."""
    folder = EXPERIMENTS / study
    lines = [len(path.read_text().splitlines()) for path in folder.glob("[!_]*.py")]
    assert max(lines) <= LONGEST
    assert len(lines) == 1 or sum(lines) > LONGEST
    assert re.search(r"^def run\(job(: Run)?\)", (folder / "study.py").read_text(), re.M)


def test_readme_lists_the_studies():
    """Each study has a row: its question, its command, existing pages, and its run time."""
    text = (EXPERIMENTS / "README.md").read_text()
    rows = re.findall(r"^\| (.+) \| `(.+)` \| (.+) \| (.+) \|$", text, re.M)
    assert [said for _, said, *_ in rows] == [f"python -m experiments {s}" for s in STUDIES]
    assert list(KNOWN) == STUDIES
    for (said, _), (question, _, page, _) in zip(KNOWN.values(), rows, strict=True):
        assert question == said.splitlines()[0]
        assert question.endswith("?")
        assert all((EXPERIMENTS / link).exists() for link in re.findall(r"\]\(([^)#]+)", page))


def test_published_figures_are_those_of_the_docs():
    made = [name for _, study in KNOWN.values() for name in study.published.values()]
    assert len(set(made)) == len(made)
    assert {*made} | {f"{name}.png" for name in FROM_COMMANDS} == {
        path.name for path in (ROOT / "docs").glob("*.png")
    }


def test_all_studies_run(monkeypatch, tmp_path, capsys):
    """`--all` runs every study with its further runs; those that must run alone come last."""
    begun = []

    def run(words, **_):
        begun.append(" ".join(words[3 : words.index("-o")]))
        return subprocess.CompletedProcess(words, 3 * ("chaos" in words), "its output")

    monkeypatch.setattr(command.subprocess, "run", run)
    monkeypatch.setattr(sys, "argv", ["experiments", "--all", "-o", str(tmp_path)])
    assert command.main() == 3
    assert {*begun} == {*STUDIES, "paper --search", "orbits --speed"}
    assert begun[-4:] == ["benchmark", "families", "orbits --speed", "parts"]
    said = capsys.readouterr().out
    assert [line.split()[-1] for line in said.splitlines() if "code 3" in line] == ["chaos"]


HELP = """
import sys
from experiments.__main__ import main
for name in sys.argv[1:]:
    sys.argv = ["experiments", name, "--help"]
    try:
        main()
    except SystemExit as end:
        assert end.code == 0, name
    assert "jax" not in sys.modules, name
"""


def test_help_answers_at_once():
    """`python -m experiments NAME --help` prints the question, and does not load JAX."""
    told = subprocess.check_output([sys.executable, "-c", HELP, *STUDIES], cwd=ROOT, text=True)
    for name, (said, _) in KNOWN.items():
        assert f"usage: python -m experiments {name} " in told
        assert said.splitlines()[0] in told


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """Return an environment in which the studies share a folder of compiled programs."""
    return os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path_factory.mktemp("programs")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


def run(study, folder, environment, *options):
    """Make a reduced run of a study, which draws its published figures; return its output."""
    words = [sys.executable, "-m", "experiments", study, "--quick", "-o", str(folder), *options]
    told = subprocess.check_output(words, env=environment, text=True)
    drawn = {path.name for path in folder.glob("*.png") if path.read_bytes()[:4] == PNG}
    assert drawn == {*KNOWN[study][1].published}
    return told


def rows_of(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def numbers(rows, key):
    return [float(row[key]) for row in rows]


@pytest.mark.long
def test_gradients(tmp_path, programs):
    assert run("gradients", tmp_path, programs).endswith("0 promises broken\n")
    rows = rows_of(tmp_path / "gradients.csv")
    assert len(rows) == 12
    # What the differences do not know is no error of the gradient.
    off = np.subtract(*(numbers(rows, f"mean_force_N_{what}") for what in ("error", "noise")))
    assert np.max(off) < 1e-4


# Studies whose reduced run is only seen to end and to draw its figures.
OTHERS = KNOWN.keys() - {"gradients", "tolerances", "benchmark", "twist", "paper", "identify"}


@pytest.mark.long
@pytest.mark.parametrize("study", sorted(OTHERS))
def test_study_runs(study, tmp_path, programs):
    run(study, tmp_path, programs)


@pytest.mark.long
def test_tolerances(tmp_path, programs):
    """All designs are evaluated in every fresh scene.

    The robust optimum is no worse over the search's sample."""
    run("tolerances", tmp_path, programs)
    rows = rows_of(tmp_path / "tolerances.csv")
    assert [row["design"] for row in rows] == ["baseline", "nominal", "robust"]
    before, *after = numbers(rows, "robust_objective")
    assert before == 1 > max(after)
    peaks = numbers(rows_of(tmp_path / "tolerances_scenes.csv"), "robust_peak_force_N")
    assert np.mean(peaks) == pytest.approx(float(rows[2]["peak_force_N_mean"]), rel=1e-8)


@pytest.mark.long
def test_benchmark(tmp_path, programs):
    run("benchmark", tmp_path, programs)
    rows = rows_of(tmp_path / "benchmark.csv")
    parts = {"scipy", "numba", "single", "batch 4", "revolutions", "main job"}
    assert {row["part"] for row in rows} == parts
    assert min(numbers(rows, "run_s")) > 0
    assert min(numbers(rows, "peak_memory_MB")) > 10
    assert max(float(row["value_error"] or 0) for row in rows) < 1e-2
    assert json.loads((tmp_path / "benchmark.json").read_text())["not_measured"] == {}
    turned = [row for row in rows if row["part"] == "revolutions"]
    turns = (np.log(numbers(turned, key)) for key in ("revolutions", "run_s"))
    assert 0.5 < np.polyfit(*turns, 1)[0] < 1.6


@pytest.mark.long
def test_twist(tmp_path, programs):
    """A twist evens the flow by its closed form, and lowers the peak of the force."""
    run("twist", tmp_path, programs)
    straight, turned = rows_of(tmp_path / "twist.csv")
    assert float(straight["flow_ripple"]) == pytest.approx(2 / 13)
    assert float(turned["flow_ripple"]) == pytest.approx(2 / 13 * 2 / np.pi)
    assert float(turned["peak_force_N"]) < float(straight["peak_force_N"])
    assert float(turned["axial_force_max_N"]) > 1 > float(straight["axial_force_max_N"])


@pytest.mark.long
def test_paper(tmp_path, programs):
    """The shipped values give the paper's four forces (its section 4), both motions periodic; here
    with linear contact, which is some 3 % off."""
    run("paper", tmp_path, programs)
    (row,) = rows_of(tmp_path / "paper.csv")
    # Each quantity matters, and a thousandth of it changes no force by more than a hundredth.
    rows = rows_of(tmp_path / "paper_slices.csv")
    assert len({one["changed"] for one in rows}) == 6
    assert len({one["ee_mean_force_N"] for one in rows}) == 12
    for name, force in (
        ("cic_mean_force_N", 102.4),
        ("cic_peak_force_N", 1973.3),
        ("ee_mean_force_N", 1047.1),
        ("ee_peak_force_N", 5661.4),
    ):
        assert float(row[name]) == pytest.approx(force, rel=0.035)
        assert numbers(rows, name) == pytest.approx([float(row[name])] * 12, rel=1e-2)
    assert (row["cic_status"], row["ee_status"]) == ("periodic", "periodic")


def test_paper_by_scipy():
    config = load("configs/paper_cic.yaml")
    found = ScipyNodes(
        engines.Scene.of(config), nodes=400, rtol=1e-5, settle=10, window=2
    ).simulate([36.43, 9.0, 4.0])
    assert (found.mean, found.peak) == pytest.approx((102.4, 1973.3), rel=1e-3)


def test_paper_scene_is_shared():
    cic, ee = (load(f"configs/paper_{family}.yaml").model_dump() for family in ("cic", "ee"))
    assert cic.pop("profile") != ee.pop("profile")
    assert cic == ee


@pytest.mark.long
def test_identify(tmp_path, programs):
    run("identify", tmp_path, programs)
    assert [row["inside"] for row in rows_of(tmp_path / "identify.csv")] == ["true", "true"]
