"""Compiled programs are called, prepared, kept between processes and deleted."""

import importlib
import os
import platform
import re
import shutil
import sys
import threading
import time
from collections import namedtuple
from importlib import metadata
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.commands import cli
from rootsopt.commands.work.searching import CompileClock
from rootsopt.config import load
from rootsopt.config.sources import import_named
from rootsopt.dynamics.collocation.mesh import KnownOrbit
from rootsopt.pump import sheet
from rootsopt.runtime import environment, programs
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene, space
from tests.standins import for_a_time

Answer = namedtuple("Answer", "total name")


class Factor(eqx.Module):
    value: object
    power: int = eqx.field(static=True)


TRACED = []


def scaled(factor, numbers, name):
    TRACED.append(name)
    return Answer({"sum": jnp.sum(factor.value * numbers**factor.power)}, name)


def solved(matrix):
    """Stand in for a program that needs LAPACK, which is set up when it is lowered."""
    return jnp.linalg.solve(matrix, matrix[0])


@pytest.fixture(autouse=True)
def traced(monkeypatch):
    monkeypatch.setattr(programs, "_store", None)
    TRACED.clear()
    return TRACED


def ask(program, power=2, size=3, name="a"):
    answer = program(Factor(jnp.asarray(2.0), power), np.arange(size, dtype=float), name)
    total = 2 * sum(k**power for k in range(size))
    assert (answer.name, float(answer.total["sum"])) == (name, total)


def test_a_program_is_traced_once_for_each_kind_of_arguments(traced):
    program = CachedFunction(scaled)
    for other in ({}, {}, {"power": 3}, {"size": 4}, {"name": "b"}):
        ask(program, **other)
    assert traced == ["a", "a", "a", "b"]


def test_prepared_programs_are_ready_when_called(traced):
    program = CachedFunction(scaled)
    kind = Factor(jax.ShapeDtypeStruct((), float), 2), jax.ShapeDtypeStruct((3,), float), "a"
    assert program.result_shape(*kind).total["sum"].shape == ()
    traced.clear()
    program.prepare(*kind)
    program.prepare(*kind)
    ask(program)
    assert len(traced) == 1


def test_shape_of_the_result_is_told_before_the_program_is_compiled(traced, monkeypatch):
    """What follows knows the shape while the program is compiled; its own failures are ignored."""
    told, began = [], threading.Event()
    monkeypatch.setattr(programs, "_finished", lambda lowered: began.wait(60) and lowered.compile())

    def then(shape):
        told.append(shape)
        began.set()
        raise ValueError("ignored")

    program = CachedFunction(scaled)
    arguments = Factor(jnp.asarray(2.0), 3), np.ones(3), "a"
    program.prepare(*arguments, then=then)
    found = program(*arguments)
    assert [one.total["sum"].shape for one in told] == [found.total["sum"].shape]


def test_a_failure_is_raised_by_the_call_and_not_remembered():
    fails = [True]

    def moody(x):
        if fails[0]:
            raise ValueError("no")
        return x + 1

    program = CachedFunction(moody)
    program.prepare(jnp.ones(2))
    with pytest.raises(ValueError, match="no"):
        program(jnp.ones(2))
    fails[0] = False
    np.testing.assert_array_equal(program(jnp.ones(2)), [2, 2])


@pytest.fixture
def folder(tmp_path):
    programs.keep_in(tmp_path / "new" / "cache")
    return tmp_path / "new" / "cache"


def test_kept_programs_are_found_without_tracing(folder, traced):
    """Another process, here another `CachedFunction` of the same function, finds a kept program."""
    ask(CachedFunction(scaled))
    assert len(list(folder.iterdir())) == 1
    ask(CachedFunction(scaled))
    assert CachedFunction(scaled).result_shape(Factor(jnp.ones(()), 2), np.ones(3), "a").name == "a"
    assert traced == ["a"]
    ask(CachedFunction(scaled), power=3)
    assert len(traced) == 2


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
def test_a_cache_others_may_write_to_is_said_once_and_not_used(folder, traced, monkeypatch, capsys):
    ask(CachedFunction(scaled))
    folder.chmod(0o777)
    monkeypatch.setenv("ROOTSOPT_CACHE", str(folder))
    monkeypatch.setattr(environment, "_noticed", set())
    for _ in range(2):
        cli.use_cache()
        ask(CachedFunction(scaled))
    assert len(traced) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(rf"{folder}.*chmod", line)


