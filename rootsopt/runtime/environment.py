"""Protects commands from environment variables that change results.

A command owns its process and computes in double precision with JAX's own defaults. Variables that
only choose a device, a cache or a log are respected. Variables that change numbers, or make JAX
stop on purpose, are ignored and named on stderr. Settings that cannot work raise `InputError`
before anything is computed. This matters because XLA ends the whole process if it finds an unknown
flag."""

import contextlib
import importlib.metadata
import logging
import os
import platform
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator

from threadpoolctl import threadpool_limits

import rootsopt
from rootsopt.errors import InputError

# Prefixes of the JAX variables that have their usual effect: they choose a device, a cache or a
# log.
_RESPECTED = (
    "JAX_PLATFORMS",
    "JAX_COMPILATION_CACHE_",
    "JAX_PERSISTENT_CACHE_",
    "JAX_ENABLE_COMPILATION_CACHE",
    "JAX_RAISE_PERSISTENT_CACHE_ERRORS",
    "JAX_LOG",
    "JAX_EXPLAIN_CACHE_MISSES",
    "JAX_DEBUG_LOG_MODULES",
    "JAX_TRACEBACK_FILTERING",
    "JAX_DUMP_IR_",
    "JAX_CUDA_VISIBLE_DEVICES",
    "JAX_ROCM_VISIBLE_DEVICES",
    "JAX_ONEAPI_VISIBLE_DEVICES",
    "JAX_PJRT_CLIENT_CREATE_OPTIONS",
)

# Settings of JAX on which every result relies. JAX's checks for NaN are off, because programs use
# NaN on purpose.
_REQUIRED = {
    "jax_enable_x64": True,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
    "jax_default_matmul_precision": None,
    "jax_disable_jit": False,
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_debug_key_reuse": False,
    "jax_enable_checks": False,
    "jax_check_tracer_leaks": False,
    "jax_no_tracing": False,
    "jax_no_execution": False,
}

# Name of the variable that tells child processes which value of XLA_FLAGS has been tested.
_CHECKED = "ROOTSOPT_XLA_FLAGS_CHECKED"

# On a CPU, XLA compiles a loop to one function if its buffers are small. Otherwise it calls one
# function per operation and iteration, which here costs several times the arithmetic itself.
_LOOPS = "xla_cpu_small_while_loop_byte_threshold"

# Pattern of flags that make the compiler assume that NaN and infinity never occur.
_UNSOUND = re.compile(r"--?(xla_cpu_enable_fast_math)(?:=(?:true|1|t|yes|y))?(?=\s|$)", re.I)

# Python script that compiles one operation to test XLA_FLAGS. It imports only the necessary parts
# of JAX.
_TRIAL = """
import sys
try:
    from jaxlib import xla_client
    make, devices = xla_client.make_cpu_client, xla_client.DeviceList
    options = xla_client.CompileOptions()
except (ImportError, AttributeError, TypeError):
    sys.exit(0)
client = make()
text = '''module { func.func public @main(%arg0: tensor<f64>) -> tensor<f64> {
  %0 = stablehlo.sine %arg0 : tensor<f64>
  return %0 : tensor<f64> } }'''
try:
    client.compile_and_load(text, devices(tuple(client.local_devices()[:1])), options)
except (AttributeError, TypeError):
    pass
"""
_TRIAL_SECONDS = 60.0
_LOG_PREFIX = re.compile(r"^[IWEF]\d{4} \S+\s+\d+ \S+\] ")

# Names of the variables with the number of threads of libraries for dense algebra (BLAS, LAPACK).
_ALGEBRA = (
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "OMP_NUM_THREADS",
)

# Terminal width (characters) in the variable COLUMNS below which the variable is ignored.
# Narrower tables would lose their numbers.
_NARROWEST = 40

_noticed: set[str] = set()


def say(text: str) -> None:
    """Print `text` as one line on stderr, unless this process has already printed it."""
    if text not in _noticed:
        _noticed.add(text)
        with contextlib.suppress(OSError, ValueError):
            print(f"rootsopt: {' '.join(text.split())}", file=sys.stderr)


def shortened(value: str, longest: int = 80) -> str:
    """Return `value` in quotation marks for a message, with control characters escaped.

    `longest`: number of characters above which the text is shortened.
    """
    text = repr(value)
    return text if len(text) <= longest else f"{text[: longest - 4]}...{text[-1]}"


