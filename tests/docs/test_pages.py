"""The pages teach what works: the code of tutorial and notebooks runs.

Every link of the README, of the pages and of the studies leads to a file and a heading. What
docs/architecture.md names exists, and its table has the order of the layers."""

import ast
import functools
import itertools
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections import namedtuple

import pytest

import rootsopt
from rootsopt.commands.console import main
from rootsopt.config import load
from rootsopt.scene import check_geometry
from tests.standins import ROOT

DOCS = ROOT / "docs"
PAGES = [
    "index",
    "tutorial",
    "design",
    "howto",
    "theory",
    "accuracy",
    "gallery",
    "limits",
    "identify",
]
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.md"))
CELL = "{code-cell}"


# A fenced block, with the words after its language.
Fence = namedtuple("Fence", "language words text")


def blocks_of(page):
    """Return the fenced blocks of a page, in order."""
    found = re.findall(r"^```([^\s`]*)[ ]*([^\n`]*)\n(.*?)^```$", page.read_text(), re.M | re.S)
    return [Fence(*one) for one in found]


def in_shell(text, folder):
    """Run shell commands in a folder, where `rootsopt` is the package of this tree."""
    program = f'set -e\nrootsopt() {{ "{sys.executable}" -m rootsopt "$@"; }}\n{text}'
    return _run(["bash", "-c", program], folder)


def in_process(text, folder, capsys, monkeypatch):
    """Run the `rootsopt` commands of a shell block in this process and in a folder."""
    monkeypatch.chdir(folder)
    lines = text.replace("\\\n", " ").splitlines()
    codes = [main(shlex.split(line)[1:]) for line in lines if line.startswith("rootsopt ")]
    return subprocess.CompletedProcess(text, codes[-1], *capsys.readouterr())


def in_python(text, folder):
    """Run Python in a process and folder of its own, without a display."""
    file = folder / "page.py"
    file.write_text(text)
    return _run([sys.executable, str(file)], folder)


def _run(command, folder):
    places = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    extra = {"PYTHONPATH": os.pathsep.join(places), "MPLBACKEND": "Agg"}
    return subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, **extra},
        capture_output=True,
        text=True,
        check=False,
        timeout=1800,
    )


@pytest.mark.parametrize("name", PAGES)
def test_code_is_executed_or_named_as_not_executed(name):
    for block in blocks_of(DOCS / f"{name}.md"):
        if not block.language.startswith("{"):  # A directive.
            assert block.language in ("sh", "python", "yaml"), block
            told = block.words in {"run", "fails", "skip", "rotor.yaml"}
            assert told, f"{name}: say whether this block is run:\n{block.text}"


def _ended(done, block, page):
    """Assert that a block ended as the page says, with the message that it prints."""
    fails = block.words == "fails"
    assert done.returncode == (2 if fails else 0), f"{block.text}\n{done.stdout}\n{done.stderr}"
    if fails:
        assert done.stderr.strip().split(".yaml: ")[1] in " ".join(page.split())


@pytest.mark.parametrize("name", ["tutorial", "design"])
def test_page_begins(name, tmp_path, capsys, monkeypatch):
    """The steps that compile nothing: bad configs, a written or a new one, and its geometry."""
    page = (DOCS / f"{name}.md").read_text()
    (tmp_path / "rotor.yaml").touch()
    for block in blocks_of(DOCS / f"{name}.md"):
        if block.language == "yaml":
            (tmp_path / block.words).write_text(block.text)
        elif block.words == "fails" or re.search("rootsopt new|-o geometry", block.text):
            done = in_process(block.text, tmp_path, capsys, monkeypatch)
            _ended(done, block, page)
            if "rootsopt new" in block.text:
                told = "0.3 bar, which takes 15.6 kW without losses, 87% of the 18 kW"
                assert told in done.stdout
    assert {"profile_design.csv", "rotor.dxf"} <= {*os.listdir(tmp_path / "geometry")}


def _all_run(name, folder):
    """Write the files of a page into a folder, run its blocks there, and return its text."""
    blocks = blocks_of(DOCS / f"{name}.md")
    assert "run" in {block.words for block in blocks}
    page = (DOCS / f"{name}.md").read_text()
    for block in blocks:
        if block.words.endswith(".yaml"):
            (folder / block.words).write_text(block.text)
        elif block.words in ("run", "fails"):
            run = in_python if block.language == "python" else in_shell
            _ended(run(block.text, folder), block, page)
    return page


@pytest.mark.long
def test_tutorial(tmp_path):
    """All steps, and the numbers that the page prints."""
    page = _all_run("tutorial", tmp_path)
    result = json.loads((tmp_path / "better" / "result.json").read_text())
    rows = re.findall(r"^\| (\w+) \| ([\d.]+) \| ([\d.]+) \|$", page, re.M)
    assert len(rows) == 5
    for key, *told in rows:
        for text, name in zip(told, ("baseline", "optimized"), strict=True):
            value = (result[name]["design"] | result[name]["response"])[key]
            digit = 10.0 ** -len(text.partition(".")[2])
            assert float(text) == pytest.approx(value, abs=0.51 * digit), key
    for file in (*(f"drawing/rotor{end}" for end in (".dxf", ".svg", "_points.csv")),
                 "geometry/profile_design.csv", "speeds/sweep.nc"):  # fmt: skip
        assert (tmp_path / file).is_file()


