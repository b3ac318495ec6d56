"""Environment variables and machines: what is ignored, refused, or works."""

import json
import os
import re
import subprocess
import sys
import types
import warnings
from unittest import mock

import jax
import jax.numpy as jnp
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rootsopt.errors import InputError
from rootsopt.runtime import environment
from tests.standins import ROOT, refusal

SET_ASIDE = {
    "JAX_DEBUG_NANS": "1",
    "JAX_DEBUG_INFS": "True",
    "JAX_DISABLE_JIT": "1",
    "JAX_ENABLE_CHECKS": "1",
    "JAX_CHECK_TRACER_LEAKS": "1",
    "JAX_ENABLE_X64": "0",
    "JAX_NUMPY_RANK_PROMOTION": "raise",
    "JAX_NUMPY_DTYPE_PROMOTION": "strict",
    "JAX_DEFAULT_MATMUL_PRECISION": "bfloat16",
    "JAX_RANDOM_SEED_OFFSET": "7",
    "JAX_TRANSFER_GUARD": "disallow",
    "JAX_PLATFORM_NAME": "cuda",
    "JAX_THREEFRY_PARTITIONABLE": "perhaps",
    "EQX_ON_ERROR": "breakpoint",
}
HARMLESS = {
    "JAX_SOFTMAX_CUSTOM_JVP": "0",  # in force anyway
    "JAX_NOT_OF_JAX": "1",
    "JAX_TRACEBACK_FILTERING": "off",
    "EQX_GETKEY_SEED": "junk",
    "JAXTYPING_DISABLE": "junk",
    "MPLBACKEND": "nonsense",
    "MPLCONFIGDIR": "/dev/null/below",
    "HOME": "/dev/null/home",
    "OMP_NUM_THREADS": "junk",
    "PYTHONWARNINGS": "error",
    "TERM": "dumb",
    "NO_COLOR": "1",
    "COLUMNS": "1",
    "LINES": "junk",
}


def profiled(output, **variables):
    return subprocess.run(
        [sys.executable, "-m", "rootsopt.profile", "ee", "-o", str(output), "--no-figures"],
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        cwd=ROOT,
        check=False,
        env=os.environ | variables,
    )


# Further values with which a command must compute the same.
ODD = {
    "COLUMNS": ["0", "-1", "junk", "1000000"],
    "EQX_ON_ERROR": ["nan", "raise", "garbage"],
    "HOME": ["", "relative"],
    "JAX_DEBUG_NANS": ["0", "junk"],
    "JAX_DEFAULT_PRNG_IMPL": ["rbg", "junk"],
    "JAX_DISABLE_MOST_OPTIMIZATIONS": ["1"],
    "JAX_ENABLE_X64": ["1", "maybe"],
    "JAX_NO_EXECUTION": ["1"],
    "JAX_NO_TRACING": ["1"],
    "JAX_NUMPY_DTYPE_PROMOTION": ["junk"],
    "JAX_NUMPY_RANK_PROMOTION": ["warn", "junk"],
    "JAX_PLATFORMS": ["cpu", ""],
    "JAX_TRANSFER_GUARD": ["log", "junk"],
    "LC_ALL": ["C", "POSIX", "nonsense"],
    "MATPLOTLIBRC": ["/dev/null/below"],
    "MPLCONFIGDIR": ["relative"],
    "NPROC": ["junk"],
    "OMP_NUM_THREADS": ["0", "-3"],
    "PYTHONHASHSEED": ["7"],
    "PYTHONIOENCODING": ["ascii", "latin-1", "utf-16"],
    "PYTHONOPTIMIZE": ["2"],
    "PYTHONUTF8": ["0"],
    "PYTHONWARNINGS": ["always", "junk"],
    "ROOTSOPT_CACHE": ["off", "/dev/null", "/dev/null/below", "relative", "~"],
    "TERM": ["nonsense", ""],
    "TMPDIR": ["/dev/null/below"],
    "XDG_CACHE_HOME": ["relative", "/dev/null/below"],
    "XDG_STATE_HOME": ["relative", "/dev/null/below"],
    "XLA_FLAGS": ["", " ", "--xla_cpu_multi_thread_eigen=false",
                  "--xla_force_host_platform_device_count=3"],
}  # fmt: skip
# Values with which a command cannot work.
WRONG = {
    "JAX_DUMP_IR_TO": ["/dev/null/below"],
    "JAX_LOG_COMPILES": ["maybe"],
    "JAX_PLATFORMS": ["METAL", ","],
    "XLA_FLAGS": ["junk", "--help", "--xla_backend_extra_options=rubbish"],
}