def own_process() -> None:
    """Override environment settings that would disturb a command. Call this before anything else.

    Afterwards, warnings do not become errors, tables are wide enough to read, and figures need no
    display. The runtime checks of equinox are off, and dense algebra uses one thread. `use_float64`
    handles the variables of JAX."""
    if any(option.lower().startswith("e") for option in sys.warnoptions):
        kept = [entry for entry in warnings.filters if entry[0] != "error"]
        warnings.filters[:] = kept  # type: ignore[index]
        warnings.simplefilter("default", append=True)
    columns = os.environ.get("COLUMNS", "")
    if not (columns.isdecimal() and int(columns) >= _NARROWEST):
        os.environ.pop("COLUMNS", None)
    if "matplotlib" not in sys.modules:
        os.environ["MPLBACKEND"] = "agg"
    # Without a folder for its settings, matplotlib uses a temporary one and says so in two lines.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    if "equinox" not in sys.modules:
        chosen = os.environ.get("EQX_ON_ERROR", "off")
        os.environ["EQX_ON_ERROR"] = "off"
        if chosen != "off":
            _set_aside([f"EQX_ON_ERROR={shortened(chosen)}"])
        for name in [name for name in os.environ if name.startswith(("EQX_GETKEY", "JAXTYPING_"))]:
            del os.environ[name]
    use_one_thread()


def use_one_thread() -> None:
    """Make dense algebra use one thread, from now on and in processes that this one starts.

    Otherwise rounding, and with it the course of a search, depends on the number of cores. XLA's
    own threads do not matter: they divide arrays, never a sum."""
    os.environ.update(dict.fromkeys(_ALGEBRA, "1"))  # read by libraries that are loaded later
    threadpool_limits(1)


def use_float64() -> None:
    """Import JAX in double precision, apply the required settings, and start the device.

    Raises `InputError` if the environment prevents JAX from starting."""
    # Set aside the variables of JAX that are not respected; JAX reads them when it is imported.
    names = [] if "jax" in sys.modules else [name for name in os.environ if name.startswith("JAX_")]
    aside = {name: os.environ.pop(name) for name in names if not name.startswith(_RESPECTED)}
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if flags:
        _check_flags(flags)
    else:
        os.environ.pop("XLA_FLAGS", None)
    use_compiled_loops()
    try:
        import jax
    except Exception as error:  # including JAX's own complaints about respected variables
        chosen = {name: value for name, value in os.environ.items() if name.startswith("JAX_")}
        said = ", ".join(f"{name}={shortened(value)}" for name, value in sorted(chosen.items()))
        advice = f"correct or unset {said}" if said else "repair its installation"
        raise InputError(f"JAX cannot be imported here: {_reason(error)}; {advice}") from error
    changed = _require(jax.config)
    known = jax.config.values
    foreign = {name: value for name, value in aside.items() if name.lower() not in known}
    os.environ.update(foreign)  # not variables of JAX
    named = [
        f"{name}={shortened(value)}"
        for name, value in aside.items()
        if name not in foreign and not _agrees(known[name.lower()], value)
    ]
    _set_aside(named + [f"{name} = {value!r}" for name, value in changed.items()])
    _start_device(jax)


