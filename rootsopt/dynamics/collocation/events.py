"""Find the events of a motion, and check the events that a mesh assumes.

An event is an instant at which a flag of the equation (`RotorPair.switches`) changes. The flags are
evaluated at all Gauss points, and on both sides of the end of each element. They are also evaluated
where a short touch may begin or end: beside a zero of ε, or where ε is extreme. At each of these
instants, the contact is found by a search (`SearchContact`), not from a closest approach already
known (`NearContact`). Events inside elements are located by the zeros of their margins.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rootsopt.contact.closest import RANKS
from rootsopt.contact.gap import WrappedContact, innermost
from rootsopt.contact.search import SearchContact
from rootsopt.dynamics.collocation.elements import (
    GAUSS,
    POINTS,
    Elements,
    Mesh,
    in_blocks,
    zero_of,
)
from rootsopt.dynamics.flanks import Margins, has_margins, margins_of, touch_of
from rootsopt.dynamics.orbit import branch
from rootsopt.dynamics.pair import RotorPair

# Distance from an element's end, before and after it, at which flags are evaluated. It is the
# smaller of two: the first number (mesh periods), and the second number times the length of the
# shorter adjacent element.
_ASIDE = 2e-7, 0.02
# Time (mesh periods) between two events below which they are merged into one.
_SAME = 3e-9
# Range of an element (fraction of its length) for the instants of `extra`. Those at the element's
# ends are beside it.
_WITHIN = 0.03, 0.97
# End and start of an element, as fractions of its length.
_ENDS = (1.0, 0.0)
FIXED, UNSAID = -1, -2
"""In place of the index of an event's margin: the time is fixed, as that of φ1 = 0; the time is
where a flag without a margin changes, and stays until flags are evaluated again."""
# Difference (rad) between the normal angles beside a located event above which the contact jumps
# there, from one minimum of the gap to another one.
_LEAP = 1e-6
# Number of flag changes per event for which there is room. Several flags may change at one event.
# If more change, the search for the orbit fails.
_CHANGES = 2


class FlagScan(NamedTuple):
    """Flags along a motion, at p instants in order of time.

    `tau` (p,): times (mesh periods); `flags` (p, f): the f flags of the equation; `counts` (p, f):
    whether each flag matters there; `roots` (e, s + 2, flanks): normal angles ν2 (rad) of the
    closest approach, for each of e elements at its s Gauss points and on both sides of its end;
    `pushes` (e, s + 2, flanks): whether the flanks transmit a force; `total`: number of instants in
    use.
    """

    tau: Float[Array, " p"]
    flags: Bool[Array, "p f"]
    counts: Bool[Array, "p f"]
    roots: Float[Array, "e q flanks"]
    pushes: Bool[Array, "e q flanks"]
    total: Int[Array, ""]


class Events(NamedTuple):
    """Events of a motion, in order of time.

    `times` (m,) in mesh periods (inf beyond the last); `which` (m,): index of the margin that is
    zero at each event, or `FIXED` or `UNSAID`; `count`: number of events; `new`: number of flag
    changes that are not at events of the mesh; `gone`: number of events of the mesh at which the
    flag does not change; `fits`: whether the arrays have room for all events.
    """

    times: Float[Array, " m"]
    which: Int[Array, " m"]
    count: Int[Array, ""]
    new: Int[Array, ""]
    gone: Int[Array, ""]
    fits: Bool[Array, ""]


def _roots(pair: RotorPair, margins: Margins) -> Float[Array, " flanks"]:
    """Return the normal angles ν2 (rad) of the closest approaches in `margins`, 0 if not known."""
    searches = type(innermost(pair.contact)) is SearchContact
    return margins.places.normal2 if searches else jnp.zeros(pair.flanks)


class Kinds(NamedTuple):
    """The meaning of a change of each of the f flags.

    `rank` (f,): if several flags change at one instant, that with the least rank determines the
    event. Flags of parts have rank 0, since the zeros of their margins are most accurate. Rank 1 is
    the jump to another minimum of the gap, because other flags change with it. The rank -1 marks a
    flag whose change is not an event. All other flags have greater ranks, in their order.
    `vague` (f,): whether the flag has no margin of its own, so that it does not tell how an event
    moves. `jump` (f,): index of the margin that is zero where the contact jumps, if the flag may
    change there, otherwise -1. `only` (f,): whether the flag's change is an event only if the
    contact jumps. `hand` (f,): index of the margin that is zero where the flank hands its contact
    over to the other flank of the lobe, if it may do so, otherwise -1. `flank` (f,): index of the
    flag's flank.
    """

    rank: Int[np.ndarray, " f"]
    vague: Bool[np.ndarray, " f"]
    jump: Int[np.ndarray, " f"]
    only: Bool[np.ndarray, " f"]
    hand: Int[np.ndarray, " f"]
    flank: Int[np.ndarray, " f"]


def kinds(pair: RotorPair) -> Kinds:
    """Return the meaning of changes of the flags of `pair`."""
    of_flank, others = _owners(pair)
    own, rest = (
        np.array([not has for has, count in some for _ in range(count)], bool)
        for some in (of_flank, others)
    )
    per, law, contact = len(own), of_flank[0][1], innermost(pair.contact)
    rank, only = 2 + np.arange(per), np.zeros(per, bool)
    jump, hand = np.full((2, per), -1)
    if type(contact) is SearchContact:
        rank[law] = -1
        hand[:] = -1 if contact.pair.rolling else law
        if contact.jumps:
            place = law + 2
            rank[place], jump[place : law + of_flank[1][1]] = 1, place
            only[place : place + 1 + RANKS] = contact.pair.profile.wavy
            # At another centre distance, a contact can also slide past the cusp.
            only[place] |= not contact.pair.rolling
    number = np.repeat(np.arange(pair.flanks), per)
    rows = (np.tile(row, pair.flanks) for row in (rank, own, jump, only, hand))
    rank, own, jump, only, hand = rows
    jump, hand = (np.where(row < 0, -1, row + per * number) for row in (jump, hand))
    of_pair = (0, rest, -1, False, -1, 0)
    rows = zip((rank, own, jump, only, hand, number), of_pair, strict=True)
    return Kinds(*(np.append(row, np.broadcast_to(last, rest.shape)) for row, last in rows))


def _owners(pair: RotorPair) -> tuple[list[tuple[bool, int]], list[tuple[bool, int]]]:
    """Return whether each owner of flags has margins, and the number of its flags, in their order.

    The first list is that of one flank: contact law, contact, and parts that rub. The second list
    is that of the pair: the sign of ε where it matters, and all parts."""
    nothing, state = jnp.zeros(()), jnp.zeros(pair.states)
    own = eqx.tree_at(lambda p: p.contact, pair, pair.contact.in_slice(jnp.zeros((), int)))

    def flags():
        motion, acting = own._moving(nothing, state)
        touch = touch_of(own, jnp.ones(()), motion)
        rubbing = [part for part in pair.all_parts if part.rubs]
        contact = own.contact.on_side(jnp.ones(()))
        of_flank = [
            margins_of(pair.law, nothing, nothing),
            margins_of(contact, touch.roll, touch.approach),
            *(margins_of(part, nothing, flags="drag_switches") for part in rubbing),
        ]
        return of_flank, [margins_of(part, motion, states) for part, states in acting]

    of_flank, others = jax.eval_shape(flags)
    rubbing = [has_margins(type(part), "drag_switches") for part in pair.all_parts if part.rubs]
    layers = [pair.contact]
    while isinstance(layers[-1], WrappedContact):
        layers.append(layers[-1].section)
    told = all(has_margins(type(layer)) for layer in layers)
    known = [has_margins(type(pair.law)), told, *rubbing]
    first = list(zip(known, (x.shape[0] for x in of_flank), strict=True))
    parts = [has_margins(type(part)) for part in pair.all_parts]
    last = list(zip(parts, (x.shape[0] for x in others), strict=True))
    return first, last if pair.two_sided else [(True, 1), *last]


@eqx.filter_jit
def look(pair: RotorPair, elements: Elements) -> FlagScan:
    """Evaluate the flags at the Gauss points of each element, on both sides of its end, and at its
    `extra` instants."""
    contact = innermost(pair.contact)
    if type(contact) is SearchContact:
        flanks = dataclasses.replace(contact.pair, together=True)
        grouped = dataclasses.replace(contact, pair=flanks)
        pair = eqx.tree_at(lambda pair: innermost(pair.contact), pair, grouped)
    mesh = elements.mesh
    tau, state = elements.places
    number = jnp.arange(mesh.left.shape[0])
    length = mesh.lengths
    more = mesh.ends[0][:, None] + length[:, None] * extra(elements)
    beside = jnp.minimum(length, length[jnp.where(number + 1 < mesh.used, number + 1, 0)])
    aside = jnp.minimum(_ASIDE[0], _ASIDE[1] * beside)
    end = tau[:, -1:] + aside[:, None] * jnp.asarray([-1.0, 1.0])
    slope = elements.slopes[:, -1:]
    ends = state[:, -1:] + slope * (end - tau[:, -1:])[..., None]
    inner = elements.inside(jnp.broadcast_to(number[:, None], more.shape), more)
    tau = jnp.concatenate([tau[:, :-1], end, more], axis=1)
    state = jnp.concatenate([state[:, :-1], ends, inner], axis=1)

    def evaluated(tau, state):
        margins = pair.margins(tau, state)
        return margins.values > 0, margins.counts, _roots(pair, margins), margins.pushes

    each = jax.vmap(jax.vmap(evaluated))
    *rows, roots, pushes = in_blocks(each, mesh.used, tau, state)
    total = mesh.used * tau.shape[1]
    order = jnp.argsort(tau, axis=1)
    rows = (jnp.take_along_axis(x, order[..., None], 1) for x in rows)
    flags, counts = (x.reshape(-1, x.shape[-1]) for x in rows)
    times = jnp.take_along_axis(tau, order, 1).ravel()
    kept = slice(-more.shape[1])
    return FlagScan(times, flags, counts, roots[:, kept], pushes[:, kept], total)


def extra(elements: Elements) -> Float[Array, "e 2"]:
    """Return two instants in each element, as fractions of its length, where a short touch shows.

    They lie beside the zero of ε, or else where ε is extreme and in the middle of the element.
    Without clearance, flanks may touch for a moment beside a change of sign of ε: after it if they
    are about to part, before it if they are about to meet."""
    begins, inside = elements.state[:, None, :2], elements.places[1][..., :2]
    relative, rate = jnp.moveaxis(jnp.concatenate([begins, inside], axis=1), -1, 0)
    (zero, crosses), (turn, turns) = (_zero(elements, x, k) for k, x in enumerate((relative, rate)))
    aside = _ASIDE[0] / jnp.maximum(elements.mesh.lengths, _ASIDE[0])
    beside = jnp.stack([zero - aside, zero + aside], axis=1)
    other = jnp.stack([jnp.where(turns, turn, 0.4), jnp.full_like(turn, 0.5)], axis=1)
    return jnp.clip(jnp.where(crosses[:, None], beside, other), *_WITHIN)


def _zero(elements: Elements, values: Float[Array, "e q"], state: int):
    """Return where a state is zero in each element, and whether it changes its sign there.

    `values`: those of the state number `state` at the start, the Gauss points and the end of each
    element. They are interpolated, and two steps of Newton's method follow."""
    places = jnp.asarray([0.0, *GAUSS.nodes, 1.0])
    crosses = values[:, :-1] * values[:, 1:] < 0
    first = jnp.argmax(crosses, axis=1)
    before, after = (jnp.take_along_axis(values, k[:, None], 1)[:, 0] for k in (first, first + 1))
    low, high = places[first], places[first + 1]
    share = low + (high - low) * before / jnp.where(before == after, 1.0, before - after)
    slopes, length = elements.slopes[..., state], elements.mesh.lengths
    for _ in range(2):
        value = values[:, 0] + length * jnp.sum(GAUSS.integrated(share) * slopes, axis=1)
        slope = length * jnp.sum(GAUSS.lagrange(share) * slopes, axis=1)
        share = jnp.clip(share - value / jnp.where(slope == 0, jnp.inf, slope), low, high)
    return share, jnp.any(crosses, axis=1)


