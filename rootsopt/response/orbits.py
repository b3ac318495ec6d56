"""Memory of closed orbits, from which the orbits of neighbouring designs and scenes are closed."""

import threading
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from rootsopt.dynamics.collocation.nearby import Known, trimmed
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import Steady
from rootsopt.status import Status

_MOST = 512
"""Number of orbits above which the least recently used one is forgotten."""


class OrbitStore:
    """Orbits closed by collocation, found again by their state at φ1 = 0.

    An evaluation passes on the state of its orbit as `start` for neighbouring evaluations. With
    this state, they find the whole orbit here. Threads can share an instance. Results do not depend
    on it: an orbit that is not stored is closed from its state, which takes longer.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[bytes, tuple[Known, RotorPair]] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._known)

    def __getstate__(self) -> OrderedDict[bytes, tuple[Known, RotorPair]]:
        with self._lock:
            return self._known.copy()

    def __setstate__(self, known: OrderedDict[bytes, tuple[Known, RotorPair]]) -> None:
        self._known, self._lock = known, threading.Lock()

    def part(self, start: NDArray[np.float64] | None) -> "OrbitStore":
        """Return another store, with the orbits that begin at the states in `start`.

        `start`: as in `Evaluates.__call__`: a state (n,), or rows that end with a state, behind
        the indices of the part that it belongs to."""
        found = OrbitStore()
        for row in () if start is None else np.atleast_2d(start):
            for first in range(len(row)):
                known = self.near(row[first:])
                if known is not None:
                    found._known[_key(row[first:])] = known
                    break
        return found

    def add(self, other: "OrbitStore") -> None:
        """Remember the orbits of another store as well."""
        for key, one in other.__getstate__().items():
            self._keep(key, one)

    def near(self, state: NDArray[np.float64] | None) -> tuple[Known, RotorPair] | None:
        """Return the orbit with this scaled `state` (n,) at φ1 = 0, and its pair.

        The result is `None` if no such orbit is known."""
        if state is None:
            return None
        with self._lock:
            found = self._known.get(_key(state))
            if found is not None:
                self._known.move_to_end(_key(state))
        return found

    def keep(self, found: Steady, pair: RotorPair) -> None:
        """Remember the orbit of the motion `found` of `pair`, if it was closed by collocation."""
        if found.known is None or Status.of(found.status) is not Status.PERIODIC:
            return
        if bool(found.collocated):
            state = np.asarray(found.orbit.state)
            self.store(state, found.known, int(found.period), pair)

    def store(self, state: NDArray[np.float64], known: Known, period: int, pair: RotorPair) -> None:
        """Remember the orbit `known` of a `pair`, with `period` mesh periods, if it is sound.

        `state` (n,): its scaled state at φ1 = 0."""
        cut = trimmed(known, period) if bool(known.sound) else None
        if cut is None:
            return
        self._keep(_key(state), (cut, pair))

    def _keep(self, key: bytes, one: tuple[Known, RotorPair]) -> None:
        with self._lock:
            self._known[key] = one
            while len(self._known) > _MOST:
                self._known.popitem(last=False)


def _key(state) -> bytes:
    return np.ascontiguousarray(state, np.float64).tobytes()


__all__ = ["OrbitStore"]
