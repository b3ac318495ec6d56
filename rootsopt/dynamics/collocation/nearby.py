"""Close an orbit from the known orbit of a similar pair, without a transient.

The orbit of a neighbouring design or scene has nearly the same motion, and its events in the same
order. A step along the tangent of the family of orbits leads from one to the other, and Newton's
method corrects it, on the same mesh. Afterwards the flags are evaluated along the new orbit, with a
search for the contact. If they do not change exactly at the events of the mesh, or if another check
fails, the orbit is not accepted.

The error is estimated without a second mesh, from the estimate of the orbit that was solved on two
meshes. That estimate is multiplied by the growth of the elements' highest coefficients since then.
These coefficients fall with the fourth power of the elements' length, the error of the forces with
the eighth.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.dynamics.collocation.closing import sizes
from rootsopt.dynamics.collocation.elements import Elements, Mesh
from rootsopt.dynamics.collocation.equation import CollocatedEquation
from rootsopt.dynamics.collocation.events import FlagScan, agrees, look
from rootsopt.dynamics.collocation.forces import OrbitForces, response
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.collocation.mesh import roughness
from rootsopt.dynamics.collocation.newton import newton
from rootsopt.dynamics.pair import RotorPair

_STEP, _LAST = 1e-5, 1e-6
"""Newton step (scaled) below which Newton's method stops, and last correction (scaled) above which
an orbit is rejected. This correction is made together with the derivatives. It is usually smaller
by orders of magnitude, since convergence is quadratic."""
_FAR = 1e-6
"""Difference (rad) between the contact's normal angle in the solved orbit and that found by a
search, above which an orbit is rejected. Only instants at which the flanks push count."""


class Known(NamedTuple):
    """A closed orbit from which orbits of similar pairs can be closed.

    `elements`: its motion, on a mesh that ends at its events; `roughness`: that of the elements
    (`mesh.roughness`) for which the errors were estimated; `error`, `drift`: these estimates, as in
    `closing.Closed`; `sound`: whether the orbit was closed and confirmed.
    """

    elements: Elements
    roughness: Float[Array, ""]
    error: Float[Array, ""]
    drift: Float[Array, ""]
    sound: Bool[Array, ""]

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
        return cls(motion, nothing, nothing, nothing, jnp.zeros((), bool))


class Near(NamedTuple):
    """An orbit closed from a known one.

    `found`: forces and derivatives; `known`: the orbit, to start from again; `steps`: number of
    Newton steps. `known.sound`: whether the orbit is accepted; if not, the other fields have no
    meaning."""

    found: OrbitForces
    known: Known
    steps: Int[Array, ""]


def close_near(
    equation: CollocatedEquation, tangents: Any, known: Known, neighbour: RotorPair
) -> Near:
    """Close the orbit near the `known` one of a similar pair.

    `equation` of the new pair; `tangents`: directions of its parameters along which to
    differentiate, stacked along a leading axis; `neighbour`: pair of the known orbit."""
    frozen = lax.stop_gradient(equation.pair)
    got = newton(equation, known.elements, jnp.asarray(_STEP), neighbour)
    found = response(equation, got.elements, got.force, tangents)
    seen = look(frozen, found.elements)
    growth = jnp.maximum(roughness(found.elements) / known.roughness, 1.0) ** 2
    sound = known.sound & (got.size <= _STEP) & (found.correction <= _LAST)
    sound &= agrees(frozen, found.elements, seen) & (_apart(found.elements, seen) <= _FAR)
    near = Known(found.elements, known.roughness, known.error, known.drift, sound)
    near = near._replace(error=known.error * growth, drift=known.drift * growth)
    return Near(found, near, got.turns)


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


def _apart(elements: Elements, seen: FlagScan) -> Float[Array, ""]:
    """Return the greatest difference (rad) between the roots of `elements` and those of a search.

    Roots are normal angles of the closest approach. Only Gauss points at which the flanks push
    count. `seen`: result of `look`."""
    inside = len(GAUSS.nodes)
    used = jnp.arange(elements.state.shape[0]) < elements.mesh.used
    counts = seen.pushes[:, :inside] & used[:, None, None]
    away = jnp.abs(elements.roots[:, :inside, :, 0] - seen.roots[:, :inside])
    return jnp.max(jnp.where(counts, away, 0.0))


__all__ = ["Known", "Near", "close_near", "trimmed"]
