"""Test settings (float64, no display) and the fixtures shared by the geometry tests."""

import gc
import os
import shutil
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
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


_LONGEST_FIRST = (
    *("identify", "response", "continuation", "steady", "tradeoffs", "robust", "improve"),
    *("rattle", "leakage", "reserve", "basins", "assumptions", "export", "optimize"),
    *("ensemble", "pages", "gradients", "known", "start", "outline", "families"),
)
"""The first two share few programs: neither process repeats what the other compiles."""


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


def _graded_normals(profile, points):
    """Return normal angles that include every segment end, evenly spaced in arc length + angle.

    Equal arc lengths alone would leave wide angles between nodes where the radius of curvature
    vanishes (pitch point of EE). Polygon and cubic are both inaccurate there."""
    pieces = []
    for segment in profile.segments():
        if not float(segment.stop) > float(segment.start):
            continue
        nu = np.linspace(float(segment.start), float(segment.stop), 2001)
        middle = jnp.asarray((nu[1:] + nu[:-1]) / 2)
        _, addendum, dedendum = profile.speeds(middle)
        speed = np.maximum(np.abs(addendum), np.abs(dedendum))
        speed = speed + 0.3 * float(profile.pitch_radius)
        pieces.append((nu, np.concatenate([[0.0], np.cumsum(speed * np.diff(nu))])))
    total = sum(measure[-1] for _, measure in pieces)
    normals = []
    for nu, measure in pieces:
        count = max(8, int(points * measure[-1] / total)) + 1
        normals.append(np.interp(np.linspace(0, measure[-1], count), measure, nu)[:-1])
    return np.append(np.concatenate(normals), pieces[-1][0][-1])


@pytest.fixture(scope="session")
def graded_outline():
    """Return a function (profile, points) → closed outline (m) with dense nodes at high
    curvature."""

    def build(profile, points):
        nu = jnp.asarray(_graded_normals(profile, points))
        addendum = np.asarray(profile.position(profile.addendum(nu)))
        dedendum = np.asarray(profile.position(profile.dedendum(nu)))
        flank = np.concatenate([addendum, dedendum[-2::-1]]) @ [1, 1j]
        lobe_turn = np.exp(2j * np.pi / profile.lobes)
        lobe = np.concatenate([flank[:-1], (np.conj(flank) * lobe_turn)[:0:-1]])
        turns = lobe_turn ** np.arange(profile.lobes)
        closed = np.concatenate([*(lobe * turn for turn in turns), lobe[:1]])
        return np.stack([closed.real, closed.imag], axis=-1)

    return build
