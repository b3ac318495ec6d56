"""`python -m tests.compat`: install the wheel with old and new dependencies, and test it there.

Each job has a virtual environment of its own in `build/compat`. The oldest versions are the lower
bounds of `pyproject.toml`; the newest ones are what pip chooses without constraints. The tests run
in a copy of the tree without the package, so that the installed wheel is tested. The exit code is 1
if a job fails or if no interpreter is found."""

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "build" / "compat"
VERSIONS = "oldest", "newest"
EXTRAS = "cluster,completion,explore,pages"
"""Extras that are installed and tried. The others are for studies, docs and development."""
CAD = "cad"
"""A further extra of the jobs with the newest versions: build123d pins what it needs so narrowly
that it does not go with the oldest versions of the rest."""
TOOLS = "pytest", "hypothesis", "beartype", "psutil", "hatchling"
"""Packages that only the tests need, always in their newest version."""
COPIED = "tests", "configs", "experiments", "docs", "pyproject.toml", "README.md", "CHANGELOG.md"
TESTS = (
    "tests/config",
    "tests/contact/test_closed_forms.py",
    "tests/view/test_knobs.py",
    "tests/view/test_server.py",
    "tests/view/test_drawing.py",
    "tests/optimize/test_sqp.py",
    "tests/view/test_runs.py",
    "tests/profiles/test_freeform.py",
    "tests/pump/test_pump_flow.py",
    "tests/view/test_report.py",
    "tests/runtime/test_store.py",
    "tests/scene/test_scene.py",
    "tests/response/test_plan.py",
    "tests/response/test_journal.py",
)
"""A few test files per package that take seconds, apart from compiling."""
LEFT = (
    "tests/config/test_shipped.py::test_an_installed_package_has_its_configs_and_types",
    "tests/view/test_server.py::test_ctrl_c_ends_with_success",
    "tests/view/test_runs.py::test_nothing_is_written_outside_of_the_runs_own_folder",
)
"""Tests that need the package's source, compiled programs or the extra `cad`."""
IMPORTS = "distributed, bokeh, jinja2, shtab, h5netcdf"
_JOB_SECONDS = 1500


def bounds() -> list[str]:
    """Return `name==version` for the lower bound of every dependency and tried extra."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = (project["optional-dependencies"][extra] for extra in EXTRAS.split(","))
    wanted = {*project["dependencies"]}.union(*extras)
    return [re.sub(r"^([\w.-]+)>=([\w.]+)$", r"\1==\2", one) for one in sorted(wanted)]


def prepared() -> tuple[Path, Path]:
    """Build the wheel, and copy the tests and what they read; return the paths of both."""
    for name in ("wheel", "tree"):
        shutil.rmtree(FOLDER / name, ignore_errors=True)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(FOLDER / "wheel"), str(ROOT)], check=True)
    for name in COPIED:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, FOLDER / "tree" / name)
    return next((FOLDER / "wheel").glob("*.whl")), FOLDER / "tree"


def job(interpreter: str, newest: bool, place: Path, package: Path, tree: Path) -> str:
    """Install and test in an environment at `place`; return the outcome. Output goes to a log."""
    shutil.rmtree(place, ignore_errors=True)
    folder = place / ("Scripts" if os.name == "nt" else "bin")
    python, script = str(folder / "python"), str(folder / "rootsopt")
    constraints = Path(f"{place}.txt")
    constraints.write_text("" if newest else "\n".join(bounds()))
    imports, extras = (f"{IMPORTS}, build123d", f"{EXTRAS},{CAD}") if newest else (IMPORTS, EXTRAS)
    steps = {
        "environment": [interpreter, "-m", "venv", str(place)],
        "install": [
            python,
            "-m",
            "pip",
            "install",
            "-c",
            str(constraints),
            f"{package}[{extras}]",
            *TOOLS,
        ],
        "import": [python, "-c", f"import rootsopt, {imports}"],
        "main job": [
            *(script, "optimize", "cic", "-o", str(place / "run")),
            *("--set", "optimizer.starts=1", "--set", "optimizer.screening=0"),
        ],
        "tests": [python, "-m", "pytest", *TESTS, *(f"--deselect={one}" for one in LEFT)],
    }
    environment = os.environ | {"ROOTSOPT_CACHE": str(place / "cache")}
    end = time.monotonic() + _JOB_SECONDS
    with open(f"{place}.log", "w") as log:
        for name, command in steps.items():
            print("==", name, file=log, flush=True)
            how = {"cwd": tree, "env": environment, "stdout": log, "stderr": log}
            try:
                subprocess.run(command, **how, timeout=end - time.monotonic(), check=True)
            except (subprocess.SubprocessError, OSError) as error:
                return f"{name} FAILED: {type(error).__name__}"
    shutil.rmtree(place)
    return "passed"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.compat", description=__doc__)
    usual = ["python3.11", "python3.12", "python3.13"]
    parser.add_argument("--pythons", nargs="+", default=usual, help="interpreters: names or paths")
    FOLDER.mkdir(parents=True, exist_ok=True)
    (package, tree), outcomes = prepared(), []
    for python in parser.parse_args().pythons:
        if shutil.which(python) is None:
            print(f"{python}: not found", flush=True)
            continue
        for versions in VERSIONS:
            place = FOLDER / f"{versions}-{Path(python).name}"
            outcomes.append(job(python, versions == "newest", place, package, tree))
            print(f"{place.name}: {outcomes[-1]}; log in {place}.log", flush=True)
    return int({*outcomes} != {"passed"})


if __name__ == "__main__":
    raise SystemExit(main())
