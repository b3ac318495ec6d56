"""docs/architecture.md is true: what it names exists, and its table has the order of the layers."""

import ast
import functools
import re
import tomllib

import pytest

from tests.docs.blocks import DOCS, ROOT

PAGE = (DOCS / "architecture.md").read_text(encoding="utf-8")
PACKAGE = ROOT / "rootsopt"
PACKAGES = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.partition("\n## The packages\n")[2].partition("\n## ")[0].splitlines()
    if line.startswith("|") and not set(line) <= set("|- ")
][1:]


def code_in(text):
    """Return the code spans of a text."""
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