def rooted(pair: RotorPair, elements: Elements, seen: FlagScan) -> Elements:
    """Return `elements` with `roots` from `seen`, the result of `look`.

    At the end of an element, the first root belongs to the side on which the flanks push. Where the
    contact jumps or is handed over, it belongs to the instant before the end. The second root, that
    of the minimum to which the contact may jump, belongs to the instant after the end. Both are
    extrapolated to the end: otherwise derivatives of a peak at a corner of the force would have a
    relative error of about 5e-6."""
    mesh, number = elements.mesh, jnp.arange(elements.state.shape[0])
    following = jnp.where(number + 1 < mesh.used, number + 1, 0)
    nodes = seen.roots[:, :POINTS]
    # Slopes at both ends of each element, with respect to the fraction of its length.
    leaving, entering = jnp.einsum("ms,esk->mek", GAUSS.derivative(jnp.asarray(_ENDS)), nodes)
    length = jnp.where(mesh.lengths > 0, mesh.lengths, 1.0)[:, None]
    before, after = leaving / length, (entering / length)[following]
    end = mesh.ends[1][:, None, None]
    aside = seen.tau.reshape(*number.shape, -1)[:, -2:, None] - end
    moved = seen.roots[:, POINTS:] - aside * jnp.stack([before, after], axis=1)
    own = seen.pushes[:, POINTS] | ~seen.pushes[:, POINTS + 1]
    kind = kinds(pair)
    jumps, hands = (np.unique(indices) for indices in (kind.jump, kind.hand))
    which = jnp.where(mesh.last, mesh.which[mesh.interval + 1], FIXED)
    own |= jnp.isin(which, hands[hands >= 0])[:, None]
    for flank, jump in enumerate(jumps[jumps >= 0]):
        own = own.at[:, flank].set(own[:, flank] | (which == jump))
    ends = jnp.stack([jnp.where(own, moved[:, 0], moved[:, 1]), moved[:, 1]], axis=-1)
    points = jnp.repeat(nodes[..., None], 2, axis=-1)
    return elements._replace(roots=jnp.concatenate([points, ends[:, None]], axis=1))


