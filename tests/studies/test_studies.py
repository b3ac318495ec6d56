"""All studies are listed and say what they are."""

import re
import subprocess
import sys

import pytest

from experiments import __main__ as command
from tests.weight import ROOT

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
    alone = [name for name in STUDIES if KNOWN[name][1].alone]
    assert {*begun} == {*STUDIES, "paper --search", "orbits --speed"}
    assert [*dict.fromkeys(name.split()[0] for name in begun)][-len(alone) :] == alone
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
    command = [sys.executable, "-c", HELP, *STUDIES]
    told = subprocess.check_output(command, cwd=ROOT, text=True)
    for name, (said, _) in KNOWN.items():
        assert f"usage: python -m experiments {name} " in told
        assert said.splitlines()[0] in told
