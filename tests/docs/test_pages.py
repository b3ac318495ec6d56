"""The pages teach what works: the code of tutorial and notebooks runs."""

import itertools
import json
import re
import shlex

import pytest

import rootsopt
from rootsopt.config import load
from rootsopt.scene import check_geometry
from tests.docs.blocks import DOCS, blocks_of, in_process, in_python, in_shell

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


@pytest.mark.parametrize("name", PAGES)
def test_code_is_executed_or_named_as_not_executed(name):
    known = {"run", "fails", "skip", "rotor.yaml"}
    for block in blocks_of(DOCS / f"{name}.md"):
        if block.language.startswith("{"):  # A directive.
            continue
        assert block.language in ("sh", "python", "yaml"), block
        assert block.words in known, f"{name}: say whether this block is run:\n{block.text}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tutorial")


def _tutorial(folder, blocks):
    """Write the files and run the commands and the Python of `blocks`."""
    for block in blocks:
        if block.language == "yaml":
            (folder / block.words).write_text(block.text)
        elif block.language == "python":
            done = in_python(block.text, folder)
            assert done.returncode == 0, done.stderr
        elif block.words != "skip":
            done = in_shell(block.text, folder)
            wanted = 2 if block.words == "fails" else 0
            assert done.returncode == wanted, f"{block.text}\n{done.stdout}\n{done.stderr}"
            if wanted:
                message = done.stderr.strip().split("rotor.yaml: ")[1]
                assert message in (DOCS / "tutorial.md").read_text()


def test_tutorial_begins(tmp_path, capsys, monkeypatch):
    """The steps that compile nothing: the empty config, and the geometry of the written one."""
    blocks = blocks_of(DOCS / "tutorial.md")
    _tutorial(tmp_path, [b for b in blocks if b.language == "yaml" or b.words == "fails"])
    (block,) = (b for b in blocks if "-o geometry" in b.text)
    assert in_process(block.text, tmp_path, capsys, monkeypatch).returncode == 0
    assert (tmp_path / "geometry" / "rotor.dxf").is_file()


def test_design_page_begins(tmp_path, capsys, monkeypatch):
    """The steps from the sheet to the geometry, and the answer that the page prints."""
    text = (DOCS / "design.md").read_text()
    for block in blocks_of(DOCS / "design.md"):
        if block.words == "skip":
            continue
        done = in_process(block.text, tmp_path, capsys, monkeypatch)
        assert done.returncode == (2 if block.words == "fails" else 0), done.stderr
        if block.words == "fails":
            assert done.stderr.strip().split("blower.yaml: ")[1] in " ".join(text.split())
        elif "rootsopt new" in block.text:
            assert "0.3 bar, which takes 15.6 kW without losses, 87% of the 18 kW" in done.stdout
    assert (tmp_path / "geometry" / "profile_design.csv").is_file()


@pytest.mark.long
def test_tutorial(folder):
    """All steps, and the numbers that the page prints."""
    _tutorial(folder, blocks_of(DOCS / "tutorial.md"))
    result = json.loads((folder / "better" / "result.json").read_text())
    rows = re.findall(
        r"^\| (\w+) \| ([\d.]+) \| ([\d.]+) \|$", (DOCS / "tutorial.md").read_text(), re.M
    )
    assert len(rows) == 5
    for key, *told in rows:
        for text, name in zip(told, ("baseline", "optimized"), strict=True):
            record = result[name]
            value = {**record["design"], **record["response"]}[key]
            digit = 10.0 ** -len(text.partition(".")[2])
            assert float(text) == pytest.approx(value, abs=0.51 * digit), key
    for file in ("rotor.dxf", "rotor.svg", "rotor_points.csv"):
        assert (folder / "drawing" / file).is_file()
    assert (folder / "geometry" / "profile_design.csv").is_file()
    assert (folder / "speeds" / "sweep.nc").is_file()


@pytest.mark.long
def test_identify_page(tmp_path):
    """The record that the page makes leads to the pump that the page names."""
    for block in blocks_of(DOCS / "identify.md"):
        if block.words == "run":
            run = in_python if block.language == "python" else in_shell
            done = run(block.text, tmp_path)
            assert done.returncode == 0, done.stderr
    known = json.loads((tmp_path / "found" / "result.json").read_text())["parameters"]
    for key, true in (("backlash_mm", 0.14), ("damping_ratio", 0.3)):
        low, high = known[f"scene.timing_gear.{key}"]["interval_95"]
        assert low < true < high


@pytest.mark.long
def test_howto(tmp_path):
    texts = [one.text for one in blocks_of(DOCS / "howto.md") if one.words == "run"]
    assert texts
    for text in texts:
        done = in_python(text, tmp_path)
        assert done.returncode == 0, done.stderr


@pytest.mark.long
@pytest.mark.parametrize("page", NOTEBOOKS, ids=lambda page: page.stem)
def test_notebook(page, tmp_path):
    """All cells run, one after another."""
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