def apart(elements: Elements, seen: FlagScan) -> Float[Array, ""]:
    """Return the greatest difference (rad) between the roots of `elements` and those of a search.

    Roots are normal angles of the closest approach. Gauss points at which the flanks do not push
    are ignored. `seen`: result of `look`."""
    counts = seen.pushes[:, :POINTS] & elements.mesh.filled[:, None, None]
    away = jnp.abs(elements.roots[:, :POINTS, :, 0] - seen.roots[:, :POINTS])
    return jnp.max(jnp.where(counts, away, 0.0))


def _compared(
    pair: RotorPair, elements: Elements, seen: FlagScan
) -> tuple[Bool[Array, "p f"], Float[Array, " p"], Bool[Array, " m"], Int[Array, ""]]:
    """Return the flags `seen` along a motion, compared with the events of its mesh.

    The four results are `fresh` (p, f): whether a flag that matters changes after the instant, but
    not at an event of the mesh; `later` (p,): next instant (mesh periods); `held` (m,): whether the
    time of the mesh is an event at which its flag changes; `gone`: number of events of the mesh at
    which it does not."""
    mesh = elements.mesh
    places = seen.tau.shape[0]
    per = places // elements.state.shape[0]
    kind = kinds(pair)
    number = jnp.arange(places)
    after = jnp.where(number + 1 < seen.total, number + 1, 0)
    later = jnp.where(number + 1 < seen.total, seen.tau[after], seen.tau[0] + mesh.period)
    differ = (
        (seen.flags != seen.flags[after]) & (seen.counts | seen.counts[after]) & (kind.rank >= 0)
    )
    differ &= (number < seen.total)[:, None]
    # Find the instants on both sides of an element's end that is an event of the mesh.
    element, inside = number // per, number % per
    ends_at = jnp.where(mesh.last, mesh.interval + 1, mesh.times.shape[0] - 1)[element]
    real = mesh.last[element] & (mesh.times[ends_at] < mesh.times[-1]) & (element < mesh.used)
    declared = (inside == per - 2) & real & (number < seen.total)
    which = mesh.which[ends_at][:, None]
    # A jump and a handover show in any flag of their flank.
    flank = (which == kind.jump) | (which == kind.hand)
    tells = (which == np.arange(kind.rank.size)) | flank & (which >= 0)
    tells |= (which == UNSAID) & kind.vague
    kept = declared & ((which[:, 0] == FIXED) | jnp.any(differ & tells, axis=1))
    held = jnp.full(mesh.times.shape, False).at[jnp.where(kept, ends_at, 0)].set(True)
    gone = jnp.sum(declared & ~kept)
    return differ & ~kept[:, None], later, held.at[0].set(False), gone


