"""A closed orbit in the form from which the orbits of similar pairs can be closed."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.elements import GAUSS, Elements, Mesh
from rootsopt.dynamics.collocation.mesh import room_for
from rootsopt.dynamics.flow import Pieces
from rootsopt.dynamics.pair import RotorPair


class KnownOrbit(NamedTuple):
    """A closed orbit from which orbits of similar pairs can be closed.

    `elements`: its motion; `roughness`: that of the elements (`mesh.roughness`) for which the
    errors were estimated; `error`: estimated relative error of the forces, the largest of mean, RMS
    and peak; `drift`: that of their derivatives, relative to the largest derivative of the same
    force; both are inf if not known; `sound`: whether the orbit was closed and confirmed;
    `aligned`: whether the mesh ends at the orbit's events. If not, errors are not known.
    """

    elements: Elements
    roughness: Float[Array, ""]
    error: Float[Array, ""]
    drift: Float[Array, ""]
    sound: Bool[Array, ""]
    aligned: Bool[Array, ""]

    @classmethod
    def unaligned(cls, elements: Elements) -> "KnownOrbit":
        """Return the motion `elements`, whose mesh does not end at events yet, as a known orbit."""
        infinite, yes = jnp.asarray(jnp.inf), jnp.ones((), bool)
        return cls(elements, jnp.ones(()), infinite, infinite, yes, ~yes)

    @classmethod
    def empty(cls, sizes: tuple[int, int], states: int, flanks: int) -> "KnownOrbit":
        """Return a placeholder.

        `sizes`: room for elements and for times of the mesh; `states`: number of states; `flanks`:
        number of flanks that can touch at once (`RotorPair.flanks`)."""
        elements, times = sizes
        points = len(GAUSS.nodes)

        # NumPy's zeros: outside of a program, JAX would compile one for each shape.
        def zeros(*shape: int, dtype: Any = float) -> Any:
            return np.zeros(shape, jax.dtypes.canonicalize_dtype(dtype))

        mesh = Mesh(
            times=zeros(times),
            which=zeros(times, dtype=int),
            interval=zeros(elements, dtype=int),
            left=zeros(elements),
            right=zeros(elements),
            used=zeros(dtype=int),
        )
        motion = Elements(
            mesh,
            zeros(elements, states),
            zeros(elements, points, states),
            zeros(elements, points + 1, flanks, 2),
        )
        no = zeros(dtype=bool)
        return cls(motion, zeros(), zeros(), zeros(), no, no)


def trimmed(known: KnownOrbit) -> KnownOrbit:
    """Return the orbit `known` in arrays of NumPy without the unused elements and times, to store
    it."""
    mesh, *parts = jax.tree.map(np.asarray, known.elements)
    count = int(mesh.used)
    # The times that follow the last interval are all equal to the last of these.
    times = int(np.max(mesh.interval[:count], initial=0)) + 2
    shares = mesh.interval[:count], mesh.left[:count], mesh.right[:count]
    short = Mesh(mesh.times[:times], mesh.which[:times], *shares, mesh.used)
    rest: Any = map(np.asarray, known[1:])
    return KnownOrbit(Elements(short, *(part[:count] for part in parts)), *rest)


def padded(known: KnownOrbit, room: tuple[int, int]) -> KnownOrbit:
    """Return a `trimmed` orbit in arrays with `room` for elements and for times of the mesh."""
    mesh, *parts = known.elements
    elements, times = room[0] - len(mesh.left), room[1] - len(mesh.times)

    def more(x, value) -> Any:
        return np.pad(x, (0, elements), constant_values=value)

    anchors: Any = np.pad(mesh.times, (0, times), mode="edge")
    which: Any = np.pad(mesh.which, (0, times), constant_values=-1)
    full = Mesh(
        times=anchors,
        which=which,
        interval=more(mesh.interval, room[1] - 2),
        left=more(mesh.left, 1.0),
        right=more(mesh.right, 1.0),
        used=mesh.used,
    )
    wide = (np.pad(x, ((0, elements), *((0, 0),) * (x.ndim - 1))) for x in parts)
    return known._replace(elements=Elements(full, *wide))  # pyright: ignore[reportArgumentType]


def from_pieces(
    pair: RotorPair, pieces: Pieces, period: Int[Array, ""], longest: int
) -> KnownOrbit:
    """Return the end of a transient as a start for closing its orbit by collocation.

    `pieces`: the last mesh periods of the transient, which ends at φ1 = 0, in `PIECES`; `period` of
    the orbit (mesh periods); `longest`: longest period for which the arrays have room."""
    capacity, count = room_for(pair, longest)
    dtype, per = pieces.states.dtype, pieces.ends.shape[1]
    number = jnp.arange(capacity)
    used, length = period * per, period.astype(dtype)
    real = number < used
    which = pieces.ends.shape[0] - period + number // per
    row, column = jnp.minimum(which, pieces.ends.shape[0] - 1), number % per
    begins = jnp.pad(pieces.ends[:, :-1], ((0, 0), (1, 0)))
    left, right = ((x[row, column] + number // per) / length for x in (begins, pieces.ends))
    mesh = Mesh(
        times=jnp.full(count, length, dtype).at[0].set(0.0),
        which=jnp.full(count, -1),
        interval=jnp.where(real, 0, count - 2),
        left=jnp.where(real, left, 1.0),
        right=jnp.where(real, right, 1.0),
        used=used,
    )
    roots = jnp.zeros((capacity, len(GAUSS.nodes) + 1, pair.flanks, 2), dtype)
    states, slopes = pieces.states[row, column], pieces.slopes[row, column]
    return KnownOrbit.unaligned(Elements(mesh, states, slopes, roots))


PIECES = 40, GAUSS.nodes
"""Argument `pieces` of the transient (`strobe`) for `from_pieces`: number of elements per mesh
period before events are known, and their Gauss points."""
