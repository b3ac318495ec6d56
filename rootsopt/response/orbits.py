"""Memory of closed orbits, from which the orbits of neighbouring designs and scenes are closed."""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from rootsopt.dynamics.closed import Start
from rootsopt.dynamics.collocation.known import Known, padded, trimmed
from rootsopt.dynamics.collocation.mesh import sizes
from rootsopt.dynamics.collocation.sampled import sampled
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import Steady
from rootsopt.runtime.programs import Program
from rootsopt.status import Status

_MOST = 4096
"""Number of orbits above which the least recently used one is forgotten."""
_INDICES = 2
"""Greatest number of indices before the state in a row of the argument `start` (scene, speed)."""


class _Recipe(NamedTuple):
    """How to compute an orbit: the evaluation `again`, which begins on the orbits `parents`."""

    again: Callable[[], Any]
    parents: tuple[bytes, ...]


class OrbitStore:
    """Closed orbits, found again by their state at φ1 = 0.

    An evaluation passes on the state of its orbit as `start` for neighbouring evaluations. With
    this state, they find the whole orbit here. Threads can share an instance.
    """

    def __init__(self) -> None:
        self._found: OrderedDict[bytes, Start | _Recipe] = OrderedDict()
        self._lock = threading.RLock()

    def __len__(self) -> int:
        return len(self._found)

    def __getstate__(self) -> Any:
        with self._lock:
            return {k: v for k, v in self._found.items() if not isinstance(v, _Recipe)}

    def __setstate__(self, state: Any) -> None:
        self._found = OrderedDict(state)
        self._lock = threading.RLock()

    def part(self, start: NDArray[np.float64] | None) -> "OrbitStore":
        """Return another store, with the orbits that begin at the states in `start`.

        `start`: as in `Evaluates.__call__`."""
        found = OrbitStore()
        for row in () if start is None else _rows(start):
            key = _key(row)
            with self._lock:
                entry = self._recalled(key)
                if entry is not None:
                    found._found[key] = entry
        return found

    def add(self, other: "OrbitStore") -> None:
        """Remember the orbits of another store as well."""
        with self._lock:
            for key, entry in other.__getstate__().items():
                if key not in self._found or isinstance(self._found[key], _Recipe):
                    self._keep(key, entry)

    def start(self, pair: RotorPair, state: NDArray[np.float64] | None, longest: int) -> Start:
        """Return where the search for an orbit of `pair` begins, in arrays of NumPy.

        `state`: scaled, at φ1 = 0; `None`: at rest. If it is that of a known orbit, the search
        begins on this orbit. `longest`: longest period of an orbit (mesh periods). Unlike
        elsewhere, the state of the result is scaled."""
        dtype, room = pair.angle_scale.dtype, sizes(longest)
        given = np.zeros(pair.states, dtype) if state is None else np.asarray(state, dtype)
        empty = _empty(room, pair.states, 1 + pair.two_sided)
        nothing = Start(given, empty, _numbers(pair))
        if state is None:
            return nothing
        with self._lock:
            kept = self._recalled(_key(state))
        if kept is None or kept.known.elements.mesh.used >= room[0]:
            return nothing
        found = Start(nothing.state, padded(kept.known, room), kept.pair)
        return found if found.fits(nothing) else nothing

    def keep(self, found: Steady, pair: RotorPair) -> None:
        """Remember the orbit of the motion `found` of `pair`, if it is periodic.

        Orbits that were closed by shooting are not remembered."""
        if Status.of(found.status) is Status.PERIODIC and found.known is not None:
            state = np.asarray(found.orbit.state)
            self._keep(_key(state), Start(state, trimmed(found.known), _numbers(pair)))

    def recall(
        self,
        states: Iterable[NDArray[np.float64]],
        again: Callable[[], Any],
        start: NDArray[np.float64] | None,
    ) -> None:
        """Remember how to compute orbits that have these scaled `states` at φ1 = 0.

        `again` is called if a neighbour asks for one of them. It must compute these very orbits,
        with an evaluator that uses this memory. `start`: argument `start` of that evaluation."""
        recipe = _Recipe(again, () if start is None else tuple(map(_key, _rows(start))))
        for state in states:
            self._keep(_key(state), recipe)

    def _keep(self, key: bytes, entry: Any) -> None:
        with self._lock:
            self._found[key] = entry
            self._found.move_to_end(key)
            while len(self._found) > _MOST:
                self._found.popitem(last=False)

    def _recalled(self, key: bytes) -> Start | None:
        """Return the orbit stored under `key`."""
        # The orbits from which these orbits were closed come first. A loop, because there may be
        # hundreds.
        waiting = [key]
        while waiting:
            found = self._found.get(waiting[-1])
            if not isinstance(found, _Recipe):
                waiting.pop()
                continue
            before = [k for k in found.parents if isinstance(self._found.get(k), _Recipe)]
            if before and before[0] not in waiting:
                waiting.append(before[0])
                continue
            del self._found[waiting.pop()]
            found.again()
        found = self._found.get(key)
        if found is None or isinstance(found, _Recipe):
            return None
        self._found.move_to_end(key)
        return found


def _numbers(pair: RotorPair) -> RotorPair:
    """Return the numbers of `pair` in arrays of NumPy, with `None` in place of all other leaves."""
    return jax.tree.map(np.asarray, eqx.filter(pair, eqx.is_inexact_array))


@functools.cache
def _empty(room: tuple[int, int], states: int, sides: int) -> Known:
    """Return the placeholder `Known.empty` in arrays of NumPy."""
    return jax.tree.map(np.asarray, Known.empty(room, states, sides))


def with_samples(found: Steady, samples: int) -> Steady:
    """Return the motion `found`, and add to its orbit what a motion near a known orbit lacks.

    These are the steps, and a number of `samples` of the state."""
    assert found.known is not None
    flow = _sampled(found.orbit.flow, found.known.elements, samples)
    return found._replace(orbit=found.orbit._replace(flow=flow))


def prepare_samples(found: Steady, samples: int) -> Steady:
    """Compile the program of `with_samples` in the background, and return the shape of its result.

    In `found`, `jax.ShapeDtypeStruct` replaces arrays."""
    assert found.known is not None
    _sampled.prepare(found.orbit.flow, found.known.elements, samples)
    flow = _sampled.result_shape(found.orbit.flow, found.known.elements, samples)
    return found._replace(orbit=found.orbit._replace(flow=flow))


def _rows(start: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return what may be scaled states in the argument `start` of an evaluation.

    In that of several motions, indices of parts precede the state in each row. All readings are
    returned; only those of known orbits count."""
    rows = np.atleast_2d(np.asarray(start, np.float64))
    return [row[first:] for row in rows for first in range(min(_INDICES + 1, rows.shape[1]))]


def _key(state) -> bytes:
    return np.ascontiguousarray(state, np.float64).tobytes()


_sampled = Program(sampled, gathered=0)

__all__ = ["OrbitStore", "prepare_samples", "with_samples"]