def known_events(pair: RotorPair, mesh: Mesh) -> Events:
    """Return the events at which the elements of a `mesh` end."""
    real = jnp.arange(mesh.times.shape[0]) <= mesh.interval[mesh.used - 1]
    times, zero = jnp.where(real.at[0].set(False), mesh.times, jnp.inf), jnp.zeros((), int)
    merged = _merged(times, mesh.which, jnp.asarray(kinds(pair).rank))
    return Events(*merged, zero, zero, jnp.ones((), bool))


@eqx.filter_jit
def found_events(pair: RotorPair, elements: Elements, seen: FlagScan) -> Events:
    """Return the events of the motion `elements`, whose flags are `seen`.

    If the flags change exactly at the events of the mesh, return a placeholder, to save the time of
    locating them: `known_events` returns these events."""
    fresh, later, held, gone = _compared(pair, elements, seen)

    def located():
        return _located(pair, elements, seen, fresh, later, held, gone)

    return branch(jnp.any(fresh) | (gone > 0), located, lambda: empty_like(located))


def empty_like(function: Callable[[], Any]) -> Any:
    """Return zeros in place of the result of `function`."""
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(function))


def _located(pair: RotorPair, elements: Elements, seen: FlagScan, fresh, later, held, gone):
    """Return the result of `found_events` if flags change elsewhere than at events of the mesh.

    `fresh`, `later`, `held`, `gone`: results of `_compared`."""
    mesh, kind = elements.mesh, jax.tree.map(jnp.asarray, kinds(pair))
    room = mesh.times.shape[0]
    most = _CHANGES * room
    # Choose the instants first: choosing among all flags of all instants takes ten times as long.
    some = jnp.nonzero(jnp.any(fresh, axis=1), size=most, fill_value=fresh.shape[0])[0]
    changes = fresh.at[some].get(mode="fill", fill_value=False)
    row, flag = jnp.nonzero(changes, size=most, fill_value=0)
    place = jnp.minimum(some[row], fresh.shape[0] - 1)
    number = jnp.sum(fresh)
    value, flank = seen.flags[place, flag], kind.flank[flag]

    def locate(k, events):
        def margin(tau):
            margins = pair.margins(tau, elements.motion(tau))
            return margins.values[flag[k]], _roots(pair, margins)[flank[k]]

        results = zero_of(margin, seen.tau[place[k]], later[place[k]], value[k])
        return jax.tree.map(lambda old, x: old.at[k].set(x), events, results)

    nothing = jnp.zeros(most, seen.tau.dtype)
    start = jnp.full_like(nothing, jnp.inf), nothing, nothing
    located, before, after = lax.fori_loop(0, jnp.minimum(number, most), locate, start)
    jump, leap = kind.jump[flag], jnp.abs(after - before) > _LEAP
    located = jnp.where(kind.only[flag] & ~leap, jnp.inf, located)
    new = jnp.sum(located < jnp.inf)
    times = jnp.concatenate([located, jnp.where(held, mesh.times, jnp.inf)])
    which = jnp.where(leap & (jump >= 0), jump, flag)
    if isinstance(contact := innermost(pair.contact), SearchContact):
        # A handover is an event of the flank that the contact leaves at the lobe's axis.
        leaves = leap & (jnp.abs(before - contact.pair.nodes.normal[0]) < _LEAP)
        which = jnp.where(leaves & (kind.hand[flag] >= 0), kind.hand[flag], which)
    which = jnp.concatenate([jnp.where(kind.vague[flag], UNSAID, which), mesh.which])
    times, which, count = _merged(times, which, kind.rank)
    fits = (number <= most) & (count <= room - 3)
    return Events(times[:room], which[:room], count, new, gone, fits)


