"""Memory of closed orbits, from which the orbits of neighbouring designs and scenes are closed."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from rootsopt.dynamics.closed import Start, closed_motion
from rootsopt.dynamics.collocation.known import Known, trimmed
from rootsopt.dynamics.collocation.mesh import sizes
from rootsopt.dynamics.collocation.sampled import sampled
from rootsopt.dynamics.collocation.seed import from_steps
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import Steady, continues
from rootsopt.profiles.geometry import Geometry
from rootsopt.runtime.programs import Program
from rootsopt.scene import Scene
from rootsopt.status import Status

_MOST = 4096
"""Number of orbits above which the least recently used one is forgotten."""
_INDICES = 2
"""Greatest number of indices before the state in a row of the argument `start` (scene, speed)."""
_SAME = 1e-4
"""Relative difference between the forces of an orbit closed by shooting and those of the same orbit
closed by collocation, above which the latter is not used."""


class Built(NamedTuple):
    """A `design` (config units) in a `scene`, and their rotor pair."""

    scene: Scene
    design: Any
    pair: RotorPair

    @property
    def continues(self) -> bool:
        """Whether the orbit of the pair can be closed from that of a similar pair."""
        return continues(self.pair, self.scene.solver)


class Near(NamedTuple):
    """A pair, and its motion near the orbit of a similar pair.

    `pair`; `shape`: geometry of its rotors; `found`: the motion."""

    pair: RotorPair
    shape: Geometry
    found: Steady


class _Closed(NamedTuple):
    """An orbit as it was closed.

    `state`: scaled, at φ1 = 0; `period` (mesh periods); `forces` (3,): mean (N), mean square (N²)
    and peak (N); `steps`: ends of the solver's steps (mesh periods) and the scaled states there, if
    the orbit was closed by shooting; `known`: the orbit, if it was closed by collocation.
    """

    state: NDArray[np.float64]
    period: int
    forces: NDArray[np.float64]
    steps: tuple[NDArray[np.float64], NDArray[np.float64]] | None
    known: Known | None

    @classmethod
    def of(cls, found: Steady) -> "_Closed":
        """Return the orbit of a periodic motion."""
        orbit, period = found.orbit, int(found.period)
        first = np.asarray(orbit.state), period, np.asarray(orbit.response[:3])
        if bool(found.collocated):
            known = found.known
            assert known is not None
            return cls(*first, None, trimmed(known, period) if bool(known.sound) else None)
        grid, corners = np.asarray(orbit.flow.grid), np.asarray(orbit.flow.corners)
        # Few sizes of these arrays, so that few programs are compiled.
        room = 512
        while room < min(np.sum(np.isfinite(grid)), len(grid)):
            room *= 2
        return cls(*first, (grid[:room].copy(), corners[:room].copy()), None)


class _Recipe(NamedTuple):
    """How to compute an orbit: the evaluation `again`, which begins on the orbits `parents`."""

    again: Callable[[], Any]
    parents: tuple[bytes, ...]


class OrbitStore:
    """Closed orbits, found again by their state at φ1 = 0.

    An evaluation passes on the state of its orbit as `start` for neighbouring evaluations. With
    this state, they find the whole orbit here. An orbit that was closed by shooting is closed by
    collocation when a neighbour asks for it. Threads can share an instance.
    """

    def __init__(self) -> None:
        self._found: OrderedDict[bytes, tuple[_Closed, Built] | _Recipe] = OrderedDict()
        self._known: dict[bytes, Known | None] = {}
        self._lock = threading.RLock()

    def __len__(self) -> int:
        return len(self._found)

    def __getstate__(self) -> tuple[Any, Any]:
        with self._lock:
            found = {k: v for k, v in self._found.items() if not isinstance(v, _Recipe)}
            return found, dict(self._known)

    def __setstate__(self, state: tuple[Any, Any]) -> None:
        self._found, self._known = OrderedDict(state[0]), state[1]
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
                    if key in self._known:
                        found._known[key] = self._known[key]
        return found

    def add(self, other: "OrbitStore") -> None:
        """Remember the orbits of another store as well."""
        found, known = other.__getstate__()
        with self._lock:
            for key, entry in found.items():
                if key not in self._found or isinstance(self._found[key], _Recipe):
                    self._keep(key, entry)
            self._known |= {key: one for key, one in known.items() if key in self._found}

    def near(self, scene: Scene, design: Any, state: NDArray[np.float64] | None) -> Near | None:
        """Return the pair of a design (config units), and its motion near a known orbit.

        `state`: scaled state of this orbit at φ1 = 0. The result is `None` if there is no such
        orbit, or if the motion is not accepted. The orbit of the motion lacks what `with_samples`
        adds."""
        known = self.begin(state)
        if known is None or jax.tree.structure(known[1].scene) != jax.tree.structure(scene):
            return None
        got = Near(*_near(scene, design, known[0], known[1].pair))
        return got if Status.of(got.found.status) is Status.PERIODIC else None

    def begin(self, state: NDArray[np.float64] | None) -> tuple[Known, Built] | None:
        """Return the orbit with this scaled `state` at φ1 = 0, and its design, scene and pair.

        The result is `None` if no such orbit is known, or if collocation cannot close it."""
        if state is None:
            return None
        key = _key(state)
        with self._lock:
            found = self._recalled(key)
            known = None if found is None else self._adopted(key, *found)
        return None if found is None or known is None else (known, found[1])

    def keep(self, found: Steady, built: Built) -> None:
        """Remember the orbit of the motion `found` of `built`, if it is periodic.

        `built` must be such that `Built.continues`."""
        if Status.of(found.status) is Status.PERIODIC:
            self._keep(_key(found.orbit.state), (_Closed.of(found), built))

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
            self._known.pop(key, None)
            while len(self._found) > _MOST:
                self._known.pop(self._found.popitem(last=False)[0], None)

    def _recalled(self, key: bytes) -> tuple[_Closed, Built] | None:
        """Return the orbit stored under `key`, and its pair."""
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

    def _adopted(self, key: bytes, found: _Closed, built: Built) -> Known | None:
        """Return the orbit `found` of `built` as one closed by collocation, or `None`."""
        if key not in self._known:
            self._known[key] = _adopted(found, built)
        return self._known[key]


def _adopted(found: _Closed, built: Built) -> Known | None:
    """Return the orbit `found` of `built` as one closed by collocation.

    The result is `None` if it cannot be closed, or if the forces of both orbits differ."""
    if found.steps is None:
        return found.known
    period = np.asarray(found.period)
    start = _seed(built.pair, found.state, found.steps, period, found.period)
    motion = _near(built.scene, built.design, start, built.pair)[-1]
    if motion.known is None or Status.of(motion.status) is not Status.PERIODIC:
        return None
    forces = np.asarray(motion.orbit.response[:3])
    same = np.abs(forces - found.forces) <= _SAME * np.abs(found.forces)
    return trimmed(motion.known, found.period) if np.all(same) else None


def with_samples(found: Steady, samples: int) -> Steady:
    """Return the motion `found`, and add to its orbit what a motion near a known orbit lacks.

    These are the steps, and a number of `samples` of the state."""
    assert found.known is not None
    flow = _sampled(found.orbit.flow, found.known.elements, samples)
    return found._replace(orbit=found.orbit._replace(flow=flow))


def _motion_near(scene: Scene, design: Any, known: Known, neighbour: RotorPair):
    """Return the pair of a design, the geometry of its rotors, and its motion.

    The motion is that near the `known` orbit of the pair `neighbour`."""
    pair, tangents, shape = scene.pair_and_tangents(design)
    numbers = eqx.filter(neighbour, eqx.is_inexact_array)
    start = Start(pair.in_si(jnp.zeros(pair.states)), known, numbers)
    radius, solver = scene.pitch_radius, scene.solver
    return pair, shape, closed_motion(pair, tangents, start, radius, solver, near_only=True)


def prepare_near(built: Built) -> None:
    """Compile the programs for orbits of one mesh period in the background.

    In `built`, `jax.ShapeDtypeStruct` may replace arrays."""
    known = Known.empty(sizes(1), built.pair.states, 1 + built.pair.two_sided)
    _near.prepare(built.scene, built.design, known, built.pair)


def _rows(start: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return what may be scaled states in the argument `start` of an evaluation.

    In that of several motions, indices of parts precede the state in each row. All readings are
    returned; only those of known orbits count."""
    rows = np.atleast_2d(np.asarray(start, np.float64))
    return [row[first:] for row in rows for first in range(min(_INDICES + 1, rows.shape[1]))]


def _key(state) -> bytes:
    return np.ascontiguousarray(state, np.float64).tobytes()


_near = Program(_motion_near, gathered=1)
_sampled = Program(sampled, gathered=0)
_seed = Program(from_steps, gathered=0)

__all__ = ["Built", "Near", "OrbitStore", "prepare_near", "with_samples"]