def test_a_cache_that_cannot_be_used_is_not_spoken_of(traced, monkeypatch, capsys, tmp_path):
    (tmp_path / "file").touch()
    for choice in (tmp_path / "file", tmp_path / "file" / "below", "off", "OFF", "0", "no"):
        monkeypatch.setenv("ROOTSOPT_CACHE", str(choice))
        cli.use_cache()
        ask(CachedFunction(scaled))
    assert len(traced) == 6
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert capsys.readouterr().err == ""


def test_programs_called_from_python_are_kept_without_being_asked(monkeypatch, tmp_path):
    """They are kept in the folder that the environment names, as those of the commands."""
    monkeypatch.setattr(programs, "_chosen", False)
    monkeypatch.setenv("ROOTSOPT_CACHE", str(tmp_path / "cache"))
    ask(CachedFunction(scaled))
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_programs_that_call_out_are_not_kept(folder):
    """Loaded without being lowered, they would call functions that are not set up."""
    np.testing.assert_allclose(CachedFunction(solved)(jnp.eye(2) * 2), [1, 0])
    assert not list(folder.iterdir())


def place():
    """Return name and purpose of a program in the store.

    Its arguments are integers, so that the precision changes nothing in them."""
    _, kind = programs._split((Factor(jnp.asarray(2, "int8"), 2), np.ones(3, "int8"), "a"))
    return CachedFunction(scaled)._place(kind)[1:]


def variable(name, more):
    return lambda patch: patch.setenv(name, os.environ.get(name, "") + more)


def version(package):
    found, other = metadata.version, {package: "0"}
    return lambda patch: patch.setattr(
        metadata, "version", lambda name: other.get(name) or found(name)
    )


def processor(patch):
    """Remove an instruction from the processor's description.

    A kept program with that instruction would end the process."""
    found = Path.read_text

    def other(path, *args, **kwargs):
        return re.sub(r"(?m)^(flags|Features)(.*) \w+$", r"\1\2", found(path, *args, **kwargs))

    patch.setattr(Path, "read_text", other)
    patch.setattr(platform, "processor", lambda: "other")


def setting(name, value):
    return lambda patch: patch.setattr(type(jax.config), name, value)


