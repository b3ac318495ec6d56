"""Programs that are compiled before they are needed, in parallel, and cached between processes.

Tracing and compiling take longer than the computations themselves. JAX's own cache stores compiled
code, but every process must trace and lower a function before it can look up the code. A
`CachedFunction` looks it up by the function's name, the source code and the kind of its
arguments."""

import contextlib
import functools
import hashlib
import os
import pickle
import platform
import re
import sys
import threading
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import platformdirs
from jax.core import Tracer
from jax.experimental import serialize_executable

from rootsopt.config.families import outside_modules
from rootsopt.runtime.store import Store, UnsafeFolderError
from rootsopt.runtime.threads import trim, without_collection

_PACKAGES = (
    "jax",
    "jaxlib",
    "jaxtyping",
    "diffrax",
    "equinox",
    "lineax",
    "optimistix",
    "optax",
    "numpy",
)

# Names of the JAX settings that change what is traced or compiled.
_SETTINGS = (
    "jax_enable_x64",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_default_matmul_precision",
    "jax_random_seed_offset",
    "jax_default_prng_impl",
    "jax_enable_custom_prng",
    "jax_threefry_partitionable",
    "jax_softmax_custom_jvp",
    "jax_use_direct_linearize",
    "jax_disable_most_optimizations",
    "jax_optimization_level",
    "jax_exec_time_optimization_effort",
    "eager_constant_folding",
)
_VARIABLES = ("XLA_FLAGS", "EQX_ON_ERROR")
COMPILER_OPTIONS: dict[str, str | bool] = {
    "xla_disable_hlo_passes": (
        "while-loop-invariant-code-motion,while-loop-constant-sinking,simplify-while-loops"
    ),
    # JAX 0.11.2 refuses this option.
    **({"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}),
}
"""Compiler options on CPUs. They more than halve the compile time; programs run equally fast.

The first option turns off three passes over loops. XLA repeats these passes many times, because one
pass moves an operation out of only one of several nested loops. The second selects the older code
generator for fused operations.

>>> import jax
>>> import rootsopt
>>> half = jax.jit(lambda x: x / 2, compiler_options=rootsopt.COMPILER_OPTIONS)
>>> float(half(3.0))
1.5
"""
_PACKAGE = Path(__file__).parents[1]

# Parts of this package on which any program may depend, in addition to the module that defines it.
_INNER = (
    *("config", "contact", "dynamics", "profiles", "pump", "response", "runtime", "scene"),
    *("errors.py", "status.py"),
)

# Pattern of docstrings and comments. Its groups match other strings, which stay.
_WORDS = re.compile(
    rb"""^[ \t]*[rR]?\"{3}(?:\\.|(?!\"{3})[^\\])*\"{3}[ \t]*$"""
    rb"""|(\"{3}(?:\\.|[^\\])*?\"{3}|'{3}(?:\\.|[^\\])*?'{3})"""
    rb"""|("(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')|[ \t]*#[^\n]*""",
    re.DOTALL | re.MULTILINE,
)

_store: Store | None = None

# Whether the cache's folder has been chosen, or the cache turned off. If not, the first program
# chooses the default folder.
_chosen = False
# Tracing runs in Python, so it is done one function at a time, in the order of requests. The
# compiler then works in parallel.
_tracing = threading.RLock()


def keep_in(folder: Path | None) -> str | None:
    """Cache programs in `folder` from now on, or turn the cache off if `folder` is `None`.

    If other users could replace the programs in the folder, turn the cache off and return the
    reason. Otherwise return `None`. If the folder cannot be used for another reason, the cache is
    off as well."""
    global _store, _chosen
    store, reason = None, None
    try:
        store = None if folder is None else Store(folder)
    except UnsafeFolderError as error:
        reason = str(error)
    except OSError:
        pass
    _store, _chosen = store, True
    return reason


def keep_by_default() -> str | None:
    """Cache programs in the user's cache folder from now on; return as `keep_in`.

    The environment variable ROOTSOPT_CACHE may name another folder, or turn the cache off ("off",
    "0" or "no")."""
    choice = os.environ.get("ROOTSOPT_CACHE", "")
    if choice.lower() in ("off", "0", "no"):
        return keep_in(None)
    return keep_in(Path(choice or platformdirs.user_cache_dir("rootsopt", appauthor=False)))


class _Kind(NamedTuple):
    """Kind of arguments for which a program is compiled: everything except the values of arrays.

    `tree`: structure of the arguments; `shapes`: one entry per leaf, (shape, dtype) for an array
    and `None` for any other leaf; `others`: (type, value) of each leaf that is not an array."""

    tree: Any
    shapes: tuple[tuple[tuple[int, ...], str] | None, ...]
    others: tuple[tuple[type, Any], ...]


class _Made(NamedTuple):
    """A compiled program.

    `call`: function that takes the arrays among the arguments and returns those of the result;
    `result_shape`: the result with `jax.ShapeDtypeStruct` in place of arrays."""

    call: Callable[..., Any]
    result_shape: Any

    def result(self, leaves: list) -> Any:
        """Return the result for the arrays among the arguments."""
        arrays = iter(self.call(*leaves))
        return jax.tree.map(lambda x: next(arrays) if _is_array(x) else x, self.result_shape)


class CachedFunction:
    """A function whose arguments are JAX pytrees, compiled once for each kind of arguments.

    As with `equinox.filter_jit`, arrays are traced. All other leaves are static and must be
    hashable: with new values, the function is compiled again."""

    def __init__(self, function: Callable[..., Any]):
        functools.update_wrapper(self, function)
        self.function = function
        self._made: dict[_Kind, Future[_Made]] = {}
        self._lock = threading.Lock()

    def __call__(self, *args: Any) -> Any:
        """Return the function's result for `args`; compile the function first if necessary."""
        leaves, kind = _split(args)
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return self.function(*args)
        future, new = self._future(kind)
        if new:
            self._make(future, kind)
        return future.result().result(leaves)

    def prepare(self, *args: Any, then: Callable[[Any], None] | None = None) -> None:
        """Compile the function in the background for arguments of the same kind as `args`.

        In `args`, `jax.ShapeDtypeStruct` may replace an array. If compilation fails, the call that
        needs the program raises the error.

        `then` is called in the background with `result_shape(*args)` as soon as the function has
        been traced, before it is compiled. It can prepare programs that take the result. It is not
        called if the program has been requested before, and its errors are ignored."""
        _, kind = _split(args)
        future, new = self._future(kind)
        if new:
            threading.Thread(target=self._make, args=(future, kind, then)).start()

    def result_shape(self, *args: Any) -> Any:
        """Return the result for `args` with `jax.ShapeDtypeStruct` in place of arrays.

        The function is not run. If its program is in the cache, the program is loaded; otherwise,
        the function is only traced."""
        _, kind = _split(args)
        place = self._place(kind)
        kept = place is not None and place.name in place.store
        if kept:
            self.prepare(*args)
        future = self._made.get(kind)
        if future is not None and (kept or future.done()):
            return future.result().result_shape
        return jax.tree.map(_outline, eqx.filter_eval_shape(self.function, *args))

    def _future(self, kind: _Kind) -> tuple[Future[_Made], bool]:
        """Return (future of the program for this `kind`, whether the caller must compile it)."""
        with self._lock:
            new = kind not in self._made
            return self._made.setdefault(kind, Future()), new

    def _make(
        self, future: Future[_Made], kind: _Kind, then: Callable[[Any], None] | None = None
    ) -> None:
        def outlined(result_shape: Any) -> None:
            if then is not None:
                with contextlib.suppress(Exception):
                    then(result_shape)

        try:
            place = self._place(kind)
            made = _loaded(place)
            if made is None:
                future.set_result(self._compiled(kind, place, outlined))
            else:
                future.set_result(made)
                outlined(made.result_shape)
        except BaseException as error:
            with self._lock:
                del self._made[kind]
            future.set_exception(error)

    def _compiled(
        self, kind: _Kind, place: "_Place | None", outlined: Callable[[Any], None]
    ) -> _Made:
        outlines = []

        def flat(*arrays):
            out = self.function(*_joined(kind, iter(arrays)))
            outlines.append(jax.tree.map(_outline, out))
            return [x for x in jax.tree.leaves(out) if _is_array(x)]

        flat.__name__ = flat.__qualname__ = self.function.__name__
        structs = [jax.ShapeDtypeStruct(s[0], np.dtype(s[1])) for s in kind.shapes if s]
        with _tracing, without_collection():
            lowered = jax.jit(flat).lower(*structs)
        outlined(outlines[-1])
        made = _Made(_finished(lowered), outlines[-1])
        if place is not None:
            # A program that cannot be cached can still be used.
            with contextlib.suppress(Exception):
                _save(place, made, len(structs))
        del lowered
        trim()
        return made

    def _place(self, kind: _Kind) -> "_Place | None":
        """Return the cache entry for a program of this `kind`, or `None` if it cannot be cached."""
        if not _chosen:
            keep_by_default()
        # A program loaded from JAX's own cache cannot be serialised again.
        theirs = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
        if _store is None or theirs or jax.default_backend() != "cpu":
            return None
        sources = _sources({self.function.__module__, *_modules(kind), *outside_modules()})
        if sources is None:
            return None
        name = f"{self.function.__module__}.{self.function.__qualname__}"
        words = [name, *map(repr, kind), *sources, *_machine(), *_versions(), *_settings()]
        if any(" at 0x" in word for word in words):
            return None  # The text contains a memory address, which differs in the next process.
        purpose = hashlib.sha256("\0".join(words).encode()).hexdigest()
        return _Place(_store, f"{self.function.__name__}-{purpose[:32]}", purpose)


class _Place(NamedTuple):
    """An entry of the cache.

    `store`: the cache; `name`: name of the entry; `purpose`: digest of everything on which the
    program depends."""

    store: Store
    name: str
    purpose: str


_ARRAYS = jax.Array, np.ndarray, np.generic, jax.ShapeDtypeStruct


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, _ARRAYS)


def _outline(leaf: Any) -> Any:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) if _is_array(leaf) else leaf


