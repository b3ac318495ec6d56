"""The greatest contact force of an orbit on elements.

Inside an element the force is smooth. Its values and slopes along the orbit at the Gauss points
determine a polynomial of degree 2s - 1. The equation is evaluated next at the maxima of this
polynomial. The peak follows from force and slope there. A peak at a corner of the force lies at the
end of an element, which is an event, and moves with this event.

At the event itself, rounding decides from which side of the corner the derivatives are. Both sides
give the same change of the peak, since the force is continuous and the event moves with them. If
the force jumps, the peak is extrapolated from inside the element.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from rootsopt.dynamics.collocation.elements import GAUSS, POINTS, Elements
from rootsopt.dynamics.collocation.equation import CollocatedEquation, Points

RIVALS = POINTS + 1
"""Number of elements that may contain the peak: as many as an element has instants, so that the
equation is evaluated in all of them on one additional element."""
# Places in each element at which the polynomials of the force are compared.
_PLACES = np.linspace(0.0, 1.0, 9)
# Number of Newton steps from the best of these places to the maximum of a polynomial.
_STEPS = 4
# Distance of the peak from the instant at which the equation is evaluated (fraction of the
# element's length) below which force and derivative are extrapolated to it: both errors are then
# far below those of the orbit. The first number holds at the usual accuracy, and grows with the
# error to reach; the second is the least distance.
_CLOSE, _LEAST = 1e-5, 1e-9
# Distance between two instants (fraction of the element's length) below which the errors of their
# interpolated roots count as equal.
_BESIDE = 1e-2
# Least distance of such an instant from the ends of its element, as a fraction of its length.
# Closer to an end, which may be an event, slope and roots may be those of the other side.
_INSIDE = 1e-4
# Relative difference between the force at an element's end, and that extrapolated from inside the
# element, above which the force jumps there.
_JUMP = 1e-6
# Greatest distance of the peak from the instant at which the equation is evaluated, as a fraction
# of the element's length. The latter lies at the maximum of a polynomial.
_NEAREST = 0.1


class Rivals(NamedTuple):
    """The instants of an orbit at which the force may be greatest, in p elements.

    `element` (p,): indices of elements; `share` (p,): positions in these elements, from 0 (start)
    to 1 (end); `roots` (p, flanks, 2): `NearContact.roots` there.
    """

    element: Int[Array, " p"]
    share: Float[Array, " p"]
    roots: Float[Array, "p flanks 2"]

    @classmethod
    def anywhere(cls, elements: Elements) -> "Rivals":
        """Return instants in the middle of the first element of `elements`."""
        element = jnp.zeros(RIVALS, int)
        share = jnp.full(RIVALS, 0.5, elements.state.dtype)
        return cls(element, share, _roots(elements.roots, element, share))

    def moved(self, old: Elements, new: Elements) -> "Rivals":
        """Return the same instants in the elements of another mesh of the motion."""
        element, share = new.place_of(self.places(old)[0])
        share = jnp.clip(share, _INSIDE, 1.0 - _INSIDE)
        return Rivals(element, share, _roots(new.roots, element, share))

    def rooted(self, before: Elements, after: Elements) -> "Rivals":
        """Return the same instants, with roots that follow those of the elements.

        Interpolated roots alone have a greater error than roots that follow Newton's steps."""
        one, other = (_roots(x.roots, self.element, self.share) for x in (before, after))
        return self._replace(roots=self.roots + (other - one))

    def places(self, elements: Elements) -> tuple[Float[Array, " p"], Float[Array, "p n"]]:
        """Return times (mesh periods) and scaled states of the instants, on the motion
        `elements`."""
        begin, length = elements.mesh.ends[0][self.element], elements.mesh.lengths[self.element]
        rise = jnp.sum(GAUSS.integrated(self.share)[..., None] * elements.slopes[self.element], 1)
        return begin + length * self.share, elements.state[self.element] + length[:, None] * rise


class Peak(NamedTuple):
    """The greatest contact force of an orbit.

    `element`: index of the element that contains the peak; `share`: position in the element, from 0
    (start) to 1 (end); `place`: row and column of the instant from which the derivatives of the
    peak follow, in the arrays of `Points`; `shift`: part of `share` that has been added to this
    instant; `force`: contact force (N).
    """

    element: Int[Array, ""]
    share: Float[Array, ""]
    place: tuple[Int[Array, ""], Int[Array, ""]]
    shift: Float[Array, ""]
    force: Float[Array, ""]


