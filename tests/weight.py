"""How heavy the project is: `make weight` prints it, and a test keeps it from growing."""

import ast
import contextlib
import functools
import io
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).parents[1]
MOST = {
    "statements of the package": 25_936,
    "statements of the tests": 13_331,
    "statements of the experiments": 4_479,
    "packages": 13,
    "files of the package": 197,
    "lines of the longest file": 450,
    "floors of packages": 10,
    "depth of imports": 22,
    "config keys": 134,
    "lines of the longest help": 59,
    "pages of docs": 45,
    "words of docs": 31_451,
}
"""Greatest values that are accepted. Lower them when the project becomes lighter. Whoever raises
one gives the reason in the changelog: what users can do now that is worth the weight."""


def measured() -> dict[str, int]:
    """Return the project's weight, with the keys of `MOST`."""
    from rootsopt.commands.table import COMMANDS
    from rootsopt.config import Config
    from rootsopt.config.explain import keys_of

    files = sorted((ROOT / "rootsopt").rglob("*.py"))
    modules = {_name(path): path for path in files}
    imports = {name: _imports(path, modules) for name, path in modules.items()}
    packages = {path.name for path in (ROOT / "rootsopt").glob("[a-z]*") if path.is_dir()}
    rooms: dict[str, set[str]] = {}
    # Entry points stand above all packages, errors and statuses below them.
    for name, found in imports.items():
        if _room(name) in packages and not name.endswith("__main__"):
            room = rooms.setdefault(_room(name), set())
            room |= {_room(other) for other in found} & packages - {_room(name)}
    pages = sorted((ROOT / "docs").rglob("*.md"))
    words = sum(len(re.findall(r"\w[\w'’-]*", path.read_text("utf-8"))) for path in pages)
    return {
        "statements of the package": _statements(files),
        "statements of the tests": _statements((ROOT / "tests").rglob("*.py")),
        "statements of the experiments": _statements((ROOT / "experiments").rglob("*.py")),
        "packages": len(packages),
        "files of the package": len(files),
        "lines of the longest file": max(
            len(path.read_text("utf-8").splitlines()) for path in files
        ),
        "floors of packages": _depth(rooms),
        "depth of imports": _depth(imports),
        "config keys": len(keys_of(Config)),
        "lines of the longest help": max(map(_help_lines, COMMANDS.values())),
        "pages of docs": len(pages),
        "words of docs": words,
    }


def _statements(files: Iterable[Path]) -> int:
    trees = (ast.parse(path.read_bytes()) for path in files)
    return sum(isinstance(node, ast.stmt) for tree in trees for node in ast.walk(tree))


def _name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _room(module: str) -> str:
    """Return the package in which a `module` lies."""
    return module.split(".")[1] if "." in module else ""


def _imports(path: Path, modules: Iterable[str]) -> set[str]:
    """Return the modules that are imported with the file at `path`, as it stands at its top."""
    known, found = set(modules), set()
    for node in ast.parse(path.read_bytes()).body:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & known or {node.module}
    return (found & known) - {_name(path), "rootsopt"}


def _depth(graph: dict[str, set[str]]) -> int:
    """Return the number of nodes on the longest path of a `graph`; a cycle counts once."""

    @functools.cache
    def below(node: str) -> int:
        open_nodes.add(node)
        found = max((below(x) for x in graph.get(node, ()) if x not in open_nodes), default=0)
        open_nodes.discard(node)
        return 1 + found

    open_nodes: set[str] = set()
    return max(map(below, graph))


def _help_lines(command: Any) -> int:
    text = io.StringIO()
    with (
        mock.patch.dict(os.environ, COLUMNS="100"),
        contextlib.redirect_stdout(text),
        contextlib.suppress(SystemExit),
    ):
        command.main(["--help"])
    return len(text.getvalue().splitlines())


if __name__ == "__main__":
    for name, number in measured().items():
        print(f"{name:<32} {number:>7,} {'of at most':>12} {MOST[name]:>7,}")