def use_compiled_loops() -> None:
    """Make XLA compile each loop into a single function on CPUs.

    This adds an option to XLA_FLAGS, which XLA reads when JAX computes for the first time in a
    process. If JAX has computed already, or if XLA_FLAGS contains extra options for the backend,
    leave it unchanged. XLA does not accept the option for a single compilation."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags and not _started():
        checked = flags.strip() in ("", os.environ.get(_CHECKED))
        flags = f"{flags} --xla_backend_extra_options={_LOOPS}=1000000000".strip()
        os.environ["XLA_FLAGS"] = flags
        if checked:
            os.environ[_CHECKED] = flags


def _started() -> bool:
    """Return whether JAX has started a backend, and XLA has therefore read XLA_FLAGS."""
    if "jax" not in sys.modules:
        return False
    try:
        from jax._src import xla_bridge  # JAX has no public function for this.

        return xla_bridge.backends_are_initialized()
    except (ImportError, AttributeError):
        return True


@contextlib.contextmanager
def explained() -> Iterator[None]:
    """Turn an out-of-memory error (Python or XLA) in the `with` block into an `InputError`."""
    try:
        yield
    except Exception as error:
        of_xla = type(error).__name__ in ("XlaRuntimeError", "JaxRuntimeError")
        if isinstance(error, MemoryError) or (of_xla and "RESOURCE_EXHAUSTED" in str(error)):
            raise InputError(
                "there is not enough memory for this run; free some, allow the process more, or "
                "ask for less (fewer points, speeds or starts)"
            ) from error
        raise


def _set_aside(named: list[str]) -> None:
    if named:
        say(
            f"ignored: {', '.join(named)}; commands compute with JAX's own defaults in double "
            "precision (unset the variable to remove this line)"
        )


def _agrees(setting: object, value: str) -> bool:
    """Return whether the text `value` of a variable means the same as the current JAX `setting`."""
    words = {
        **dict.fromkeys(("1", "t", "yes", "y", "on"), "true"),
        **dict.fromkeys(("0", "f", "no", "n", "off", ""), "false"),
    }
    said, force = value.strip().lower(), str(getattr(setting, "value", setting)).lower()
    return said == force or (isinstance(setting, bool) and words.get(said, said) == force)


def _require(config) -> dict[str, object]:
    """Apply the settings in `_REQUIRED` to `config`, the configuration object of JAX.

    Return the former value of each setting that was changed, by name, except double precision."""
    former = config.values  # lacks what is gone in this version of JAX
    wrong = {
        name: former[name]
        for name, needed in _REQUIRED.items()
        if name in former and getattr(former[name], "value", former[name]) != needed
    }
    for name in wrong:
        config.update(name, _REQUIRED[name])
    wrong.pop("jax_enable_x64", None)  # its default
    return wrong


def _start_device(jax) -> None:
    """Start the platform that JAX_PLATFORMS names, or the CPU if it is not set.

    Raises `InputError` if the platform does not start."""
    chosen = os.environ.get("JAX_PLATFORMS")
    before = jax.config.values.get("jax_platforms")
    jax.config.update("jax_platforms", "cpu" if chosen is None else chosen)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            backend = jax.default_backend()
        if backend != "cpu":
            (jax.numpy.ones(1, float) + 1).block_until_ready()
    except Exception as error:
        jax.config.update("jax_platforms", before)
        if chosen is None:
            raise InputError(f"JAX cannot start on the CPU: {_reason(error)}") from error
        reason = "JAX finds no such device" if not str(error) else _reason(error)
        raise InputError(
            f"environment variable JAX_PLATFORMS must name a platform that JAX can use here, but "
            f"is {shortened(chosen)}: {reason}; unset it to compute on the CPU"
        ) from error


def _reason(error: BaseException) -> str:
    """Return the message of a library's error as one line, without the advice in brackets."""
    text = re.sub(r"\s*\((?:set|you may need)\b[^)]*\)", "", str(error))
    text = " ".join(text.split()).rstrip(".")
    return text if len(text) <= 300 else f"{text[:297]}..."


def _check_flags(flags: str) -> None:
    """Test `flags`, the value of XLA_FLAGS, in a separate process.

    Raises `InputError` if XLA does not start with these flags, or if they can make results wrong.
    """
    if os.environ.get(_CHECKED) == flags:
        return
    advice = "correct the flag or unset XLA_FLAGS"
    shown = f"environment variable XLA_FLAGS is {shortened(flags, 120)}"
    if not flags.startswith("-"):
        raise InputError(f"{shown}, but must be flags that begin with --; {advice}")
    if unsound := _UNSOUND.search(flags):
        raise InputError(
            f"{shown}: {unsound[1]} assumes that neither NaN nor infinity occurs, and results may "
            f"be wrong without notice; {advice}"
        )
    if not sys.executable:
        return
    try:
        done = subprocess.run(
            [sys.executable, "-c", _TRIAL],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_TRIAL_SECONDS,
            env=os.environ | {"TF_CPP_MIN_LOG_LEVEL": "1"},
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise InputError(f"{shown}: XLA does not start with it; {advice}") from None
    except OSError:
        return  # No process could be started; the flags may be good.
    if done.returncode:
        raise InputError(f"{shown}: {_complaint(done.stderr.decode(errors='replace'))}; {advice}")
    os.environ[_CHECKED] = flags


def _complaint(log: str) -> str:
    """Return XLA's message about its flags.

    `log`: stderr of a process in which XLA did not start."""
    lines = [line for line in log.splitlines() if line.strip()]
    marked = [line for line in lines if re.match(r"^[EF]\d{4} ", line)]
    options = [line for line in lines if line.startswith("xla: ")]
    line = (marked or options or lines[-1:] or ["XLA does not start with it"])[0]
    return _reason(ValueError(_LOG_PREFIX.sub("", line)))


def check_precision() -> None:
    """Raise `RuntimeError` unless JAX is set to double precision."""
    import jax

    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "JAX computes in single precision here, but rootsopt needs double precision: call "
            'jax.config.update("jax_enable_x64", True) before anything else'
        )


_LIBRARIES = ("jax", "jaxlib", "diffrax", "optax", "equinox", "numpy")


def versions() -> dict[str, str]:
    """Return the versions of Python, this package and the libraries that affect its results."""
    return {
        "python": platform.python_version(),
        "rootsopt": rootsopt.__version__,
        **{name: importlib.metadata.version(name) for name in _LIBRARIES},
    }
