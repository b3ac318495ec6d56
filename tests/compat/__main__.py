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
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "build" / "compat"
VERSIONS = "oldest", "newest"
EXTRAS = "cluster,completion,explore,pages,zarr"
"""Extras that are installed and tried. The others are for studies, docs and development."""
CAD = "cad"
"""A further extra of the jobs with the newest versions: build123d pins what it needs so narrowly
that it does not go with the oldest versions of the rest."""
TOOLS = "pytest", "hypothesis", "beartype", "psutil", "hatchling"
"""Packages that only the tests need, always in their newest version."""
COPIED = "tests", "configs", "experiments", "docs", "pyproject.toml", "README.md", "CHANGELOG.md"
SHOWN = "jax", "equinox", "diffrax", "numpy", "scipy", "pydantic", "matplotlib", "xarray"
"""Packages whose versions the table shows."""
TESTS = (
    "tests/config",
    "tests/contact/test_closed_forms.py",
    "tests/contact/test_impact.py",
    "tests/design/test_bounds.py",
    "tests/explore/test_knobs.py",
    "tests/explore/test_latest.py",
    "tests/explore/test_server.py",
    "tests/export/test_drawing.py",
    "tests/optimize/test_sqp.py",
    "tests/output/test_runs.py",
    "tests/profiles/test_freeform.py",
    "tests/pump/test_pump_flow.py",
    "tests/report/test_report.py",
    "tests/runtime/test_store.py",
    "tests/scene/test_scene.py",
    "tests/sweeps/test_axes.py",
    "tests/sweeps/test_plan.py",
    "tests/runtime/test_journal.py",
)
"""A few test files per package that take seconds, apart from compiling."""
LEFT = (
    "tests/config/test_shipped.py::test_an_installed_package_has_its_configs_and_types",
    "tests/explore/test_server.py::test_ctrl_c_ends_with_success",
    "tests/output/test_runs.py::test_all_commands_write_through_one_layer",
    "tests/output/test_runs.py::test_nothing_is_written_outside_of_the_runs_own_folder",
)
"""Tests that need the package's source, compiled programs or the extra `cad`."""
IMPORTS = "distributed", "zarr", "bokeh", "plotly", "jinja2", "shtab", "h5netcdf"
_JOB_SECONDS = 1500


class Python(NamedTuple):
    """An interpreter: its `path` and its `version`, as in 3.12.1."""

    path: str
    version: str


class Row(NamedTuple):
    """A row of the table: job, version of Python, versions of packages, result."""

    job: str
    python: str
    versions: str
    result: str


def found(names: list[str]) -> tuple[list[Python], list[str]]:
    """Return the interpreters among `names`, names or paths, and the names that do not run."""
    pythons, missing = [], []
    for name in names:
        path = shutil.which(name)
        code = "import sys; print('.'.join(map(str, sys.version_info[:3])))"
        done = None
        if path is not None:
            run = [path, "-c", code]
            done = subprocess.run(run, capture_output=True, text=True, check=False)
        if path is None or done is None or done.returncode:
            missing.append(name)
        else:
            pythons.append(Python(path, done.stdout.strip()))
    return pythons, missing


def bounds(project: dict) -> list[str]:
    """Return `name==version` for the lower bound of every dependency and tried extra."""
    wanted = list(project["dependencies"])
    for extra in EXTRAS.split(","):
        wanted += project["optional-dependencies"][extra]
    pins = {}
    for one in wanted:
        name, _, least = re.fullmatch(r"([\w.-]+)(>=)([\w.]+)", one).groups()  # type: ignore
        pins[name] = least
    return [f"{name}=={least}" for name, least in pins.items()]


def wheel(folder: Path) -> Path:
    """Build the wheel of this tree in a `folder`, and return its path."""
    shutil.rmtree(folder, ignore_errors=True)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(folder), str(ROOT)], check=True)
    (made,) = folder.glob("*.whl")
    return made