def forces_along(
    equation: CollocatedEquation, points: Points
) -> tuple[Float[Array, "e p"], Float[Array, "e p"]]:
    """Return the contact force at all `points`, and its derivative with respect to time (mesh
    periods) along the motion.

    Both are in units of the pair's `force_scale`."""
    count, last = points.slopes.shape[-1] - 1, points.values.shape[-1] - 2
    states = points.values[..., :count]

    def along(row):
        slope = points.slopes[..., row, :]
        return slope[..., 0] + jnp.sum(slope[..., 1:] * states, axis=-1)

    force, rate = points.values[..., count], along(count)
    if equation.pair.free:
        lapse = points.values[..., last]
        force = force / lapse
        rate = (rate - force * along(last)) / lapse
    return force, rate


def rivals_of(
    elements: Elements,
    points: Points,
    force: Float[Array, "e p"],
    rate: Float[Array, "e p"],
    before: Rivals,
) -> Rivals:
    """Return the instants on the motion `elements` at which the force may be greatest.

    `points`: equation along the motion, where the instants `before` follow the elements in use;
    `force`, `rate`: results of `forces_along` for it."""
    rows = _polynomials(elements, force, rate)
    used = elements.mesh.filled
    heights = rows @ _powers(_PLACES, rows.shape[1])
    highest = jnp.where(used, jnp.max(heights, axis=1), -jnp.inf)
    element = lax.top_k(highest, RIVALS)[1].astype(int)
    # The slope at the instants before shows the error of the polynomials' slopes nearby.
    known = elements.mesh.lengths[before.element] * rate[elements.mesh.used]
    wrong = known - _derivatives(rows[before.element], before.share)[1]
    wrong = jnp.zeros(rows.shape[0], rows.dtype).at[before.element].set(wrong)[element]
    rows, share = rows[element], jnp.asarray(_PLACES)[jnp.argmax(heights[element], axis=1)]

    def closer(_, share):
        _, slope, bend = _derivatives(rows, share)
        # A greater error means that the motion is not yet a solution.
        error = jnp.where(jnp.abs(wrong) < _BESIDE * jnp.abs(bend), wrong, 0.0)
        return jnp.clip(share + _to_vertex(slope + error, bend), _INSIDE, 1.0 - _INSIDE)

    share = lax.fori_loop(0, _STEPS, closer, share)
    # Likewise for the roots: derivatives of the force have an error proportional to theirs.
    astray = points.roots[elements.mesh.used] - _roots(points.roots, before.element, before.share)
    astray = jnp.zeros_like(points.roots[:, 0]).at[before.element].set(astray)[element]
    place = jnp.full(used.shape, jnp.inf).at[before.element].set(before.share)[element]
    astray = jnp.where((jnp.abs(share - place) < _BESIDE)[:, None, None], astray, 0.0)
    return Rivals(element, share, _roots(points.roots, element, share) + astray)


def peak_of(
    elements: Elements, rivals: Rivals, force: Float[Array, "e p"], rate: Float[Array, "e p"]
) -> Peak:
    """Return the greatest force of the motion `elements`, in units of the pair's `force_scale`.

    `force`, `rate`: results of `forces_along`, where the instants `rivals` follow the elements in
    use."""
    extra, element = elements.mesh.used, rivals.element
    rows = _polynomials(elements, force, rate)[element]
    slope = elements.mesh.lengths[element] * rate[extra]
    value, leaning, bend = _derivatives(rows, rivals.share)
    share = jnp.clip(rivals.share + _to_vertex(slope, bend), 0.0, 1.0)
    shift = share - rivals.share
    rise = _derivatives(rows, share)[0] - value + (slope - leaning) * shift
    height = force[extra] + rise
    # If fewer elements are in use than there are rivals, the others are not part of the orbit.
    height = jnp.where(element < extra, height, -jnp.inf)
    top = jnp.argmax(height)
    element, share, shift, height = element[top], share[top], shift[top], height[top]
    # Every end of an element is also an instant at which the equation is evaluated.
    before = jnp.where(element > 0, element, extra) - 1
    ending = jnp.where(share > 0, element, before)
    at_end, here = jnp.abs(share - 0.5) == 0.5, force[ending, POINTS]
    joins = at_end & (jnp.abs(here - height) <= _JUMP * jnp.abs(height))
    place = jnp.where(joins, ending, extra), jnp.where(joins, POINTS, top)
    return Peak(
        element=jnp.where(joins, ending, element),
        share=jnp.where(joins, 1.0, share),
        place=place,
        shift=jnp.where(joins, 0.0, shift),
        force=jnp.where(joins, here, height),
    )


