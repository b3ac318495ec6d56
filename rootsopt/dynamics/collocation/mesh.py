"""Meshes: distribution of elements over the intervals between events, and how results differ.

`KnownOrbit` is a closed orbit in the form from which the orbits of similar pairs can be closed."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.contact.gap import innermost
from rootsopt.contact.search import SearchContact
from rootsopt.dynamics.collocation.elements import BLOCK, GAUSS, POINTS, Elements, Mesh
from rootsopt.dynamics.collocation.events import _SAME
from rootsopt.dynamics.flow import Pieces
from rootsopt.dynamics.orbit import Orbit, choose
from rootsopt.dynamics.pair import RotorPair

# Density of elements that is added everywhere, as a fraction of the mean density. It limits the
# length of elements.
_FLOOR = 0.15

# Maximum number of elements per mesh period: in each of the first two mesh periods, and in each
# further one, unless the flank is wavy or forked. Free forms have some 45 events in each mesh
# period, four arcs up to 35. Other families have fewer, and more room would slow them down: with
# room for 64 events in each of eight mesh periods, sorting events takes half of the time from rest.
# Shorter orbits can use the room of longer ones, up to the third number per mesh period at the
# usual accuracy, or the fourth per event: at low speed, rotors bounce up to 50 times in a mesh
# period, and four elements from one bounce to the next left errors of 1e-6.
_MOST, _FINEST, _EACH = (96, 48), 160, 8
# Number of events above which the search for the orbit fails, counted like elements.
_TIMES = 64, 24
# Greatest share of the elements that is left out to save the evaluation of a further block.
_SPARED = 0.06
# Growth of these numbers for each further slice of twisted rotors, as a fraction: each slice has
# its own events.
_SLICES = 0.5

# Force, as a share of the pair's, below which errors are relative to this force.
_WEAK = 1e-3

# Derivative of the states (scaled) below which errors of derivatives are relative to this number,
# for an orbit without contact.
_LEAST = 1e-6


def room_for(pair: RotorPair, periods: int) -> tuple[int, int]:
    """Return the `sizes` for orbits of `pair` of up to this number of mesh periods. The number is
    rounded up to one after which the equation repeats."""
    contact = innermost(pair.contact)
    profile = contact.pair.profile if isinstance(contact, SearchContact) else None
    crowded = profile is not None and (profile.wavy or profile.forked)
    return sizes(pair.whole(periods), pair.contact.sections, crowded)


def sizes(periods: int, slices: int, crowded: bool) -> tuple[int, int]:
    """Return the sizes of the arrays of a mesh, for its elements and for its times.

    They are large enough for orbits of up to `periods` mesh periods of rotors with this number of
    `slices` (1 for straight rotors); `crowded`: whether each mesh period has many events."""
    first = periods if crowded else min(periods, 2)
    further = periods - first
    growth = 1 + _SLICES * (slices - 1)
    elements, times = (round(growth * (first * x + further * y)) for x, y in (_MOST, _TIMES))
    return -(-elements // BLOCK) * BLOCK, times + 3


def most_elements(mesh: Mesh, denser: Float[Array, ""], slices: int) -> Int[Array, ""]:
    """Return the number of elements above which the `mesh` is not refined.

    `denser`: factor by which meshes are denser than at the usual accuracy; `slices`: as for
    `sizes`. The arrays have room for more if the period is shorter than the longest one. An orbit
    that needs more elements has an event that the equation does not know, and each further element
    costs time."""
    growth = 1 + _SLICES * (slices - 1)
    least = jnp.maximum(growth * _FINEST * mesh.period, _EACH * jnp.sum(mesh.which >= 0))
    wanted = jnp.round(denser * least).astype(int)
    return jnp.minimum(wanted, mesh.left.shape[0]) - 1


def snug(used: Int[Array, ""]) -> Int[Array, ""]:
    """Return fewer elements than `used`, by at most the share `_SPARED`, if this saves a block.

    The equation is evaluated on one element more than are in use."""
    spare = (used + 1) % BLOCK
    return jnp.where(spare <= _SPARED * used, used - spare, used)


def shared(
    times: Float[Array, " m"],
    which: Int[Array, " m"],
    events: Int[Array, ""],
    density: tuple[Float[Array, " p"], Float[Array, " p"]],
    used: Int[Array, ""],
    capacity: int,
) -> Mesh:
    """Return a mesh of `used` elements, with element ends at the events.

    `times`, `which` (m,): as in `Mesh`; `events`: number of events; `density`: times (p,) in mesh
    periods, and desired number of elements up to each time (p,), in any unit; `capacity`: size of
    the arrays for elements. Each interval between events has at least one element."""
    place, wanted = density
    # The floor keeps elements short where the desired density is almost zero.
    even = (place - place[0]) / (place[-1] - place[0])
    total = wanted[-1] - wanted[0]
    wanted = (wanted - wanted[0]) / jnp.where(total > 0, total, 1.0) + _FLOOR * even
    at = jnp.interp(times, place, wanted)
    weight = jnp.diff(at)
    number = jnp.arange(weight.shape[0])
    real = number <= events
    spare = used - events - 1
    fair = jnp.where(real, spare * weight / jnp.sum(jnp.where(real, weight, 0.0)), 0.0)
    whole = jnp.floor(fair).astype(int)
    rest = spare - jnp.sum(whole)
    rank = jnp.argsort(jnp.argsort(-jnp.where(real, fair - whole, -1.0)))
    counts = jnp.where(real, 1 + whole + (rank < rest), 0)
    begins = jnp.cumsum(counts) - counts
    element = jnp.arange(capacity)
    filled = element < used
    interval = jnp.clip(jnp.searchsorted(begins + counts, element, side="right"), 0, events)
    inside, size = element - begins[interval], jnp.maximum(counts[interval], 1)

    def share(step):
        goal = at[interval] + weight[interval] * step / size
        room = times[interval + 1] - times[interval]
        ratio = (jnp.interp(goal, wanted, place) - times[interval]) / jnp.where(room > 0, room, 1)
        ratio = jnp.where(step == 0, 0.0, jnp.where(step == size, 1.0, ratio))
        return jnp.where(filled, ratio, 1.0)

    return Mesh(
        times=times,
        which=which,
        interval=jnp.where(filled, interval, times.shape[0] - 2),
        left=share(inside),
        right=share(inside + 1),
        used=used,
    )


def needed(elements: Elements) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """Return a density of elements for which all elements have about the same error.

    The density consists of times (p,) in mesh periods, and of the number of elements up to each
    time (p,), in an arbitrary unit. An element's error is estimated from the highest coefficient of
    the polynomial through its slopes."""
    share = _highest(elements) ** (1 / (len(GAUSS.nodes) + 1))
    begin, end = elements.mesh.ends
    return jnp.append(begin[:1], end), jnp.append(0.0, jnp.cumsum(share))


def roughness(elements: Elements) -> Float[Array, ""]:
    """Return the greatest highest coefficient of all elements (scaled), a measure of the error."""
    return jnp.max(_highest(elements))


def _highest(elements: Elements) -> Float[Array, " e"]:
    """Return the modulus (e,) of the highest coefficient of each element's motion (scaled)."""
    mesh = elements.mesh
    highest = jnp.sum(jnp.asarray(GAUSS.powers[-1])[:, None] * elements.slopes, axis=1)
    size = jnp.max(jnp.abs(highest), axis=1) * mesh.lengths
    return jnp.where(mesh.filled, size, 0.0)


