"""Compiled programs: called, prepared, kept between processes and thrown away."""

import os
import threading
import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import programs
from rootsopt.programs import Program
from rootsopt.timing import CompileClock


class Answer(NamedTuple):
    total: object
    name: str


class Factor(eqx.Module):
    value: object
    power: int = eqx.field(static=True)


TRACED = []


def scaled(factor, numbers, name):
    """A function of a module, arrays and something static."""
    TRACED.append(name)
    return Answer({"sum": jnp.sum(factor.value * numbers**factor.power)}, name)


def solved(matrix):
    """Needs LAPACK, which is set up when a program is lowered."""
    return jnp.linalg.solve(matrix, matrix[0])


@pytest.fixture(autouse=True)
def traced(monkeypatch):
    """The traces of `scaled`, from none on; no programs are kept."""
    monkeypatch.setattr(programs, "_folder", None)
    TRACED.clear()
    return TRACED


def ask(program, power=2, size=3, name="a"):
    answer = program(Factor(jnp.asarray(2.0), power), np.arange(size, dtype=float), name)
    assert isinstance(answer, Answer)
    assert answer.name == name
    assert float(answer.total["sum"]) == 2 * sum(k**power for k in range(size))
    return answer


def test_a_program_is_traced_once_for_each_kind_of_arguments(traced):
    program = Program(scaled)
    ask(program)
    ask(program)
    assert len(traced) == 1
    for other in ({"power": 3}, {"size": 4}, {"name": "b"}):
        ask(program, **other)
    assert len(traced) == 4


def test_a_program_inside_another_is_a_plain_function(traced):
    program = Program(scaled)
    factors = Factor(jnp.arange(3.0), 2)
    answer = jax.vmap(lambda value: program(Factor(value, 2), jnp.ones(2), "a").total["sum"])(
        factors.value
    )
    np.testing.assert_array_equal(answer, [0, 2, 4])
    assert traced == ["a"]


def test_prepared_programs_are_ready_when_called(traced):
    program = Program(scaled)
    shape = jax.ShapeDtypeStruct((3,), float)
    kind = Factor(jax.ShapeDtypeStruct((), float), 2), shape, "a"
    assert program.outline(*kind).total["sum"].shape == ()
    traced.clear()
    program.prepare(*kind)
    program.prepare(*kind)
    ask(program)
    assert len(traced) == 1


def test_a_failure_is_raised_by_the_call_and_not_remembered():
    fails = [True]

    def moody(x):
        if fails[0]:
            raise ValueError("no")
        return x + 1

    program = Program(moody)
    program.prepare(jnp.ones(2))
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and "_make" in thread.name:
            thread.join()
    with pytest.raises(ValueError, match="no"):
        program(jnp.ones(2))
    fails[0] = False
    np.testing.assert_array_equal(program(jnp.ones(2)), [2, 2])


def test_kept_programs_are_found_without_tracing(tmp_path, traced):
    """Another process is stood in for by another `Program` of the same function."""
    programs.keep_in(tmp_path / "new" / "folder")
    first = ask(Program(scaled))
    assert len(list((tmp_path / "new" / "folder").iterdir())) == 1
    again = ask(Program(scaled))
    assert traced == ["a"]
    assert first.total["sum"] == again.total["sum"]
    assert Program(scaled).outline(Factor(jnp.ones(()), 2), np.ones(3), "a").name == "a"
    assert traced == ["a"]
    ask(Program(scaled), power=3)
    assert len(traced) == 2


def test_a_damaged_or_unwritable_cache_is_no_error(tmp_path, traced):
    programs.keep_in(tmp_path)
    ask(Program(scaled))
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:100])
    ask(Program(scaled))
    assert len(traced) == 2
    ask(Program(scaled))
    assert len(traced) == 2
    programs.keep_in(file / "below a file")
    ask(Program(scaled))
    assert len(traced) == 3


def test_programs_that_call_out_are_not_kept(tmp_path):
    """Loaded without being lowered they would call what has not been set up."""
    programs.keep_in(tmp_path)
    np.testing.assert_allclose(Program(solved)(jnp.eye(2) * 2), [1, 0])
    assert not list(tmp_path.iterdir())


def test_the_oldest_programs_give_way(tmp_path, monkeypatch):
    """Programs do; what else lies in the folder, older and larger, is left alone."""
    programs.keep_in(tmp_path)
    ask(Program(scaled))
    (oldest,) = tmp_path.iterdir()
    other = tmp_path / "of the user"
    other.write_bytes(bytes(10 * oldest.stat().st_size))
    os.utime(other, (0, 0))
    monkeypatch.setattr(programs, "_MOST_BYTES", 2.5 * oldest.stat().st_size)
    for power in (3, 4):
        time.sleep(0.02)
        ask(Program(scaled), power=power)
    kept = list(tmp_path.iterdir())
    assert len(kept) == 3
    assert other in kept
    assert oldest not in kept


def test_time_spent_compiling_side_by_side_counts_once():
    began = time.perf_counter()
    with CompileClock() as clock:
        program = Program(scaled)
        for power in range(2, 8):
            program.prepare(Factor(jnp.asarray(2.0), power), np.ones(3), "a")
        for power in range(2, 8):
            program(Factor(jnp.asarray(2.0), power), np.ones(3), "a")
    assert 0 < clock.seconds <= time.perf_counter() - began