@pytest.mark.long
def test_identify_page(tmp_path):
    """The record that the page makes leads to the pump that the page names."""
    _all_run("identify", tmp_path)
    known = json.loads((tmp_path / "found" / "result.json").read_text())["parameters"]
    for key, true in (("backlash_mm", 0.14), ("damping_ratio", 0.3)):
        low, high = known[f"scene.timing_gear.{key}"]["interval_95"]
        assert low < true < high


@pytest.mark.long
def test_howto(tmp_path):
    _all_run("howto", tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("page", NOTEBOOKS, ids=lambda page: page.stem)
def test_notebook(page, tmp_path):
    cells = [block.text for block in blocks_of(page) if block.language == CELL]
    assert len(cells) >= 4
    assert max(len(line) for cell in cells for line in cell.splitlines()) <= 88
    done = in_python("\n".join(cells), tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"rootsopt {rootsopt.__version__}\n" in done.stdout
    assert "nan" not in done.stdout.split()
    assert "Warning" not in done.stderr


def test_commands_of_the_howto_page_have_valid_overrides():
    """Each row's command is accepted as printed, with `cic` for `CONFIG`."""
    found = re.findall(r"`(rootsopt [^`]*--set[^`]*)`", (DOCS / "howto.md").read_text())
    assert any("profile.family=arc" in one for one in found)
    for one in found:
        name, *words = shlex.split(one)[2:]
        sets = [value for flag, value in itertools.pairwise(words) if flag == "--set"]
        check_geometry(load("cic_drawn" if name == "CONFIG" else name, sets))


LINKING = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    ROOT / "experiments" / "README.md",
    *sorted(DOCS.rglob("*.md")),
]
FENCE = re.compile(r"^(```|~~~).*?^\1$", re.M | re.S)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
INCLUDE = re.compile(r"^```\{include\} (\S+)$", re.M)


def _anchors(page):
    """Anchors of the headings of a page, as GitHub and MyST make them."""
    text = page.read_text()
    for file in INCLUDE.findall(text):
        text += (page.parent / file).read_text()
    heads = re.findall(r"^#+ +(.+?)\s*$", FENCE.sub("", text), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", LINKING, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for link in LINK.findall(FENCE.sub("", page.read_text())):
        if re.match(r"[a-z]+:", link):  # Another site.
            continue
        name, _, anchor = link.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{link} leads nowhere"
        assert file.is_relative_to(ROOT), f"{link} leads out of the project"
        if anchor:
            assert anchor in _anchors(file), f"{link}: {name or page.name} has no such heading"


def test_every_figure_is_in_the_gallery_with_command_and_version():
    text = (DOCS / "gallery.md").read_text()
    entries = re.findall(
        r"^!\[.+\]\((\S+)\)\n\n\*.+\*, version \d+\.\d+\.\d+, \[.+\]\(.+\):\n`(.+)`$", text, re.M
    )
    figures = {file.name for kind in ("*.png", "*.gif") for file in DOCS.rglob(kind)}
    assert {name for name, _ in entries} == figures
    for _, command in entries:
        assert command.startswith(("rootsopt ", "python -m experiments "))
        if command.startswith("python"):
            assert (ROOT / "experiments" / command.split()[3] / "study.py").is_file(), command


ARCHITECTURE = (DOCS / "architecture.md").read_text(encoding="utf-8")
PACKAGE = ROOT / "rootsopt"
PACKAGES = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in ARCHITECTURE.partition("\n## The packages\n")[2].partition("\n## ")[0].splitlines()
    if line.startswith("|") and not set(line) <= set("|- ")
][1:]


def code_in(text):
    return re.findall(r"`([^`]*)`", text)


@functools.cache
def names_of(package):
    """Return all names of classes, functions, methods and fields that a package defines."""
    nodes = [
        node
        for path in package.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    ]
    fields = [node.target for node in nodes if isinstance(node, ast.AnnAssign)]
    return {node.name for node in nodes if isinstance(node, ast.ClassDef | ast.FunctionDef)} | {
        field.id for field in fields if isinstance(field, ast.Name)
    }


def is_module(path):
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def test_every_folder_has_a_row_in_the_order_of_the_layers():
    rows = [name for cells in PACKAGES for name in code_in(cells[0])]
    folders = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}
    assert folders <= set(rows)
    assert all(is_module(PACKAGE / name) for name in rows)
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contract, _ = settings["tool"]["importlinter"]["contracts"]
    layers = [re.findall(r"rootsopt\.(\w+)\b(?!\.__main__)", layer) for layer in contract["layers"]]
    first = {name: k for k, layer in reversed([*enumerate(layers)]) for name in layer}
    places = [first[name] for name in rows if name in folders]
    assert places == sorted(places)


@pytest.mark.parametrize("row", PACKAGES[1:], ids=lambda cells: cells[0].strip("`"))
def test_modules_of_a_row_exist(row):
    """A name in a package's row is a module there, or something that a module there defines."""
    (package,) = code_in(row[0])
    folder = PACKAGE / package
    for name in code_in(row[1]):
        if name.startswith("--") or name in ("constraints.terms", "tolerances"):
            continue  # An option, or a config key.
        below = any(is_module(path / name) for path in [folder, *folder.iterdir()])
        assert below or name in names_of(folder), f"rootsopt/{package} has no {name}"