def tree(folder: Path) -> Path:
    """Copy tests and what they read into a `folder`, without the package, and return the folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif source.exists():
            shutil.copy(source, folder / name)
    return folder


class Job:
    """One environment in a `folder`: `versions` is oldest or newest."""

    def __init__(self, python: Python, versions: str, folder: Path):
        self.python, self.versions = python, versions
        self.name = f"{versions}-{'.'.join(python.version.split('.')[:2])}"
        self.folder = folder / self.name
        self.log = folder / f"{self.name}.log"
        self.bin = self.folder / ("Scripts" if os.name == "nt" else "bin")

    def run(self, package: Path, where: Path, pins: list[str], keep: bool) -> Row:
        """Install, test, and return the row of the table. The output goes to `log`."""
        began = time.monotonic()
        shutil.rmtree(self.folder, ignore_errors=True)
        with self.log.open("w") as log:
            result = self._steps(package, where, pins, log, began)
        seconds = time.monotonic() - began
        versions = self._versions()
        if not keep:
            shutil.rmtree(self.folder, ignore_errors=True)
        return Row(self.name, self.python.version, versions, f"{result} ({seconds / 60:.1f} min)")

    def _steps(self, package, where, pins, log, began) -> str:
        newest = self.versions == "newest"
        extras = f"{EXTRAS},{CAD}" if newest else EXTRAS
        imports = [*IMPORTS, *(["build123d"] if newest else [])]
        constraints = self.log.with_suffix(".txt")
        constraints.write_text("\n".join([] if newest else pins) + "\n")
        python, script = str(self.bin / "python"), str(self.bin / "rootsopt")
        install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        search = ["--set", "optimizer.starts=1", "--set", "optimizer.screening=0"]
        checks = f"import rootsopt, {', '.join(imports)}; print(rootsopt.__file__)"
        steps = {
            "environment": [self.python.path, "-m", "venv", str(self.folder)],
            "install": [*install, "-c", str(constraints), f"{package}[{extras}]", *TOOLS],
            "import": [python, "-c", checks],
            "main job": [script, "optimize", "cic", "-o", str(self.folder / "run"), *search],
            "tests": [
                str(self.bin / "pytest"),
                "-q",
                *TESTS,
                *(f"--deselect={one}" for one in LEFT),
            ],
        }
        for name, command in steps.items():
            left = _JOB_SECONDS - (time.monotonic() - began)
            log.write(f"\n== {name}\n")
            log.flush()
            environment = os.environ | {
                "ROOTSOPT_CACHE": str(self.folder / "cache"),
                "ROOTSOPT_TEST_CACHE": str(self.folder / "tests"),
            }
            if name == "tests":
                (self.folder / "tests").mkdir()
            try:
                done = subprocess.run(
                    command, cwd=where, env=environment, stdout=log, stderr=log, timeout=left,
                    check=False,
                )  # fmt: skip
            except subprocess.TimeoutExpired:
                return f"{name}: too slow"
            if done.returncode:
                return f"{name} FAILED"
        return "passed"

    def _versions(self) -> str:
        code = (
            "from importlib.metadata import version\n"
            f"print(', '.join(f'{{name}} {{version(name)}}' for name in {SHOWN!r}))"
        )
        python = str(self.bin / "python")
        if not Path(python).exists():
            return "-"
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
        return done.stdout.strip() or "-"


def table(rows: list[Row]) -> str:
    """Return the rows as a table in plain text."""
    every = [Row("job", "python", "versions", "result"), *rows]
    widths = [max(len(row[k]) for row in every) for k in range(len(Row._fields))]
    lines = (
        " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in every
    )
    return "\n".join(line.rstrip() for line in lines)


def main() -> int:
    """Run the jobs, and print their table."""
    parser = argparse.ArgumentParser(prog="python -m tests.compat", description=__doc__)
    usual = ["python3.11", "python3.12", "python3.13"]
    parser.add_argument("--pythons", nargs="+", default=usual, help="interpreters: names or paths")
    parser.add_argument("--versions", nargs="+", default=VERSIONS, choices=VERSIONS)
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of environments and logs")
    parser.add_argument("--keep", action="store_true", help="keep the environments")
    options = parser.parse_args()
    pythons, missing = found(options.pythons)
    for name in missing:
        print(f"{name}: not found, or does not run", flush=True)
    if not pythons:
        print("no interpreter is left; name some with PYTHONS='/path/to/python3.12 ...'")
        return 1
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    pins = bounds(tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"])
    package, where = wheel(folder / "wheel"), tree(folder / "tree")
    rows = []
    for python in pythons:
        for versions in options.versions:
            job = Job(python, versions, folder)
            rows.append(job.run(package, where, pins, options.keep))
            print(f"{rows[-1].job}: {rows[-1].result}; log in {job.log}", flush=True)
    print("\n" + table(rows))
    return int(any("passed" not in row.result for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
