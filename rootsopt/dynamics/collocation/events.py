"""Search for the events of a motion, and check of the events that a mesh assumes.

The flags of the equation are looked at between all Gauss points and on both sides of all ends of
elements, by the contact's own search. A change of a flag is an event. Those in the middle of
elements are located by bisection.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.contact.search import SearchContact
from rootsopt.dynamics.collocation.blocks import in_blocks
from rootsopt.dynamics.collocation.elements import Elements
from rootsopt.dynamics.collocation.gauss import GAUSS
from rootsopt.dynamics.pair import RotorPair

_ASIDE = 2e-7, 0.02
"""Distance from an element's end at which the flags are looked at: in mesh periods, and at most in
lengths of the shorter of the two elements beside it."""
_HALVINGS = 30
"""Number of bisections that locate an event."""
_SAME = 3e-9
"""Distance (mesh periods) below which two events are one."""
_CHANGES = 384
"""Maximum number of changes of flags between neighbouring places."""


class Look(NamedTuple):
    """Flags along a motion, in the order of time.

    `tau` (p,): places (mesh periods); `flags` (p, f); `counts` (p, f): whether they matter;
    `roots` (e, s + 2, sides): normal angles of the closest approach; `pushes` (e, s + 2, sides):
    whether the flanks transmit a force; `total`: number of places.
    """

    tau: Float[Array, " p"]
    flags: Bool[Array, "p f"]
    counts: Bool[Array, "p f"]
    roots: Float[Array, "e q sides"]
    pushes: Bool[Array, "e q sides"]
    total: Int[Array, ""]


class Events(NamedTuple):
    """Events of a motion in the order of time, as in `Mesh`.

    `times`, `which` (m,); `count`: number of them; `new`: number of changes that are not at events
    of the mesh; `gone`: number of the mesh's events at which nothing changes; `fits`: whether there
    is room for all.
    """

    times: Float[Array, " m"]
    which: Int[Array, " m"]
    count: Int[Array, ""]
    new: Int[Array, ""]
    gone: Int[Array, ""]
    fits: Bool[Array, ""]


def flags_at(pair: RotorPair, tau, state):
    """Return flags, whether they matter, roots (sides,) of the contact, and whether it pushes."""
    found = pair.margins(tau, state)
    roots = jnp.stack([place.normal2 for place in found.places])
    return found.values > 0, found.counts, roots, found.pushes


def ranks(pair: RotorPair) -> list[int]:
    """Return for each margin its rank among those that change at one instant: the least counts.

    Margins that do not depend on the contact are best known, then the change to the other minimum
    next to a cusp, with which other flags change. -1: not an event by itself."""
    assert isinstance(pair.contact, SearchContact)
    nothing = jnp.zeros(())
    law = jax.eval_shape(pair.law.margins, nothing, nothing).shape[0]
    tau, state = nothing, jnp.zeros(pair.states)
    total = jax.eval_shape(lambda: pair.margins(tau, state).values).shape[0]
    profile = pair.contact.pair.profile
    pieces = 2 + profile.cusp + 2 * max(len(profile.segments()) - 1, 1)
    drags = jax.eval_shape(
        lambda: jnp.concatenate(
            [jnp.zeros(0), *(part.drag_margins(nothing) for part in pair.all_parts if part.rubs)]
        )
    ).shape[0]
    flank = law + pieces + drags
    order = [2 + k for k in range(flank)]
    order[law] = -1
    if profile.cusp:
        order[law + 2] = 1
    both = order * (1 + pair.two_sided)
    return both + [0] * (total - len(both))


def look(pair: RotorPair, elements: Elements) -> Look:
    """Look at the flags at the Gauss points and on both sides of the end of each element."""
    mesh = elements.mesh
    tau, state = elements.places
    number = jnp.arange(mesh.left.shape[0])
    length = mesh.lengths
    beside = jnp.minimum(length, length[jnp.where(number + 1 < mesh.used, number + 1, 0)])
    aside = jnp.minimum(_ASIDE[0], _ASIDE[1] * beside)
    end = tau[:, -1:] + aside[:, None] * jnp.asarray([-1.0, 1.0])
    slope = elements.slopes[:, -1:]
    ends = state[:, -1:] + slope * (end - tau[:, -1:])[..., None]
    tau = jnp.concatenate([tau[:, :-1], end], axis=1)
    state = jnp.concatenate([state[:, :-1], ends], axis=1)
    each = jax.vmap(jax.vmap(lambda t, z: flags_at(pair, t, z)))
    flags, counts, roots, pushes = in_blocks(each, mesh.used, tau, state)
    width = flags.shape[-1]
    total = mesh.used * tau.shape[1]
    flags, counts = flags.reshape(-1, width), counts.reshape(-1, width)
    return Look(tau.ravel(), flags, counts, roots, pushes, total)


def rooted(elements: Elements, seen: Look) -> Elements:
    """Return the elements with the contact's roots from a look at them.

    At the end of an element, the root is that of the side on which the flanks push; the rival next
    to a cusp is the root after the end."""
    inside = len(GAUSS.nodes)
    before = seen.pushes[:, inside] | ~seen.pushes[:, inside + 1]
    own = jnp.where(before, seen.roots[:, inside], seen.roots[:, inside + 1])
    ends = jnp.stack([own, seen.roots[:, inside + 1]], axis=-1)
    points = jnp.repeat(seen.roots[:, :inside, :, None], 2, axis=-1)
    return elements._replace(roots=jnp.concatenate([points, ends[:, None]], axis=1))


def found_events(pair: RotorPair, elements: Elements, seen: Look, room: int) -> Events:
    """Return the events of the motion that was `seen`; `room`: of the arrays for times."""
    mesh = elements.mesh
    places = seen.tau.shape[0]
    per = len(GAUSS.nodes) + 2
    rank = jnp.asarray(ranks(pair))
    number = jnp.arange(places)
    after = jnp.where(number + 1 < seen.total, number + 1, 0)
    later = jnp.where(number + 1 < seen.total, seen.tau[after], seen.tau[0] + mesh.period)
    differ = (seen.flags != seen.flags[after]) & (seen.counts | seen.counts[after]) & (rank >= 0)
    differ &= (number < seen.total)[:, None]
    # The places on both sides of an element's end that is an event of the mesh.
    element, inside = number // per, number % per
    ends_at = jnp.where(mesh.last, mesh.interval + 1, mesh.times.shape[0] - 1)[element]
    real = mesh.last[element] & (mesh.times[ends_at] < mesh.times[-1]) & (element < mesh.used)
    declared = (inside == per - 2) & real & (number < seen.total)
    fixed = mesh.which[ends_at] < 0
    holds = jnp.take_along_axis(differ, jnp.maximum(mesh.which[ends_at], 0)[:, None], 1)[:, 0]
    kept = declared & (fixed | holds)
    fresh = differ & ~(kept)[:, None]
    place, flag = jnp.nonzero(fresh, size=_CHANGES, fill_value=0)
    new = jnp.sum(fresh)
    value = seen.flags[place, flag]

    def locate(k, found):
        def halve(_, ends):
            low, high = ends
            middle = (low + high) / 2
            flags = flags_at(pair, middle, elements.motion(middle))[0]
            same = flags[flag[k]] == value[k]
            return jnp.where(same, middle, low), jnp.where(same, high, middle)

        low, high = lax.fori_loop(0, _HALVINGS, halve, (seen.tau[place[k]], later[place[k]]))
        return found.at[k].set((low + high) / 2)

    located = lax.fori_loop(
        0, jnp.minimum(new, _CHANGES), locate, jnp.full(_CHANGES, jnp.inf, seen.tau.dtype)
    )
    held = jnp.full(mesh.times.shape, False).at[jnp.where(kept, ends_at, 0)].set(True)
    held = held.at[0].set(False)
    times = jnp.concatenate([located, jnp.where(held, mesh.times, jnp.inf)])
    which = jnp.concatenate([flag, mesh.which])
    times, which, count = _merged(times, which, rank)
    gone = jnp.sum(declared & ~kept)
    fits = (new <= _CHANGES) & (count <= room - 3)
    return Events(times[:room], which[:room], count, new, gone, fits)


def _merged(times, which, rank):
    """Sort events and merge those of one instant; return times (inf beyond the last), margins and
    their number."""
    importance = jnp.where(which < 0, -1, rank[which])
    order = jnp.lexsort((importance, times))
    times, which, importance = times[order], which[order], importance[order]
    real = times < jnp.inf
    apart = jnp.diff(jnp.where(real, times, 1e30), prepend=-1e30) > _SAME
    group = jnp.cumsum(apart) - 1
    least = jax.ops.segment_min(importance, group, times.shape[0])
    chosen = real & (importance == least[group])
    # One of each group.
    first = jnp.cumsum(chosen) - 1
    begun = jax.ops.segment_min(jnp.where(chosen, first, times.shape[0]), group, times.shape[0])
    chosen &= first == begun[group]
    order = jnp.argsort(jnp.where(chosen, times, jnp.inf))
    count = jnp.sum(chosen)
    times = jnp.where(jnp.arange(times.shape[0]) < count, times[order], jnp.inf)
    return times, jnp.where(times < jnp.inf, which[order], -1), count