def one_of(names):
    return st.sampled_from([{name: value} for name, values in names.items() for value in values])


@pytest.mark.long
@given(odd=st.lists(one_of(ODD), max_size=12), wrong=st.just({}) | one_of(WRONG))
def test_random_environments(tmp_path_factory, odd, wrong):
    """The geometry is the same to the last bit, or the exit code is 2, with one line."""
    variables = dict(pair for one in [*odd, wrong] for pair in one.items())
    out = tmp_path_factory.mktemp("run")
    done = profiled(out, **variables)
    said = done.stderr.replace("\0", "")  # UTF-16 has zeros between the letters.
    assert "Traceback" not in said
    told = done.returncode, said.count("rootsopt profile: ")
    assert told == ((2, 1) if wrong else (0, 0)), said
    if not wrong:
        plain = out.with_name("plain")
        assert plain.exists() or profiled(plain).returncode == 0
        found, wanted = (json.loads((x / "result.json").read_text("utf-8")) for x in (out, plain))
        assert found["geometry"] == wanted["geometry"]


@pytest.mark.parametrize(
    ("name", "value"),
    [("JAX_PLATFORMS", "nonsense"), ("JAX_LOGGING_LEVEL", "junk")],
)
def test_what_cannot_work_is_refused_in_one_line(tmp_path, name, value):
    done = profiled(tmp_path / "out", **{name: value})
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("rootsopt profile: ")
    assert [word for word in (name, value, "unset") if word not in line] == []
    assert not (tmp_path / "out" / "result.json").exists()


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        ("--xla_cpu_parallel_codegen_split_count=some", "some"),
        ("--xla_backend_extra_options=rubbish", "rubbish"),
        ("--xla_force_host_platform_device_count=0", "process"),
        ("a/file/of/flags", "begin with --"),
        ("--xla_cpu_enable_fast_math=true", "xla_cpu_enable_fast_math"),
        ("--xla_dump_to=x --xla_cpu_enable_fast_math", "xla_cpu_enable_fast_math"),
        ("--xla_nonsense=" + "x" * 5000, "Unknown flag"),
    ],
)
def test_flags_of_xla_are_tried_in_a_process_of_their_own(monkeypatch, flags, word):
    monkeypatch.delenv(environment._CHECKED, raising=False)
    monkeypatch.setenv("XLA_FLAGS", flags)
    message = refusal(environment._check_flags, flags)
    assert ("XLA_FLAGS" in message, word in message) == (True, True), message


def test_flags_that_work_are_tried_once(monkeypatch):
    """Child processes do not try the flags again; without flags nothing is tried."""
    flags = "--xla_cpu_enable_fast_math=false --xla_cpu_multi_thread_eigen=false"
    monkeypatch.delenv(environment._CHECKED, raising=False)
    monkeypatch.setenv("XLA_FLAGS", flags)
    environment._check_flags(flags)
    environment.use_compiled_loops()
    assert os.environ["XLA_FLAGS"] == flags  # XLA has read its flags already
    monkeypatch.setattr(environment, "_started", lambda: False)
    environment.use_compiled_loops()
    assert environment._LOOPS in os.environ["XLA_FLAGS"]

    monkeypatch.setattr(environment.subprocess, "run", mock.Mock(side_effect=AssertionError))
    environment._check_flags(os.environ["XLA_FLAGS"])
    for before in ("", "  "):
        monkeypatch.setenv("XLA_FLAGS", before)
        environment.use_float64()
        assert os.environ["XLA_FLAGS"].startswith("--xla_backend_extra_options")
        environment.use_float64()
    with pytest.raises(AssertionError):
        environment._check_flags("--xla_dump_to=elsewhere")


def test_loops_are_compiled_from_python_without_a_call():
    """The flag is set when a name of the package is first used, and not on import."""
    flags = "print(os.environ.get('XLA_FLAGS', ''))"
    script = f"import os, jax, rootsopt; {flags}; rootsopt.Status; {flags}"
    variables = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    said = subprocess.check_output([sys.executable, "-c", script], env=variables, text=True)
    before, after = said.splitlines()
    assert (before, environment._LOOPS in after) == ("", True)


