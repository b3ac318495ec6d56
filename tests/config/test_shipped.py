"""Shipped configs are found by name, in the source tree and in an installed package."""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from rootsopt.config import load_config, notes, parse
from rootsopt.config.sources import shipped
from rootsopt.scene import check_geometry
from tests.standins import ROOT, refusal

PACKAGE = ROOT / "rootsopt"
_NAMES = sorted(path.stem for path in (ROOT / "configs").glob("*.yaml"))


@pytest.mark.parametrize("name", _NAMES)
def test_a_shipped_config_is_found_by_its_name(name, monkeypatch, tmp_path):
    """It is found from any folder, even if a folder has its name. Its values are usual, and its
    profile can be made."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cic").mkdir()
    config = load_config(ROOT / "configs" / f"{name}.yaml")
    assert load_config(name) == load_config(f"{name}.yaml") == parse(config.to_yaml()) == config
    assert notes(config) == ()
    check_geometry(config)


def test_a_file_comes_before_a_shipped_config(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "configs" / "ee.yaml").read_text()
    (tmp_path / "cic.yaml").write_text(text)
    assert load_config("cic.yaml").profile.family == "ee"
    assert load_config("cic_drawn").profile.family == "cic"


@pytest.mark.parametrize("path", ["folder/cic", "cic.yml", "cics", "./other/ee.yaml"])
def test_other_names_are_refused_with_those_that_exist(path):
    message = refusal(load_config, path)
    assert re.search(r"no such file; give the path .*\(blower, cic, cic_drawn, ee, ", message)
    assert path != "cics" or "did you mean 'cic'?" in message


def test_an_installed_package_has_its_configs_and_types(tmp_path):
    builders = pytest.importorskip("hatchling.builders.wheel")
    (wheel,) = builders.WheelBuilder(str(ROOT)).build(
        directory=str(tmp_path), versions=["standard"]
    )
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    site, pages = tmp_path / "site" / "rootsopt", Path("view", "pages")
    assert (site / "py.typed").exists()
    for folder in (pages / "report", pages / "explore"):
        written, own = ({x.name for x in (at / folder).iterdir()} for at in (site, PACKAGE))
        assert written == own
    assert (site / "glossary.md").read_bytes() == (ROOT / "docs" / "glossary.md").read_bytes()
    (tmp_path / "empty").mkdir()
    program = (
        "import rootsopt; print(rootsopt.__file__, rootsopt.load_config('cic_drawn').design_keys)"
    )
    said = subprocess.check_output(
        [sys.executable, "-c", program],
        cwd=tmp_path / "empty",
        env=os.environ | {"PYTHONPATH": str(tmp_path / "site")},
        text=True,
    )
    assert re.match(f"{site}.*pressure_angle_deg", said)
    assert sorted(shipped()) == _NAMES