def is_settled(
    before: Rivals, after: Rivals, peak: Peak, accuracy: Float[Array, ""]
) -> Bool[Array, ""]:
    """Return whether the peak lies so close to an instant that the extrapolation to it is exact.

    `before`: instants at which the equation was evaluated; `peak`: result of `peak_of` for them;
    `after`: result of `rivals_of` for them; `accuracy`: error to reach, in multiples of that at the
    usual accuracy."""
    close = jnp.clip(_CLOSE * accuracy, _LEAST, _BESIDE)
    tried = jnp.any(before.element == after.element[0])
    at_end = (jnp.abs(peak.share - 0.5) == 0.5) & (jnp.abs(peak.shift) <= 2 * _INSIDE)
    return tried & (at_end | (jnp.abs(peak.shift) < close))


def _roots(roots, element, share) -> Float[Array, "p flanks 2"]:
    """Return `NearContact.roots` in each `element` at `share`, by the polynomials through those at
    the Gauss points; `roots`: `Elements.roots`."""
    weights = GAUSS.lagrange(share)[..., None, None]
    return jnp.sum(weights * roots[element, :POINTS], axis=1)


def _to_vertex(slope: Float[Array, " p"], bend: Float[Array, " p"]) -> Float[Array, " p"]:
    """Return the step to the maximum of a parabola, at most `_NEAREST` (fractions of an element).

    `slope`, `bend`: first and second derivative. Without a maximum, step uphill by `_NEAREST`."""
    bends = bend < 0
    step = -slope / jnp.where(bends, bend, -1.0)
    step = jnp.where(bends, step, jnp.sign(slope) * _NEAREST)
    return jnp.clip(step, -_NEAREST, _NEAREST)


def _powers(share: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return the powers 0 to `count` - 1 of the distance from the middle of an element, as rows."""
    return np.asarray((share - 0.5) ** np.arange(count)[:, None], np.float64)


def _hermite() -> NDArray[np.float64]:
    """Return the matrix that converts values and slopes at the Gauss points to coefficients of
    powers of the distance from the middle of the element."""
    count = 2 * POINTS
    order = np.arange(count)
    values = _powers(GAUSS.nodes, count).T
    slopes = np.zeros_like(values)
    slopes[:, 1:] = order[1:] * values[:, :-1]
    return np.asarray(np.linalg.inv(np.concatenate([values, slopes])), np.float64)


def _derived() -> NDArray[np.float64]:
    """Return the matrices (3, c, c) that convert the c coefficients of a polynomial to those of its
    value, first and second derivative."""
    count = 2 * POINTS
    once = np.diag(np.arange(1.0, count), -1)
    return np.stack([np.eye(count), once, once @ once])


_HERMITE, _DERIVED = _hermite(), _derived()


def _polynomials(elements: Elements, force, rate) -> Float[Array, "e c"]:
    """Return the coefficients of the force in each element (see `_hermite`)."""
    slopes = elements.mesh.lengths[:, None] * rate[:, :POINTS]
    return jnp.concatenate([force[:, :POINTS], slopes], axis=1) @ _HERMITE.T


def _derivatives(rows: Float[Array, "p c"], share: Float[Array, " p"]) -> Float[Array, "3 p"]:
    """Return value, first and second derivative of the polynomials `rows` at `share`."""
    powers = (share - 0.5)[:, None] ** jnp.arange(float(rows.shape[1]))
    # One sum for all: XLA would repeat Horner's scheme for each result that uses a value.
    return jnp.sum(rows @ _DERIVED * powers, axis=-1)