def test_settings_of_a_python_session_are_put_right(monkeypatch, capsys):
    """Where JAX was imported before, variables come too late; its settings are changed."""
    monkeypatch.setattr(environment, "_noticed", set())
    wrong = {"jax_debug_nans": True, "jax_numpy_rank_promotion": "raise", "jax_enable_x64": False}
    for name, value in wrong.items():
        jax.config.update(name, value)
    environment.use_float64()
    assert jnp.ones(1).dtype == float
    assert not jax.config.values["jax_debug_nans"]
    assert jax.config.values["jax_numpy_rank_promotion"] == "allow"
    environment.use_float64()
    (line,) = capsys.readouterr().err.splitlines()
    assert ("jax_debug_nans" in line, "jax_enable_x64" in line) == (True, False)


class Machine:
    """Stand in for JAX on a machine with one platform beside the CPU."""

    def __init__(self, platform):
        self.platform = platform
        self.chosen = None
        self.config = types.SimpleNamespace(values={"jax_platforms": None}, update=self._update)
        self.numpy = jnp

    def _update(self, name, value):
        assert name == "jax_platforms"
        self.chosen = value

    def default_backend(self):
        if self.chosen not in ("", "cpu", self.platform):
            raise RuntimeError(f"Unable to initialize backend '{self.chosen}' (set X to Y)")
        return self.platform if self.chosen != "cpu" else "cpu"


@pytest.mark.parametrize(
    ("variables", "platform", "chosen"),
    [
        ({}, "cuda", "cpu"),
        ({"JAX_PLATFORMS": "cuda"}, "cuda", "cuda"),
        ({"JAX_PLATFORMS": ""}, "cuda", ""),
        ({"JAX_PLATFORMS": "cpu"}, "tpu", "cpu"),
    ],
)
def test_a_platform_that_is_there_is_not_refused(monkeypatch, variables, platform, chosen):
    monkeypatch.setattr(os, "environ", variables)
    machine = Machine(platform)
    environment._start_device(machine)
    assert machine.chosen == chosen


def test_a_platform_that_is_not_there_is_refused(monkeypatch):
    for variable in ("cuda", "METAL", "CPU", "cuda,cpu", ",", "x" * 5000):
        monkeypatch.setenv("JAX_PLATFORMS", variable)
        message = refusal(environment._start_device, Machine("tpu"))
        assert re.search("JAX_PLATFORMS.* unset", message)
        assert "set X" not in message


def test_a_device_without_double_precision_is_refused(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "METAL")
    machine = Machine("METAL")
    machine.numpy = types.SimpleNamespace(ones=lambda *_: 1 / 0)
    assert "METAL" in refusal(environment._start_device, machine)


def test_a_lack_of_memory_is_explained():
    for work in (mock.Mock(side_effect=MemoryError), lambda: jnp.ones(2**46).block_until_ready()):
        with pytest.raises(InputError, match="not enough memory"), environment.explained():
            work()
    with pytest.raises(ZeroDivisionError), environment.explained():
        _ = 1 / 0


@pytest.mark.parametrize(
    ("columns", "after"), [("0", None), ("-3", None), ("junk", None), ("5", None), ("72", "72")]
)
def test_a_table_is_never_too_narrow_to_read(monkeypatch, columns, after):
    monkeypatch.setenv("COLUMNS", columns)
    environment.own_process()
    assert os.environ.get("COLUMNS") == after


def test_warnings_never_end_a_command(monkeypatch):
    monkeypatch.setattr(sys, "warnoptions", ["error::UserWarning"])
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("error")
        environment.own_process()
        warnings.warn("only that", UserWarning, stacklevel=1)
    monkeypatch.setattr(sys, "warnoptions", [])
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of a caller, as pytest, who wants them
        environment.own_process()
        with pytest.raises(UserWarning, match="only"):
            warnings.warn("only that", UserWarning, stacklevel=1)


def test_nothing_is_said_where_nobody_can_read_it(monkeypatch):
    full = mock.Mock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr(environment, "_noticed", set())
    monkeypatch.setattr(sys, "stderr", types.SimpleNamespace(write=full))
    environment.say("unread")
    full.assert_called()
