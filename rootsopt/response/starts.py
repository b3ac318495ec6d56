"""Where an evaluation begins: on the closed orbit of a similar design or scene, or at a state."""

import base64
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.dynamics.closed import Start
from rootsopt.dynamics.collocation.known import KnownOrbit, padded, trimmed
from rootsopt.dynamics.collocation.mesh import room_for
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import Steady
from rootsopt.status import Status

# Types of numbers in an orbit.
_KINDS = ("float64", "int64", "bool")


class Seed(NamedTuple):
    """Where an evaluation of a similar design or scene begins.

    `state` (n,): scaled, at φ1 = 0; `orbit`: the closed orbit through it, as the arrays of a
    `KnownOrbit` (see `collocation.known.trimmed`), then those of its pair. It is empty if the orbit
    is not known.
    """

    state: NDArray[np.float64]
    orbit: tuple[NDArray[Any], ...] = ()

    @classmethod
    def of(cls, found: Steady, pair: RotorPair) -> "Seed":
        """Return a seed on the motion `found` of `pair`.

        Only a periodic orbit is part of it."""
        state = np.asarray(found.orbit.state, np.float64)
        if Status.of(found.status) is not Status.PERIODIC:
            return cls(state)
        return cls(state, tuple(jax.tree.leaves((trimmed(found.known), _numbers(pair)))))


Seeds = Seed | NDArray[np.float64] | tuple[Any, ...] | None
"""Type of the argument `start` of an evaluator: a seed or a scaled state (n,) for one motion; one
entry for each part (speed, sample, coexisting motion) for several motions; `None` for rest."""


def begun(pair: RotorPair, start: Seed | ArrayLike | None, longest: int) -> Start:
    """Return where the search for an orbit of `pair` begins, in arrays of NumPy.

    `start`: a seed, or a scaled state (n,) at φ1 = 0; `None`: at rest. An orbit that does not
    belong to a pair of this kind is not used; the search then begins at its state. `longest`:
    longest period of an orbit (mesh periods). Unlike elsewhere, the state of the result is scaled.
    """
    dtype, room = pair.angle_scale.dtype, room_for(pair, longest)
    seed = start if isinstance(start, Seed) else None
    state = start if seed is None else seed.state
    given = np.zeros(pair.states, dtype) if state is None else np.asarray(state, dtype)
    empty = KnownOrbit.empty(room, pair.states, pair.flanks)
    nothing = Start(given, empty, _numbers(pair))
    leaves, kind = jax.tree.flatten((empty, nothing.pair))
    if seed is None or len(seed.orbit) != len(leaves):
        return nothing
    known, numbers = jax.tree.unflatten(kind, seed.orbit)
    if known.elements.mesh.used >= room[0]:
        return nothing
    found = Start(given, padded(known, room), numbers)
    return found if found.fits(nothing) else nothing


def plain(start: Seeds) -> Any:
    """Return a `start` as plain values for JSON, exact to the last bit."""
    if isinstance(start, Seed):
        return {"state": start.state.tolist(), "orbit": [_plain(one) for one in start.orbit]}
    if start is None or isinstance(start, np.ndarray):
        return None if start is None else start.tolist()
    return {"parts": [plain(one) for one in start]}


def read(value: Any) -> Seeds:
    """Return the start from the plain value that `plain` returned.

    Raises `ValueError`, `LookupError` or `TypeError` if it is none."""
    if not isinstance(value, dict):
        return None if value is None else np.asarray(value, np.float64)
    if "parts" in value:
        return tuple(read(one) for one in value["parts"])
    orbit = tuple(_read(*one) for one in value["orbit"])
    return Seed(np.asarray(value["state"], np.float64), orbit)


def _plain(array: NDArray[Any]) -> list[Any]:
    data = base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
    return [array.dtype.name, [*array.shape], data]


def _read(kind: str, shape: list[int], data: str) -> NDArray[Any]:
    if kind not in _KINDS:
        raise ValueError(f"an orbit has no numbers of type {kind}")
    return np.frombuffer(base64.b64decode(data, validate=True), kind).reshape(shape)


def _numbers(pair: RotorPair) -> RotorPair:
    """Return the numbers of `pair` in arrays of NumPy, with `None` in place of all other leaves."""
    return jax.tree.map(np.asarray, eqx.filter(pair, eqx.is_inexact_array))