def ordered(mesh: Mesh) -> tuple[Mesh, Bool[Array, ""]]:
    """Return `mesh` with its times in ascending order, and whether they were so before.

    Events that have passed each other, or a fixed time, meet halfway or at the fixed time."""
    fixed = (mesh.which < 0) | (mesh.times == mesh.times[-1])
    least = lax.cummax(jnp.where(fixed, mesh.times, -jnp.inf))
    most = lax.cummin(jnp.where(fixed, mesh.times, jnp.inf), reverse=True)
    between = jnp.clip(mesh.times, least, most)
    times = (lax.cummax(between) + lax.cummin(between, reverse=True)) / 2
    return mesh._replace(times=times), jnp.all(jnp.diff(mesh.times) >= 0)


def moved(elements: Elements, mesh: Mesh) -> Elements:
    """Return the motion `elements` on another `mesh`.

    `Elements.roots` are only useful if both meshes have the same events; otherwise they must be
    renewed (see `events.rooted`)."""
    begin, end = mesh.ends
    k, share = elements.place_of(begin)
    rise = jnp.sum(GAUSS.integrated(share)[..., None] * elements.slopes[k], axis=-2)
    state = elements.state[k] + elements.mesh.lengths[k][..., None] * rise
    inside = begin[:, None] + mesh.lengths[:, None] * GAUSS.nodes
    k, share = elements.place_of(jnp.append(inside, end[:, None], axis=1))
    weights = GAUSS.lagrange(share)
    slopes = jnp.einsum("eps,epsn->epn", weights[:, :-1], elements.slopes[k[:, :-1]])
    roots = jnp.einsum("eps,epsij->epij", weights, elements.roots[k][:, :, :-1])
    # The root at an event belongs to one side of the event.
    own = elements.roots[elements.mesh.finals[mesh.interval], -1]
    roots = roots.at[:, -1].set(jnp.where(mesh.last[:, None, None], own, roots[:, -1]))
    return Elements(mesh, state, slopes, roots)


