"""The house is in order: what lies in the package's root, late imports, long functions, rooms."""

import ast

import numpy as np
import pytest
import yaml
from jaxtyping import TypeCheckError

import rootsopt
from rootsopt.commands.table import COMMANDS
from rootsopt.profiles.geometry import feet
from tests.weight import MOST, ROOT, measured

PACKAGE = ROOT / "rootsopt"
FILES = sorted(PACKAGE.rglob("*.py"))
FACE = {"__init__.py", "continuation.py", "errors.py", "status.py", "py.typed"}
DOORS = {
    "__main__.py",
    "attractors.py",
    "explore.py",
    "pareto.py",
    "identify.py",
    "improve.py",
    "new.py",
    "profile.py",
    "simulate.py",
    "sweep.py",
}
MOST_LINES, MOST_PARAMETERS = 80, 8

OPTIONAL = {
    "build123d",
    "OCP",
    "cloudpickle",
    "dask",
    "distributed",
    "ezdxf",
    "jinja2",
    "markupsafe",
    "netCDF4",
    "shtab",
    "xarray",
}
SLOW = {"PIL", "optax", "rich", "scipy"}
LATE = {
    # The work of a command is loaded once its help or its config has asked for it.
    "commands/table.py": {
        "rootsopt.commands", "argparse", "rootsopt.config.explain", "rootsopt.config.sheet",
    },
    "commands/cli.py": {
        "rootsopt.view.terminal", "rootsopt.view.files", "rootsopt.view.runs",
        "rootsopt.view.tables",
        "rootsopt.view.pages.gather", "rootsopt.view.pages.html", "rootsopt.runtime",
    },
    "commands/console.py": {"rootsopt", "rootsopt.commands", "rootsopt.errors"},
    # Figures are imported in the background; exports, only if they are asked for.
    **{f"commands/work/{name}.py": {"rootsopt.view.figures", f"rootsopt.view.figures.{module}"}
       for name, module in (("attractors", "sweep"), ("identify", "force"),
                            ("profile", "runs"))},
    "commands/work/pareto.py": {
        "rootsopt.view.figures", "rootsopt.view.figures.comparisons",
    },
    "commands/work/optimize.py": {
        "rootsopt.view.figures", "rootsopt.view.figures.comparisons",
        "rootsopt.view.figures.writing",
    },
    "commands/work/simulate.py": {"rootsopt.view.figures.writing", "rootsopt.view.figures"},
    "commands/work/sweep.py": {"rootsopt.view.figures.sweep"},
    "view/figures/writing.py": {"rootsopt.view.figures.animation"},
    "optimize/__init__.py": {"rootsopt.commands.table"},
    # Modules that import optional or slow libraries.
    "commands/work/explore.py": {
        "rootsopt.optimize.design", "rootsopt.view.pages.knobs", "rootsopt.view.pages.server",
    },
    "view/figures/runs.py": {"rootsopt.measured.source"},
    "measured/reading.py": {"rootsopt.measured.dxf"},
    "measured/conjugacy.py": {"rootsopt.measured.source"},
    # Only an objective over several motions needs these.
    "response/evaluation.py": {"rootsopt.response.attractors", "rootsopt.response.ensemble"},
    "scene/check.py": {"rootsopt.measured.source"},
    "scene/families.py": {"rootsopt.measured.source"},
    # Only searches over an ensemble need this.
    "optimize/search.py": {"rootsopt.optimize"},
    # JAX reads the environment when it is imported; it has no public test for a started backend.
    "runtime/environment.py": {"jax", "jax._src"},
}  # fmt: skip


FUNCTIONS = {
    path: [
        node
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    for path in FILES
}


def test_root_holds_the_face_and_the_doors():
    assert {path.name for path in PACKAGE.iterdir() if path.is_file()} == FACE | DOORS
    for name in DOORS - {"__main__.py"}:
        assert len((PACKAGE / name).read_text(encoding="utf-8").splitlines()) <= 15


def test_imports_stand_at_the_top():
    """Optional and slow libraries may be imported inside a function, and what `LATE` lists."""
    wrong = []
    for path in FILES:
        allowed = OPTIONAL | SLOW | LATE.get(path.relative_to(PACKAGE).as_posix(), set())
        for node in (node for function in FUNCTIONS[path] for node in ast.walk(function)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            late = {name for name in names if name.partition(".")[0] not in OPTIONAL | SLOW}
            wrong += [f"{path}:{node.lineno} imports {name}" for name in late - allowed]
    assert wrong == []


def test_figures_loaded_in_the_background_exist():
    """A thread imports them, so that a wrong name would only print a traceback."""
    names = {command.figures for command in COMMANDS.values() if command.writes}
    assert names <= {path.stem for path in (PACKAGE / "view" / "figures").glob("*.py")}


def test_long_functions_say_why():
    """A comment on the first line of the definition, or on the line above it, gives the reason."""
    wrong = []
    for path in FILES:
        lines = path.read_text(encoding="utf-8").splitlines()
        for node in FUNCTIONS[path]:
            taken, length = node.args, node.end_lineno - node.lineno + 1
            count = len(taken.posonlyargs + taken.args + taken.kwonlyargs)
            count += (taken.vararg is not None) + (taken.kwarg is not None)
            first = min([node.lineno, *(one.lineno for one in node.decorator_list)])
            said = any("#" in one for one in [*lines[first - 2 : first], lines[node.lineno - 1]])
            # By diffrax, as beside its `init`.
            said |= node.name == "adapt_step_size"
            if not said and (length > MOST_LINES or count > MOST_PARAMETERS):
                wrong.append(f"{path}: {node.name} has {length} lines and {count} parameters")
    assert wrong == []


def test_every_package_has_a_room_of_tests():
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert packages <= {path.parent.name for path in (ROOT / "tests").glob("*/test_*.py")}


def test_citation_names_this_version():
    found = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert str(found["version"]) == rootsopt.__version__


def test_shapes_are_checked_while_tests_run():
    with pytest.raises(TypeCheckError, match="points"):
        feet(np.zeros((3, 3)), np.zeros((4, 2)))


def test_project_is_not_heavier_than_agreed():
    assert {name: number for name, number in measured().items() if number > MOST[name]} == {}
