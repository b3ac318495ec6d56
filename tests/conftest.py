"""Test settings: float64, checked shapes, one folder of compiled programs, no display."""

import gc
import os
import shutil
import tempfile
from pathlib import Path

from hypothesis import settings
from jaxtyping import install_import_hook

# Every annotated shape and dtype of the package is checked while the tests run. Modules without any
# are left out: their types are checked before, and wrapping all functions takes seconds.
_PACKAGE = Path(__file__).parents[1]
_SHAPED = [
    ".".join(file.relative_to(_PACKAGE).with_suffix("").parts)
    for file in sorted(_PACKAGE.glob("rootsopt/**/*.py"))
    if "from jaxtyping import" in file.read_text(encoding="utf-8")
]
install_import_hook(_SHAPED, "typechecking.typechecked")

os.environ.setdefault("MPLBACKEND", "Agg")
# Tracing makes many objects that live on: looking for garbage among them finds little.
gc.set_threshold(100_000, 50, 100)
# One folder of compiled programs for all processes of a session, new for every session.
os.environ.setdefault("ROOTSOPT_TEST_CACHE", tempfile.mkdtemp(prefix="rootsopt-"))
os.environ["ROOTSOPT_CACHE"] = os.path.join(os.environ["ROOTSOPT_TEST_CACHE"], "programs")

from rootsopt.commands.cli import use_cache  # noqa: E402
from rootsopt.errors import InputError  # noqa: E402
from rootsopt.runtime import programs  # noqa: E402
from rootsopt.runtime.environment import use_float64  # noqa: E402

# Each process of a session has a core of its own: a program is compiled in one piece, which takes a
# fifth less work than many pieces side by side. Programs are not optimised, which halves the time
# that compiling takes; results differ by rounding. Commands in processes of their own inherit the
# variable, so that all share their programs. What the caller gives in it stays.
_GIVEN = os.environ.get("XLA_FLAGS", "")
_FLAGS = {
    "xla_cpu_parallel_codegen_split_count": 1,
    "xla_backend_optimization_level": 0,
    **programs.COMPILER_OPTIONS,
}
os.environ["XLA_FLAGS"] = " ".join(
    [_GIVEN, *(f"--{k}={v}".lower() for k, v in _FLAGS.items() if k not in _GIVEN)]
).strip()
try:
    use_float64()
except InputError:  # XLA versions differ in the flags that they take, and none of these is needed.
    os.environ["XLA_FLAGS"] = _GIVEN
    use_float64()
use_cache()
settings.register_profile("rootsopt", deadline=None, derandomize=True, max_examples=25)
# Of `make fuzz`, with other examples in each run.
settings.register_profile("fuzz", deadline=None, max_examples=5_000, print_blob=True)
settings.load_profile("rootsopt")


# The first two share few programs: neither process repeats what the other compiles.
_LONGEST_FIRST = (
    *("identify", "response", "continuation", "steady", "tradeoffs", "robust", "improve"),
    *("rattle", "leakage", "reserve", "basins", "assumptions", "export", "optimize"),
    *("ensemble", "pages", "gradients", "known", "start", "outline", "families"),
)


def pytest_collection_modifyitems(items):
    """Sort the files that take longest to the front, so that processes end at about the same
    time."""
    place = {f"test_{name}.py": number for number, name in enumerate(_LONGEST_FIRST)}
    items.sort(key=lambda item: place.get(item.path.name, len(place)))


def pytest_sessionfinish(session):
    """Remove the cache folder at the end of the first process, from which the others inherit it."""
    gc.freeze()  # pytest looks for garbage several times at the end: in all objects of JAX.
    if not hasattr(session.config, "workerinput"):
        shutil.rmtree(os.environ["ROOTSOPT_TEST_CACHE"], ignore_errors=True)
