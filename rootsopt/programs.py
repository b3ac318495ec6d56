"""Compiled programs: made ahead and side by side, and kept between processes.

Tracing and compiling take longer than all else here. JAX's own cache keeps what has been
compiled, but every process still traces and lowers a function to find it there; a `Program`
finds it by name, source and kinds of arguments alone.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import platform
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
from jax.core import Tracer
from jax.experimental import serialize_executable

_PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "lineax", "optimistix")
_MOST_BYTES = 200 * 2**20
_SUFFIX = ".program"
_folder: Path | None = None
# Tracing is Python's work: in turn, the first asked for comes first to the compiler, which works
# side by side.
_tracing = threading.RLock()


def keep_in(folder: Path | None) -> None:
    """Keep programs in `folder` from now on; None keeps none. Whoever can write to the folder
    can run code here: it must be the user's own."""
    global _folder
    _folder = folder


class _Kind(NamedTuple):
    """What a program is compiled for: structure of the arguments, (shape, dtype) of arrays and
    None for other leaves, and those with their types."""

    tree: Any
    shapes: tuple[tuple[tuple[int, ...], str] | None, ...]
    others: tuple[tuple[type, Any], ...]


class _Made(NamedTuple):
    """A compiled program, called with the arrays alone, and its result with shapes for arrays."""

    call: Callable[..., Any]
    outline: Any


class Program:
    """A function of trees of arrays and other things, compiled once for each kind of arguments.

    As with `equinox.filter_jit` arrays are traced, and all else is static and must be hashable.
    """

    def __init__(self, function: Callable[..., Any]):
        functools.update_wrapper(self, function)
        self.function = function
        self._made: dict[_Kind, Future[_Made]] = {}
        self._lock = threading.Lock()

    def __call__(self, *args: Any) -> Any:
        """The function's result; compiled before unless that has happened."""
        leaves, kind = _split(args)
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return self.function(*args)
        future, new = self._future(kind)
        if new:
            self._make(future, kind)
        made = future.result()
        results = iter(made.call(*leaves))
        return jax.tree.map(lambda x: next(results) if _is_array(x) else x, made.outline)

    def prepare(self, *args: Any) -> None:
        """Compile for arguments like these, of which arrays may be `jax.ShapeDtypeStruct`, in
        the background. If that fails, so does the call that needs it."""
        _, kind = _split(args)
        future, new = self._future(kind)
        if new:
            threading.Thread(target=self._make, args=(future, kind)).start()

    def outline(self, *args: Any) -> Any:
        """The result with `jax.ShapeDtypeStruct` for arrays, known before it is compiled."""
        _, kind = _split(args)
        path = self._path(kind)
        kept = path is not None and path.exists()
        if kept:
            self.prepare(*args)
        future = self._made.get(kind)
        if future is not None and (kept or future.done()):
            return future.result().outline
        return jax.tree.map(_outline, eqx.filter_eval_shape(self.function, *args))

    def _future(self, kind: _Kind) -> tuple[Future[_Made], bool]:
        """The program of a kind to come, and whether it is now the caller's task to make it."""
        with self._lock:
            new = kind not in self._made
            return self._made.setdefault(kind, Future()), new

    def _make(self, future: Future[_Made], kind: _Kind) -> None:
        try:
            path = self._path(kind)
            future.set_result(_loaded(path) or self._compiled(kind, path))
        except BaseException as error:
            with self._lock:
                del self._made[kind]
            future.set_exception(error)

    def _compiled(self, kind: _Kind, path: Path | None) -> _Made:
        outlines = []

        def flat(*arrays):
            out = self.function(*_joined(kind, iter(arrays)))
            outlines.append(jax.tree.map(_outline, out))
            return [x for x in jax.tree.leaves(out) if _is_array(x)]

        flat.__name__ = flat.__qualname__ = self.function.__name__
        structs = [jax.ShapeDtypeStruct(s[0], np.dtype(s[1])) for s in kind.shapes if s]
        with _tracing:
            lowered = jax.jit(flat).lower(*structs)
        made = _Made(lowered.compile(), outlines[-1])
        if path is not None:
            # Not being able to keep a program is no reason not to use it.
            with contextlib.suppress(Exception):
                _save(path, made, len(structs))
        return made

    def _path(self, kind: _Kind) -> Path | None:
        """Where a program of this kind is kept, if it is."""
        if _folder is None or jax.default_backend() != "cpu":
            return None
        if jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
            return None  # What comes out of JAX's own cache cannot be kept a second time.
        name = f"{self.function.__module__}.{self.function.__qualname__}"
        words = [name, *map(repr, kind), *_surroundings()]
        if any(" at 0x" in word for word in words):
            return None  # Known by its address, which is another one next time.
        digest = hashlib.sha256("\n".join(words).encode()).hexdigest()
        return _folder / f"{self.function.__name__}-{digest[:32]}{_SUFFIX}"


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct)


def _outline(leaf: Any) -> Any:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) if _is_array(leaf) else leaf


def _split(args: tuple) -> tuple[list, _Kind]:
    """The arrays among the leaves of `args`, and what kind of arguments these are."""
    leaves, tree = jax.tree.flatten(args)
    shapes = tuple(
        (x.shape, str(jax.dtypes.canonicalize_dtype(x.dtype))) if _is_array(x) else None
        for x in leaves
    )
    others = tuple((type(x), x) for x in leaves if not _is_array(x))
    return [x for x in leaves if _is_array(x)], _Kind(tree, shapes, others)


def _joined(kind: _Kind, arrays: Iterator) -> tuple:
    """The reverse of `_split`."""
    others = iter(kind.others)
    leaves = [next(arrays) if shape else next(others)[1] for shape in kind.shapes]
    return jax.tree.unflatten(kind.tree, leaves)


def _save(path: Path, made: _Made, number: int) -> None:
    # A program that calls out (LAPACK, Python) relies on addresses set up when it is lowered.
    if "custom-call" in made.call.as_text():  # pyright: ignore[reportFunctionMemberAccess]
        return
    payload, _, _ = serialize_executable.serialize(made.call)  # pyright: ignore[reportArgumentType]
    data = zlib.compress(pickle.dumps((payload, number, made.outline)), 1)
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.write_bytes(data)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
    # Only our own files: the folder may be one that holds others.
    ours = path.parent.glob(f"*{_SUFFIX}")
    kept = sorted(ours, key=lambda other: other.stat().st_mtime, reverse=True)
    sizes = np.cumsum([other.stat().st_size for other in kept])
    for old, total in zip(kept, sizes, strict=True):
        if total > _MOST_BYTES:
            old.unlink(missing_ok=True)


def _loaded(path: Path | None) -> _Made | None:
    """A kept program, or None if there is none that works."""
    if path is None:
        return None
    try:
        payload, number, outline = pickle.loads(zlib.decompress(path.read_bytes()))
        os.utime(path)
        results = sum(map(_is_array, jax.tree.leaves(outline)))
        takes = jax.tree.structure(((0,) * number, {}))
        call = serialize_executable.deserialize_and_load(
            payload, takes, jax.tree.structure([0] * results)
        )
    except Exception:
        return None
    return _Made(call, outline)


@functools.cache
def _surroundings() -> tuple[str, ...]:
    """All that a compiled program depends on beside its function and kinds of arguments."""
    source = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        source.update(file.read_bytes())
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        processor = platform.processor()
    versions = [f"{name} {metadata.version(name)}" for name in _PACKAGES]
    settings = [os.environ.get("XLA_FLAGS", ""), str(jax.config.read("jax_enable_x64"))]
    return source.hexdigest(), platform.machine(), processor, *versions, *settings
