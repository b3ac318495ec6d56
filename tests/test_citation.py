"""The citation file belongs to this version."""

from pathlib import Path

import yaml

import rootsopt


def test_citation_names_this_version():
    file = Path(__file__).parents[1] / "CITATION.cff"
    found = yaml.safe_load(file.read_text("utf-8"))
    assert str(found["version"]) == rootsopt.__version__
    assert found["license"] == "Apache-2.0"
    assert found["authors"]
