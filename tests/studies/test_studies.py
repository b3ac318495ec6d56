"""All studies are listed, have the same files, and do not depend on each other."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXPERIMENTS = ROOT / "experiments"
STUDIES = sorted(path.name for path in EXPERIMENTS.glob("[!_.]*") if path.is_dir())
FILES = {"study.py", "figures.py", "__main__.py"}
LONGEST = 400
"""Number of lines of study.py and its further modules up to which they are one file."""
FROM_COMMANDS = {"basins", "drawing", "explore", "force", "pareto", "report", "sweep"}
"""Figures of the docs pages that commands make, not studies."""


def tree_of(study, name):
    return ast.parse((EXPERIMENTS / study / name).read_text())


def modules_of(folder):
    return [path for path in folder.rglob("*.py") if path.is_file()]


def imported(path):
    """Return the full names of all modules that a file imports, inside functions too."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [one.name for one in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            found += [f"{base}.{one.name}" for one in node.names]
    return found


@pytest.mark.parametrize("study", STUDIES)
def test_files(study):
    """Each study has the same three files.

    It has further modules only where study.py would be too long."""
    folder = EXPERIMENTS / study
    names = {path.name for path in folder.iterdir() if path.name != "__pycache__"}
    assert names >= FILES
    further = names - FILES
    assert all(name.endswith(".py") for name in further)
    lines = {name: len((folder / name).read_text().splitlines()) for name in names}
    assert lines["study.py"] <= LONGEST
    if further:
        assert lines["study.py"] + sum(lines[name] for name in further) > LONGEST


@pytest.mark.parametrize("study", STUDIES)
def test_study_has_one_entry(study):
    """`run(quick, ...)` computes, and some functions of figures.py return figures."""
    functions = [x for x in tree_of(study, "study.py").body if isinstance(x, ast.FunctionDef)]
    (run,) = [one for one in functions if one.name == "run"]
    assert run.args.args[0].arg == "quick"
    functions = [x for x in tree_of(study, "figures.py").body if isinstance(x, ast.FunctionDef)]
    assert any("Figure" in ast.unparse(one.returns) for one in functions if one.returns)


@pytest.mark.parametrize("folder", [*STUDIES, "_common"])
def test_no_study_imports_another(folder):
    for path in modules_of(EXPERIMENTS / folder):
        for name in imported(path):
            assert not name.startswith("."), f"{path}: relative import {name}"
            if name.startswith("experiments."):
                assert name.split(".")[1] in {folder, "_common"}, f"{path} imports {name}"


def test_imports_need_no_exception():
    """Nothing is computed on import, so that no import depends on double precision."""
    for path in modules_of(EXPERIMENTS):
        assert "noqa" not in path.read_text(), path


def test_readme_lists_the_studies():
    """Each study has a row: its question, its command, existing pages, and its minutes."""
    text = (EXPERIMENTS / "README.md").read_text()
    rows = re.findall(r"^\| (.+) \| `(.+)` \| (.+) \| (.+) \|$", text, re.M)
    assert [command for _, command, *_ in rows] == [f"python -m experiments.{s}" for s in STUDIES]
    for study, (question, _, page, minutes) in zip(STUDIES, rows, strict=True):
        said = ast.get_docstring(tree_of(study, "__main__.py")) or ""
        assert question == said.splitlines()[0]
        assert question.endswith("?")
        assert all((EXPERIMENTS / link).exists() for link in re.findall(r"\]\(([^)#]+)", page))
        assert re.search(r"\d|under", minutes)


def test_published_figures_are_those_of_the_docs():
    """Every figure of the docs pages is made by one study or by a command."""
    made = []
    for study in STUDIES:
        made += importlib.import_module(f"experiments.{study}.__main__").FIGURES.values()
    assert len(set(made)) == len(made)
    assert {*made} | {f"{name}.png" for name in FROM_COMMANDS} == {
        path.name for path in (ROOT / "docs").glob("*.png")
    }


HELP = """
import runpy, sys
for name in sys.argv[1:]:
    sys.argv = [name, "--help"]
    try:
        runpy.run_module(f"experiments.{name}", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        assert end.code == 0, name
    assert "jax" not in sys.modules, name
"""


def test_help_answers_at_once():
    """`python -m experiments.NAME --help` prints the question, and does not load JAX."""
    command = [sys.executable, "-c", HELP, *STUDIES]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for study in STUDIES:
        assert f"usage: python -m experiments.{study} " in done.stdout
        question = (ast.get_docstring(tree_of(study, "__main__.py")) or "").splitlines()[0]
        assert question in done.stdout


def test_reduced_figures_are_not_published(tmp_path):
    """`--docs` with `--quick` is refused before anything is computed or written."""
    folder = tmp_path / "results"
    command = [sys.executable, "-m", "experiments.chaos", "--quick", "--docs", "-o", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "--docs" in done.stderr
    assert not folder.exists()
