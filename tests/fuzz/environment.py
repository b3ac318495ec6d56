"""Commands in random environments: the same result, or exit 2 with one line.

Each case sets a few variables that work, are ignored or are rejected, and runs `profile` with
them."""

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.fuzz.report import Report

ROOT = Path(__file__).parents[2]
EE = str(ROOT / "configs" / "ee.yaml")
WORKS = {
    "device": {"JAX_PLATFORMS": ["cpu", ""], "JAX_PLATFORM_NAME": ["cuda", "nonsense"]},
    "numbers": {
        "JAX_ENABLE_X64": ["0", "1", "maybe"],
        "JAX_NUMPY_RANK_PROMOTION": ["raise", "warn", "junk"],
        "JAX_NUMPY_DTYPE_PROMOTION": ["strict", "junk"],
        "JAX_DEFAULT_MATMUL_PRECISION": ["bfloat16", "highest", "junk"],
        "JAX_DEFAULT_PRNG_IMPL": ["rbg", "junk"],
        "JAX_RANDOM_SEED_OFFSET": ["7", "junk"],
        "JAX_DISABLE_MOST_OPTIMIZATIONS": ["1"],
        "JAX_SOFTMAX_CUSTOM_JVP": ["1"],
    },
    "debugging": {
        "JAX_DEBUG_NANS": ["1", "0", "junk"],
        "JAX_DEBUG_INFS": ["1"],
        "JAX_DISABLE_JIT": ["1", "true"],
        "JAX_ENABLE_CHECKS": ["1"],
        "JAX_CHECK_TRACER_LEAKS": ["1"],
        "JAX_TRANSFER_GUARD": ["disallow", "log", "junk"],
        "JAX_NO_TRACING": ["1"],
        "JAX_NO_EXECUTION": ["1"],
        "EQX_ON_ERROR": ["breakpoint", "nan", "raise", "garbage"],
        "EQX_GETKEY_SEED": ["junk"],
        "JAXTYPING_DISABLE": ["junk", "1"],
        "JAX_TRACEBACK_FILTERING": ["off"],
    },
    "flags of XLA": {
        "XLA_FLAGS": [
            "",
            " ",
            "--xla_cpu_multi_thread_eigen=false",
            "--xla_force_host_platform_device_count=3",
            "--xla_cpu_enable_fast_math=false",
        ],
    },
    "figures": {
        "MPLBACKEND": ["nonsense", "TkAgg", ""],
        "MPLCONFIGDIR": ["/dev/null/below", "relative"],
        "MATPLOTLIBRC": ["/dev/null/below"],
        "DISPLAY": [":77"],
    },
    "terminal": {
        "COLUMNS": ["0", "1", "-1", "junk", "1000000"],
        "LINES": ["0", "junk"],
        "TERM": ["dumb", "nonsense", ""],
        "NO_COLOR": ["1"],
        "LANG": ["C", "nonsense"],
        "LC_ALL": ["C", "POSIX"],
        "PYTHONUTF8": ["0"],
        "PYTHONCOERCECLOCALE": ["0"],
        "PYTHONIOENCODING": ["ascii", "latin-1", "utf-16"],
    },
    "Python": {
        "PYTHONWARNINGS": ["error", "always", "junk"],
        "PYTHONOPTIMIZE": ["2", "1"],
        "PYTHONUNBUFFERED": ["1"],
        "PYTHONHASHSEED": ["7"],
    },
    "threads": {"OMP_NUM_THREADS": ["0", "1", "junk", "-3"], "NPROC": ["junk"]},
    "folders": {
        "HOME": ["/dev/null/home", "", "relative"],
        "TMPDIR": ["/dev/null/below"],
        "XDG_CACHE_HOME": ["relative", "/dev/null/below"],
        "XDG_STATE_HOME": ["relative", "/dev/null/below", "/tmp"],
        "ROOTSOPT_CACHE": ["off", "/dev/null", "/dev/null/below", "/tmp", "relative", "~"],
    },
}
REFUSED = {
    "device": {"JAX_PLATFORMS": ["nonsense", "METAL", "CPU", ","]},
    "flags of XLA": {
        "XLA_FLAGS": [
            "--xla_nonsense",
            "junk",
            "--xla_cpu_parallel_codegen_split_count=some",
            "--xla_backend_extra_options=rubbish",
            "--xla_cpu_enable_fast_math",
            "--help",
        ],
    },
    "debugging": {
        "JAX_LOGGING_LEVEL": ["junk"],
        "JAX_LOG_COMPILES": ["maybe"],
        "JAX_DUMP_IR_TO": ["/dev/null/below"],
    },
}
QUICK = "--no-figures", "--export", "none"
_GROUPS = [(kind, True) for kind in WORKS] + [(kind, False) for kind in REFUSED]


def run(report: Report, seed: int) -> None:
    """Try cases until the campaign is over."""
    choose = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        base = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": str(folder / "jax"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "XDG_STATE_HOME": str(folder / "state"),
            "PYTHONPATH": str(ROOT),
        }
        code, _, error, expected = _profile(folder, base)
        if expected is None:
            raise RuntimeError(f"the command fails without any of the variables: {code} {error}")
        while not report.over:
            kind, works = choose.choice(_GROUPS)
            variables = {}
            if not works:
                name, values = choose.choice(list(REFUSED[kind].items()))
                variables = {name: choose.choice(values)}
            for among in (kind, choose.choice(list(WORKS))):
                for name, values in (WORKS.get(among) or {}).items():
                    if choose.random() < 0.4:
                        variables.setdefault(name, choose.choice(values))
            report.add(
                f"{kind}: {'works' if works else 'refused'}",
                _failure(folder, base, variables, works, expected),
            )


def _profile(folder: Path, variables: dict[str, str]):
    """Return exit code, both outputs, and the geometry in the result, if there is one."""
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    done = subprocess.run(
        [sys.executable, "-m", "rootsopt.profile", EE, "-o", str(out), *QUICK],
        capture_output=True,
        cwd=folder,
        env=variables,
        check=False,
        timeout=300,
    )
    result = out / "result.json"
    geometry = json.loads(result.read_text("utf-8"))["geometry"] if result.exists() else None
    return done.returncode, done.stdout, done.stderr.decode(errors="replace"), geometry


def _failure(folder: Path, base, variables, works: bool, expected) -> str | None:
    try:
        code, out, error, geometry = _profile(folder, base | variables)
    except subprocess.TimeoutExpired:
        return f"{variables}: no end after 300 s"
    said = f"{variables}: exit {code}, {error[-300:]!r}"
    if "Traceback" in error:
        return said
    lines = [line for line in error.splitlines() if line.startswith("rootsopt profile: ")]
    if not works:
        return None if code == 2 and len(lines) == 1 and geometry is None else said
    good = code == 0 and not lines and geometry == expected and len(out) > 800
    return None if good else said