CHANGES = {
    "flags of XLA": variable("XLA_FLAGS", " --xla_cpu_enable_fast_math=true"),
    "checks of equinox": variable("EQX_ON_ERROR", "nan"),
    "precision": setting("jax_enable_x64", False),
    "matrix products": setting("jax_default_matmul_precision", "bfloat16"),
    "promotion": setting("jax_numpy_dtype_promotion", "strict"),
    "seeds": setting("jax_random_seed_offset", 1),
    "machine": lambda patch: patch.setattr(platform, "machine", lambda: "abacus"),
    "processor": processor,
    **{package: version(package) for package in ("jaxlib", "diffrax")},
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_program_is_another_after_a_change(what, folder, monkeypatch):
    def fresh():
        programs._machine.cache_clear()
        programs._versions.cache_clear()
        return place()

    first = fresh()
    assert place() == first
    with monkeypatch.context() as patch:
        CHANGES[what](patch)
        assert not set(first) & set(fresh())
    assert fresh() == first


def test_a_program_follows_the_code_that_it_may_import(monkeypatch, tmp_path):
    """Not rooms that it does not import, such as a report."""
    package, left = tmp_path / "rootsopt", shutil.ignore_patterns("__pycache__", "configs")
    shutil.copytree(programs._PACKAGE, package, ignore=left)
    monkeypatch.setattr(programs, "_PACKAGE", package)

    def replaced(name, old, new):
        text = (package / name).read_text()
        assert old in text
        (package / name).write_text(text.replace(old, new, 1))
        programs._digest.cache_clear()
        return programs._sources({"rootsopt.response.evaluation"})

    first = replaced("status.py", "a", "a")
    assert replaced("view/pages/html.py", "def ", "x = 1\n\n\ndef ") == first
    assert replaced("commands/cli.py", "import", "import time  # or not\nimport") == first
    seen = [first]
    for name, old, new in (
        ("dynamics/window.py", "BLOCK = 4", "BLOCK = 8"),  # imported by what is imported
        ("profiles/cic.py", "return ", "return 2 * "),  # named by the table of families
        ("dynamics/parts/machine.py", " - ", " + "),
        ("runtime/programs.py", "return [x for x in jax", "return [1 * x for x in jax"),
        ("scene/__init__.py", "\nfrom", "\nimport time\nfrom"),
    ):
        seen.append(replaced(name, old, new))
        assert seen.count(seen[-1]) == 1, name
    (package / "contact" / "gap.py").rename(package / "contact" / "gaps.py")
    assert replaced("status.py", "a", "a") not in seen


@pytest.mark.parametrize(
    ("before", "after", "same"),
    [
        ("x = 1", "x = 1  # 'one", True),
        ("x = 1", "# one\n\n\nx = 1", True),
        (
            'def f():\n    """Do."""\n    x = 1',
            'def f():\n    """Do \\"""it.\n    x"""\n    x = 1',
            True,
        ),
        ('def f():\n    r"""Do."""\n    x = 1', "def f():\n    x = 1", True),
        ("x = '# one'", "x = '# two'", False),
        ('x = "\\"# one"', 'x = "\\"# two"', False),
        ('x = """\n# one\n"""', 'x = """\n# two\n"""', False),
        (
            '"""Do."""  # or not\nx = 1\ny = """z"""',
            '"""Do."""  # or not\nx = 2\ny = """z"""',
            False,
        ),
        ("if x:\n  y = 1\nz = 1", "if x:\n  y = 1\n  z = 1", False),
        ("x = 10", "x = 1 0", False),
    ],
)
def test_only_words_for_people_change_nothing(tmp_path, before, after, same):
    found = []
    for number, text in enumerate((before, after)):
        (tmp_path / "one.py").write_text(f"{text}\n")
        found.append(programs._digest(tmp_path / "one.py", number))
    assert (found[0] == found[1]) == same


def test_a_program_of_sources_elsewhere_follows_them(folder, monkeypatch, tmp_path):

    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    answers = []
    for step in (1, 2):
        (tmp_path / "own_room.py").write_text(
            "import equinox as eqx\n"
            "class Part(eqx.Module):\n"
            "    size: float\n"
            f"    def grown(self, x): return x + self.size * {step}\n"
            f"def function(x): return x + {step}\n"
        )
        monkeypatch.delitem(sys.modules, "own_room", raising=False)
        importlib.invalidate_caches()
        own = importlib.import_module("own_room")
        answers += [
            float(CachedFunction(own.function)(jnp.ones(()))),
            float(CachedFunction(grown)(own.Part(2.0), 1.0)),
        ]
    assert answers == [2.0, 3.0, 3.0, 5.0]
    assert len(list(folder.iterdir())) == 4
    del own.__file__
    assert float(CachedFunction(own.function)(jnp.ones(2))[0]) == 3.0
    assert len(list(folder.iterdir())) == 4


def test_programs_follow_the_files_of_families_from_outside(folder, monkeypatch, tmp_path):
    """Changed files of outside families, and files that they import, are compiled again.

    A name in a config shows neither."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "own_helper.py").write_text("SIZE = 1\n")
    (tmp_path / "own_family.py").write_text(
        "import own_helper\n"
        "from rootsopt import Family, register_family\n"
        "def make(lobes, pitch_radius): return own_helper.SIZE\n"
        "register_family(Family(name='of_a_helper', help='none', maker=make))\n"
    )
    before = place()
    with for_a_time():
        import_named("own_family")
        found = [place()]
        for name in ("own_helper", "own_family"):
            (tmp_path / f"{name}.py").write_text("changed = 1\n")
            found.append(place())
        assert len({before, *found}) == 4
    assert place() == before
    for name in ("own_helper", "own_family"):
        del sys.modules[name]


def test_host_arithmetic_compiles_nothing():
    """Outside of programs, JAX would compile a small program for each operation on its arrays."""
    config = load("cic_drawn")
    scene = Scene.from_config(config)
    jax.config.update("jax_no_execution", True)  # Any operation on arrays raises an error.
    try:
        assert not np.any(KnownOrbit.empty((7, 9), 3, 2).elements.mesh.times)
        assert not sheet._has_play(scene)
        assert not [*space._reaching(config)]
    finally:
        jax.config.update("jax_no_execution", False)


def grown(part, x):
    return part.grown(x) + 0.0 * jnp.ones(())


def test_time_spent_compiling_side_by_side_counts_once():
    began = time.perf_counter()
    with CompileClock() as clock:
        program = CachedFunction(scaled)
        for work in (program.prepare, program):
            for power in range(2, 8):
                work(Factor(jnp.asarray(2.0), power), np.ones(3), "a")
    assert 0 < clock.seconds <= time.perf_counter() - began
