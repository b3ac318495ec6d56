"""The site builds without a warning, reads without a network, and its reference is complete."""

import os
import re
import subprocess
import sys

import pytest

import rootsopt
from rootsopt.commands.console import COMMANDS
from rootsopt.config import Config
from rootsopt.config.explain import describe, keys_of
from rootsopt.status import Status
from tests.docs.blocks import DOCS, ROOT

REFERENCE = DOCS / "reference"


def test_reference_names_every_section_command_and_public_name():
    sections = re.findall(r"\{config-keys\} (\w+)", (REFERENCE / "config.md").read_text())
    assert sections == list(Config.model_fields)
    commands = re.findall(r"\{command-options\} (\w+)", (REFERENCE / "commands.md").read_text())
    assert commands == list(COMMANDS)
    text = (REFERENCE / "python.md").read_text()
    names = re.findall(r"^\.\. auto\w+:: (?:\w+\.)*(\w+)$", text, re.M)
    assert sorted(names) == sorted({*rootsopt.__all__} - {"__version__"})


def test_help_and_reference_have_one_source():
    lines, keys = describe(Config).splitlines(), keys_of(Config)
    assert len(lines) == len(keys) > 100
    for line, key in zip(lines, keys, strict=True):
        assert line.split()[0] == key.name
        told = (key.meaning, key.unit, key.choices, key.range, key.default)
        assert [text for text in told if text not in line] == []


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Folder of the site, built strictly, without running the notebooks."""
    folder = tmp_path_factory.mktemp("site")
    build = [
        *(sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html"),
        *("-D", "nb_execution_mode=off", "-d", str(folder / "trees")),
        *(str(DOCS), str(folder / "html")),
    ]
    variables = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run(build, cwd=ROOT, env=variables, check=True, timeout=900)
    return folder / "html"


def test_site_reads_without_a_network(site):
    """Scripts, styles, pictures and formulas are files of the site, or part of the page."""
    for page in site.rglob("*.html"):
        text = page.read_text()
        loaded = re.findall(r"<(?:script|img|iframe)\b[^>]*?\bsrc=\"([^\"]+)\"", text)
        loaded += re.findall(r"<link\b[^>]*?\brel=\"stylesheet\"[^>]*?\bhref=\"([^\"]+)\"", text)
        assert [file for file in loaded if re.match(r"(https?:)?//", file)] == [], page.name
    theory = (site / "theory.html").read_text()
    assert theory.count("<math ") >= 10
    assert r"\frac" not in theory


def test_reference_holds_what_help_prints(site):
    pages = {
        name: (site / "reference" / f"{name}.html").read_text()
        for name in ("config", "commands", "python")
    }
    commands = " ".join(re.sub(r"</?span[^>]*>", "", pages["commands"]).split())
    for option in ("--set KEY=VALUE", "--over", "--resume", "--export LIST"):
        assert option in commands
    told = [("config", f'id="key-{key.name.replace(".", "-")}"') for key in keys_of(Config)]
    told += [("commands", f">{status.label}<") for status in Status]
    names = {*rootsopt.__all__} - {"__version__", "COMPILER_OPTIONS"}
    told += [("python", f'id="rootsopt.{name}"') for name in names]
    assert [one for one in told if one[1] not in pages[one[0]]] == []
