"""A closed orbit in the form from which the orbits of similar pairs can be closed."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rootsopt.dynamics.collocation.elements import Elements, Mesh
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.collocation.mesh import sizes


class Known(NamedTuple):
    """A closed orbit from which orbits of similar pairs can be closed.

    `elements`: its motion; `roughness`: that of the elements (`mesh.roughness`) for which the
    errors were estimated; `error`, `drift`: these estimates, as in `closing.Closed`; `sound`:
    whether the orbit was closed and confirmed; `aligned`: whether the mesh ends at the orbit's
    events. If not, errors are not known.
    """

    elements: Elements
    roughness: Float[Array, ""]
    error: Float[Array, ""]
    drift: Float[Array, ""]
    sound: Bool[Array, ""]
    aligned: Bool[Array, ""]

    @classmethod
    def unaligned(cls, elements: Elements) -> "Known":
        """Return the motion `elements`, whose mesh does not end at events yet, as a known orbit."""
        infinite, yes = jnp.asarray(jnp.inf), jnp.ones((), bool)
        return cls(elements, jnp.ones(()), infinite, infinite, yes, ~yes)

    @classmethod
    def empty(cls, sizes: tuple[int, int], states: int, sides: int) -> "Known":
        """Return a placeholder.

        `sizes`: room for elements and for times of the mesh; `states`: number of states; `sides`:
        number of flank sides that can touch at once."""
        elements, times = sizes
        points = len(GAUSS.nodes)
        nothing, zero = jnp.zeros(()), jnp.zeros((), int)
        mesh = Mesh(
            times=jnp.zeros(times),
            which=jnp.zeros(times, int),
            interval=jnp.zeros(elements, int),
            left=jnp.zeros(elements),
            right=jnp.zeros(elements),
            used=zero,
        )
        motion = Elements(
            mesh,
            jnp.zeros((elements, states)),
            jnp.zeros((elements, points, states)),
            jnp.zeros((elements, points + 1, sides, 2)),
        )
        no = jnp.zeros((), bool)
        return cls(motion, nothing, nothing, nothing, no, no)


def trimmed(known: Known, period: int) -> Known | None:
    """Return the orbit `known` in arrays of the usual size for `period` mesh periods.

    All orbits of this period then share one program. The result is `None` if the orbit needs more
    room. The arrays are those of NumPy."""
    room, times = sizes(period)
    mesh, *parts = jax.tree.map(np.asarray, known.elements)
    anchors, interval = mesh.times[:times], np.minimum(mesh.interval[:room], times - 2)
    if mesh.used + 1 > room or np.any(mesh.times[times - 2 :] < mesh.times[-1]):
        return None
    shares = mesh.left[:room], mesh.right[:room], mesh.used
    arrays: Any = anchors, mesh.which[:times], interval, *shares
    rest: Any = map(np.asarray, known[1:])
    return Known(Elements(Mesh(*arrays), *(part[:room] for part in parts)), *rest)


__all__ = ["Known", "trimmed"]