def aligned(
    elements: Elements,
    events: tuple[Float[Array, " m"], Int[Array, " m"]],
    density: tuple[Float[Array, " p"], Float[Array, " p"]],
    used: Int[Array, ""],
) -> Elements:
    """Return the motion `elements` on a mesh of `used` elements, with ends at the `events`.

    `events`: times (mesh periods; inf beyond the last), and indices of their margins; `density`: as
    for `shared`. The mesh also has an element end at φ1 = 0. A motion whose mesh starts at φ1 = 0
    gets a new start: the middle of the longest interval between events."""
    old = elements.mesh
    length, room = old.period, old.times.shape[0]
    times, which = events
    real = times < jnp.inf
    fresh = old.times[0] == 0
    # Find the longest interval between events. The period is a circle: the last event is followed
    # by the first.
    place = jnp.where(real, jnp.mod(times, length), jnp.inf)
    order = jnp.argsort(place)
    place = place[order]
    count = jnp.sum(real)
    after = jnp.append(place[1:], jnp.inf)
    number = jnp.arange(place.shape[0])
    after = jnp.where(number == count - 1, place[0] + length, after)
    gap = jnp.where(number < count, after - jnp.where(number < count, place, 0.0), 0.0)
    widest = jnp.argmax(gap)
    middle = jnp.mod(place[widest] + gap[widest] / 2, length)
    middle = jnp.where(count > 0, middle, 0.37 * length)
    # Keep the new start away from φ1 = 0 too, because an element ends there.
    near = jnp.minimum(middle, length - middle) < 1e-3
    middle = jnp.where(near, jnp.mod(middle + gap[widest] / 4 + 2e-3, length), middle)
    begin = jnp.where(fresh, middle, old.times[0])
    times = jnp.where(real, begin + jnp.mod(times - begin, length), jnp.inf)
    origin = begin + jnp.mod(-begin, length)
    apart = jnp.min(jnp.where(real, jnp.abs(times - origin), jnp.inf)) > _SAME
    spot = jnp.argmax(jnp.where(apart, ~real, jnp.abs(times - origin) <= _SAME))
    times, which = times.at[spot].set(origin), which.at[spot].set(-1)
    order = jnp.argsort(times)
    times, which = times[order][: room - 1], which[order][: room - 1]
    count = jnp.sum(times < jnp.inf)
    end = begin + length
    times = jnp.concatenate([begin[None], jnp.minimum(times, end)])
    which = jnp.concatenate([jnp.full(1, -1), jnp.where(times[1:] < end, which, -1)])
    place, wanted = density
    place = jnp.concatenate([place, place[1:] + length])
    wanted = jnp.concatenate([wanted, wanted[1:] + wanted[-1]])
    inside = (place >= begin) & (place <= end)
    low, high = jnp.interp(jnp.stack([begin, end]), place, wanted)
    place = jnp.where(inside, place, jnp.where(place < begin, begin, end))
    wanted = jnp.where(inside, wanted, jnp.where(place <= begin, low, high))
    mesh = shared(times, which, count, (place, wanted), used, old.left.shape[0])
    return moved(elements, mesh)


