"""The site builds without a warning, reads without a network, and its reference is complete."""

import os
import re
import subprocess
import sys

import pytest

import rootsopt
from rootsopt.commands.console import COMMANDS
from rootsopt.config import Config
from rootsopt.config.explain import keys_of
from rootsopt.status import Status
from tests.standins import ROOT

DOCS = ROOT / "docs"


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
    source = (DOCS / "reference" / "commands.md").read_text()
    assert re.findall(r"\{command-options\} (\w+)", source) == list(COMMANDS)
    told = [("config", f'id="key-{key.name.replace(".", "-")}"') for key in keys_of(Config)]
    told += [("commands", f">{status.label}<") for status in Status]
    names = {*rootsopt.__all__} - {"__version__", "COMPILER_OPTIONS"}
    told += [("python", f'id="rootsopt.{name}"') for name in names]
    told += [("python", "COMPILER_OPTIONS")]
    assert [one for one in told if one[1] not in pages[one[0]]] == []