def _merged(times, which, rank):
    """Sort events by time, and merge those at the same instant.

    `times`: inf for missing events; `which`: index of each event's margin, `FIXED` or `UNSAID`;
    `rank`: see `Kinds`. Return the merged times and margins, and the number of events."""
    importance = jnp.where(which == UNSAID, rank.shape[0] + 2, jnp.maximum(rank[which], 0))
    importance = jnp.where(which == FIXED, -1, importance)
    order = jnp.lexsort((importance, times))
    times, which, importance = times[order], which[order], importance[order]
    real = times < jnp.inf
    apart = jnp.diff(jnp.where(real, times, 1e30), prepend=-1e30) > _SAME
    group = jnp.cumsum(apart) - 1
    least = jax.ops.segment_min(importance, group, times.shape[0])
    chosen = real & (importance == least[group])
    # Keep one event of each group.
    first = jnp.cumsum(chosen) - 1
    begun = jax.ops.segment_min(jnp.where(chosen, first, times.shape[0]), group, times.shape[0])
    chosen &= first == begun[group]
    order = jnp.argsort(jnp.where(chosen, times, jnp.inf))
    count = jnp.sum(chosen)
    times = jnp.where(jnp.arange(times.shape[0]) < count, times[order], jnp.inf)
    return times, jnp.where(times < jnp.inf, which[order], -1), count