def counted(elements: Elements) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """Return the present density of elements.

    The density consists of times (p,) in mesh periods, and of the number of elements up to each
    time (p,)."""
    mesh = elements.mesh
    begin, end = mesh.ends
    number = jnp.cumsum(jnp.where(mesh.filled, 1.0, 0.0))
    return jnp.append(begin[:1], end), jnp.append(0.0, number)


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
    def empty(cls, sizes: tuple[int, int], states: int, flanks: int) -> "KnownOrbit":
        """Return a placeholder for an orbit that is not known: arrays of its shapes, not `sound`.

        `sizes`: room for elements and for times of the mesh; `states`: number of states; `flanks`:
        number of flanks that can touch at once (`RotorPair.flanks`)."""
        elements, times = sizes

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
            zeros(elements, POINTS, states),
            zeros(elements, POINTS + 1, flanks, 2),
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
    roots = jnp.zeros((capacity, POINTS + 1, pair.flanks, 2), dtype)
    motion = Elements(mesh, pieces.states[row, column], pieces.slopes[row, column], roots)
    infinite, yes = jnp.asarray(jnp.inf), jnp.ones((), bool)
    return KnownOrbit(motion, jnp.ones(()), infinite, infinite, yes, ~yes)


PIECES = 40, GAUSS.nodes
"""Argument `pieces` of the transient (`strobe`) for `from_pieces`: number of elements per mesh
period before events are known, and their Gauss points."""


def differences(before: Orbit, after: Orbit, scale: Float[Array, ""]):
    """Return two relative differences between the results on two meshes.

    The first is the largest difference in mean, RMS, peak and further measures of the force. The
    second is the largest difference in the derivatives of mean, RMS and peak. Spectral lines are
    relative to the mean. Weak forces are relative to a share of `scale` (N), since rounding
    dominates the force of flanks that barely touch. For an orbit without contact, compare the state
    at φ1 = 0 (scaled) and its derivatives instead."""

    def rms(values):
        return values.at[1].set(jnp.sqrt(jnp.maximum(values[1], 0.0)))

    one, other = rms(before.response), rms(after.response)
    least = jnp.where(jnp.arange(other.shape[0]) < 3, 1e-30, jnp.abs(other[0]))
    size = jnp.maximum(jnp.abs(other), jnp.maximum(least, _WEAK * scale))
    error = jnp.max(jnp.abs(one - other) / size)
    slopes = jnp.max(jnp.abs(before.sensitivity - after.sensitivity), axis=1, initial=0.0)
    largest = jnp.max(jnp.abs(after.sensitivity), axis=1, initial=0.0)
    weak = jnp.abs(other) / size
    drift = jnp.max((weak * slopes / jnp.where(largest > 0, largest, 1.0))[:3])
    moved = jnp.max(jnp.abs(before.moved - after.moved), initial=0.0)
    # Where the motion hardly depends on the directions, a relative difference would only show
    # rounding.
    moved /= jnp.maximum(jnp.max(jnp.abs(after.moved), initial=0.0), _LEAST)
    apart = jnp.max(jnp.abs(before.state - after.state))
    return choose(other[2] > 0, (error, drift), (apart, moved))