def _split(args: tuple) -> tuple[list, _Kind]:
    """Return (list of the arrays in `args`, kind of `args`)."""
    leaves, tree = jax.tree.flatten(args)
    wide = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    shapes = tuple((x.shape, _precision(x.dtype, wide)) if _is_array(x) else None for x in leaves)
    others = tuple((type(x), x) for x in leaves if not _is_array(x))
    return [x for x in leaves if _is_array(x)], _Kind(tree, shapes, others)


@functools.cache
def _precision(dtype: Any, wide: bool) -> str:
    """Return the name of the type that JAX uses for `dtype`; `wide`: whether it allows 64 bits."""
    return str(jax.dtypes.canonicalize_dtype(dtype))


def _finished(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compile a lowered program with the `COMPILER_OPTIONS`.

    Options that are set in XLA_FLAGS are left out. If compilation fails, for example because the
    compiler does not know an option, compile without options."""
    said = os.environ.get("XLA_FLAGS", "")
    options = {name: value for name, value in COMPILER_OPTIONS.items() if name not in said}
    if options and jax.default_backend() == "cpu":
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            return lowered.compile(compiler_options=options)
    return lowered.compile()


def _joined(kind: _Kind, arrays: Iterator) -> tuple:
    """Return the arguments with this `kind` and these `arrays`, as the inverse of `_split`."""
    others = iter(kind.others)
    leaves = [next(arrays) if shape else next(others)[1] for shape in kind.shapes]
    return jax.tree.unflatten(kind.tree, leaves)


def _save(place: _Place, made: _Made, number: int) -> None:
    """Write a program to the cache; `number`: how many arrays it takes."""
    # A program that calls out (LAPACK, Python) relies on addresses set up when it is lowered.
    if "custom-call" not in made.call.as_text():  # pyright: ignore[reportFunctionMemberAccess]
        payload = serialize_executable.serialize(made.call)[0]  # pyright: ignore[reportArgumentType]
        data = zlib.compress(pickle.dumps((payload, number, made.result_shape)), 1)
        place.store.write(place.name, place.purpose, data)


def _loaded(place: _Place | None) -> _Made | None:
    """Return the cached program at `place`, or `None` if no program can be loaded from it."""
    if place is None:
        return None
    try:
        data = place.store.read(place.name, place.purpose)
        if data is None:
            return None
        payload, number, result_shape = pickle.loads(zlib.decompress(data))
        results = sum(map(_is_array, jax.tree.leaves(result_shape)))
        takes = jax.tree.structure(((0,) * number, {}))
        call = serialize_executable.deserialize_and_load(
            payload, takes, jax.tree.structure([0] * results)
        )
    except Exception:
        return None
    return _Made(call, result_shape)


def _modules(kind: _Kind) -> set[str]:
    """Return the names of the modules that define the types of the arguments of this `kind`."""
    modules = {of.__module__ for of, _ in kind.others}
    trees = [kind.tree]
    while trees:
        tree = trees.pop()
        if (data := tree.node_data()) is not None:
            modules.add(data[0].__module__)
        trees.extend(tree.children())
    return modules


def _sources(modules: set[str]) -> list[str] | None:
    """Return digests of the source files on which a program depends.

    These are the parts of this package in `_INNER` and those of `modules`, and the files of other
    `modules`. Modules of Python, and of packages with a known version, are left out. Return `None`
    if a file is missing."""
    own, places = __name__.partition(".")[0], {_PACKAGE / part for part in _INNER}
    for name in modules:
        top, *parts = name.split(".")
        if top == own:
            place = _PACKAGE.joinpath(*parts[:1])
            places.add(place if place.is_dir() else place.with_suffix(".py"))
        elif top not in _PACKAGES and top not in sys.stdlib_module_names:
            file = getattr(sys.modules.get(name), "__file__", None)
            if file is None:
                return None
            places.add(Path(file))
    try:
        states = {place: place.stat() for place in sorted(places)}
        return [f"{x.name} {_digest(x, at.st_mtime_ns, at.st_size)}" for x, at in states.items()]
    except OSError:
        return None


@functools.lru_cache(maxsize=4096)
def _digest(place: Path, *state: int) -> str:
    """Return a digest of a source file, or of all in a folder, without comments and docstrings.

    `state`: numbers that differ after a change of the file."""
    digest = hashlib.sha256()
    for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
        text = _WORDS.sub(lambda match: match[1] or match[2] or b"", file.read_bytes())
        digest.update(file.name.encode() + b"\0")
        digest.update(re.sub(rb"\n(?:[ \t]*\n)+", b"\n", text).strip())
    return digest.hexdigest()


@functools.cache
def _machine() -> list[str]:
    """Return a description of the processor and its instruction set."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", errors="replace").splitlines()
        processor = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        processor = platform.processor()
    return [platform.system(), platform.machine(), processor]


@functools.cache
def _versions() -> list[str]:
    """Return the versions of Python and of all libraries that trace or compile programs."""
    packages = [f"{name} {metadata.version(name)}" for name in _PACKAGES]
    return [platform.python_implementation(), platform.python_version(), *packages]


def _settings() -> list[str]:
    """Return the current values of the settings that change what is traced or compiled."""
    variables = [f"{name}={os.environ.get(name, '')}" for name in _VARIABLES]
    variables.append(f"{sorted(COMPILER_OPTIONS.items())}")
    return variables + [f"{name}={getattr(jax.config, name, None)}" for name in _SETTINGS]
