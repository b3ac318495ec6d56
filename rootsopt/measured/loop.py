"""Closed outlines: joined from a drawing's entities, and the small loops in which they cross.

A chain is the points on one entity. A vertex is a place where ends of chains meet. A link is a
chain whose two ends are at different vertices.

Calls to libraries that read a user's files are guarded: any exception they raise becomes an
`InputError`, with the exception as its cause, and their log records and warnings stay off the
console. Guards cover hardly more than such calls, because an error of this package would otherwise
appear as a fault of the file."""

import contextlib
import dataclasses
import itertools
import logging
import warnings
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Complex128, Float64
from numpy.typing import NDArray

from rootsopt.config.units import named
from rootsopt.errors import InputError

# Turn (rad) at a point above which the outline runs back there.
_CUSP = 2.0

# Distance between two cusps (fraction of the path between them) below which they form no tail.
_STRAIGHT = 0.8

# Number of points on each side of a tail that are searched for its crossing.
_BESIDE = 1000


@dataclasses.dataclass(frozen=True)
class Loop:
    """The points of a closed outline in order; the first point is not repeated at the end.

    `points` (n,): points (mm) as x + iy; `joints` (n,): mask of the points at the ends of arcs and
    splines, where curvature may jump; `unit`: length (mm) of the file's unit; `gap`: width (mm) of
    the widest gap between entities that was closed, and its place; `notes`: sentences for the user
    on what the reader converted, chose or changed. The readers also use this class for open chains
    of points.
    """

    points: Complex128[np.ndarray, " n"]
    joints: Bool[np.ndarray, " n"]
    unit: float = 1.0
    gap: tuple[float, complex] = (0.0, 0j)
    notes: tuple[str, ...] = ()


def signed_area(points: Complex128[np.ndarray, " n"]) -> float:
    """Return the area (mm²) of the closed polygon with the corners `points` (mm, as x + iy).

    The area is positive if the polygon runs counter-clockwise."""
    return float(np.sum(np.imag(np.conj(points) * np.roll(points, -1)))) / 2


def moment(points: Complex128[np.ndarray, " n"], order: int) -> complex:
    """Return ∬ z^order dA of a polygon, exactly, with the corners `points` (z = x + iy).

    By Green's theorem, the moment is ∮ z̄ z^order dz / 2i."""
    step = np.roll(points, -1) - points
    nodes, weights = np.polynomial.legendre.leggauss(order // 2 + 2)
    z = points[:, None] + step[:, None] * (1 + nodes) / 2
    return np.sum(np.conj(z) * z**order * step[:, None] * weights / 2) / 2j


def lengths_along(points: Complex128[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return the length (mm) of the polygonal line from its first point to each of its `points`."""
    return np.append(0.0, np.cumsum(np.abs(np.diff(points))))


Tail = tuple[NDArray[np.intp], complex, float]
"""A swallow-tail, in which the outline runs forth, back and forth again between two cusps: indices
of the points that trimming removes, crossing of the two forward runs (mm, as x + iy), and distance
(mm) between the cusps."""


def tails(points: Complex128[np.ndarray, " n"], most: int) -> list[Tail]:
    """Return the swallow-tails of a closed outline.

    There are none if more than `most` points are cusps: these are scattered."""
    steps, count = np.roll(points, -1) - points, len(points)
    cusps = np.flatnonzero(np.abs(np.angle(steps / np.roll(steps, 1))) > _CUSP)
    if not 2 <= len(cusps) <= most:
        return []
    # Begin after the widest stretch without cusps, so that the two cusps of a tail are neighbours.
    gaps = np.diff(cusps, append=cusps[0] + count)
    begin = cusps[np.argmax(gaps)] + np.max(gaps) // 2
    reach = min(_BESIDE, count // 4)
    swallow_tails: list[Tail] = []
    free = 0  # First index that belongs to no tail yet.
    for i, j in itertools.pairwise(np.sort((cusps - begin) % count).tolist()):
        if i < free or j - i >= reach:
            continue
        index = (begin + np.arange(i - reach, j + reach + 1)) % count
        run = np.diff(points[index][reach - 1 : reach + j - i + 1])
        # Between the cusps, the outline runs back along the step to the first, without turns.
        back = np.all(np.real(run[1:] * np.conj(run[0])) < 0)
        direct = abs(np.sum(run[1:])) > _STRAIGHT * np.sum(np.abs(run[1:]))
        if back and direct:
            swallow_tails.append(_tail(points[index], index, reach, reach + j - i))
            free = j + 1
    return swallow_tails


def _tail(z: NDArray[np.complex128], index: NDArray[np.intp], i: int, j: int) -> Tail:
    """Return the swallow-tail between the cusps `i` and `j` of the points `z`.

    `index`: indices of these points in the outline."""
    ahead = np.real((z - z[i]) * np.conj(z[i] - z[i - 1]))
    # The last point before the stretch that is passed three times, and the first point after it.
    p = i - 1 - int(np.argmax(np.append(ahead[i - 1 :: -1] < np.min(ahead[i : j + 1]), True)))
    q = j + int(np.argmax(np.append(ahead[j:-1] > np.max(ahead[i : j + 1]), True)))
    p, size = max(p, 0), float(np.max(np.abs(z[i : j + 1] - z[i])))
    one, other = np.arange(p, i)[:, None], np.arange(j, q)[None, :]
    along, across, apart = z[one + 1] - z[one], z[other + 1] - z[other], z[other] - z[one]
    with np.errstate(all="ignore"):
        area = np.imag(np.conj(along) * across)
        first = np.imag(np.conj(apart) * across) / area
        second = np.imag(np.conj(apart) * along) / area
    hits = np.argwhere((first >= 0) & (first < 1) & (second >= 0) & (second < 1))
    if len(hits) == 0:  # Too thin for a crossing: the runs lie on one another.
        return index[p + 1 : q], complex(z[i] + z[j]) / 2, size
    k, m = hits[0]
    at = complex(z[p + k] + first[k, m] * along[k, 0])
    return index[p + k + 1 : j + m + 1], at, size


def place(z: complex) -> str:
    """Format a point `z` = x + iy (mm) as text for a message."""
    return f"({z.real:.5g}, {z.imag:.5g}) mm"


JOIN = 1e-3
"""Default distance (mm) below which two ends of entities share a vertex."""
_ALONE = "draw the outline alone on a layer OUTLINE"

# Number of other points within the joining distance of a point, on average, above which a drawing
# is rejected. The points are the ends of all chains, or those of `_distinct`. Points at the same
# place count once.
_CROWDED = 50


def joined(
    chains: list[Loop], name: str, join: float = JOIN
) -> tuple[list[Loop], InputError | None]:
    """Join `chains` of points at their ends; return (closed loops, fault of the drawing).

    A chain may run in either direction. A chain given twice counts once. Chains that lead to a dead
    end, such as centre lines, belong to no loop. `name`: name of the drawing in messages; `join`:
    distance (mm) below which ends meet.

    The fault applies if none of the loops is the rotor. It is not `None` in three cases: there is
    no closed loop; open chains, if closed, would enclose a larger area than any loop; more than two
    ends meet at a vertex of a possible outline. Raises `InputError` if too many ends are close
    together.

    The library's `edgeminer` also finds chains, but keeps dead ends. Its time grows with the square
    of the number of ends at one place (as in a dial)."""
    ends = np.array([chain.points[[0, -1]] for chain in chains]).reshape(-1, 2)
    vertex = _clusters(ends.ravel(), name, join).reshape(-1, 2)
    single = vertex[:, 0] == vertex[:, 1]
    loops = [
        _connected([chains[k]])
        for k in np.flatnonzero(single)
        if len(chains[k].points) > 2 and lengths_along(chains[k].points)[-1] > 2 * join
    ]
    links = _distinct(chains, vertex, np.flatnonzero(~single), name, join)
    inner = _in_loops(vertex, links)
    branched = []
    for members in _groups(vertex, inner):
        if np.max(np.bincount(vertex[members].ravel())) > 2:
            branched.append(members)
        else:
            loops.append(_connected(_walked(chains, members, vertex)))
    best = max((loop.points for loop in loops), key=lambda z: abs(signed_area(z)), default=None)
    for members in branched:
        whole = np.concatenate([chains[k].points for k in members])
        if best is None or _extent(whole) >= _extent(best):
            degree = np.bincount(vertex[members].ravel())
            branch = int(np.argmax(degree > 2))
            at = complex(ends[vertex == branch][0])
            return loops, InputError(
                f"{name}: an outline must not branch, but {degree[branch]} ends meet at "
                f"{place(at)}; remove the entities that do not belong to it, or {_ALONE}"
            )
    must = f"{name}: the outline must be closed within {join:g} mm (`profile.outline_join_mm`), but"
    if best is None:
        gap, at = _widest_gap(ends, vertex, links if len(links) else np.arange(len(chains)))
        return loops, InputError(
            f"{must} the entities form no closed loop (widest gap {gap:.4g} mm, at {place(at)}); "
            f"join them in the drawing, or {_ALONE}"
        )
    for members in _groups(vertex, np.setdiff1d(links, inner)):
        if len(members) < 3 or np.max(np.bincount(vertex[members].ravel())) > 2:
            continue
        around = np.concatenate([part.points for part in _walked(chains, members, vertex)])
        if abs(signed_area(around)) > abs(signed_area(best)):
            gap, at = _widest_gap(ends, vertex, members)
            return loops, InputError(
                f"{must} {len(members)} entities that enclose more than any closed loop have a gap "
                f"of {gap:.4g} mm at {place(at)}; join them in the drawing, or {_ALONE}"
            )
    return loops, None


def _extent(points: NDArray[np.complex128]) -> float:
    return float(np.hypot(np.ptp(points.real), np.ptp(points.imag)))


def _clusters(points: NDArray[np.complex128], name: str, join: float) -> NDArray[np.intp]:
    """Return the index of the cluster of each point. Points closer than `join` share a cluster.

    Raises `InputError` if too many points are close together."""
    unique, which = np.unique(points, return_inverse=True)
    from scipy.spatial import KDTree  # Slow import.

    tree = KDTree(np.stack([unique.real, unique.imag], axis=1))
    # Count the pairs before listing them: there may be n².
    if tree.count_neighbors(tree, join) > (1 + _CROWDED) * len(unique):
        raise InputError(
            f"{name}: ends of entities must be farther apart than {join:g} mm, but many are "
            "closer; check the drawing's units, or draw longer entities"
        )
    return _components(tree.query_pairs(join, output_type="ndarray"), len(unique))[which]


def _components(pairs: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    from scipy.sparse import coo_array, csgraph  # Slow import.

    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    return csgraph.connected_components(graph, directed=False)[1].astype(np.intp)


def _distinct(
    chains: list[Loop], vertex: NDArray[np.intp], links: NDArray[np.intp], name: str, join: float
) -> NDArray[np.intp]:
    """Return the `links` without those that repeat an earlier one.

    `vertex` (n, 2): indices of the vertices at each chain's ends; `name`, `join`: as in `joined`. A
    link repeats another if the ends and the points at quarters of the length of both coincide."""
    if not len(links):
        return links
    quarters = []
    for link in links:
        z = chains[link].points[:: 1 if vertex[link, 0] < vertex[link, 1] else -1]
        way = lengths_along(z)
        quarters.append(np.interp(way[-1] * np.array([0.25, 0.5, 0.75]), way, z))
    between = _clusters(np.ravel(quarters), name, join).reshape(len(links), -1)
    rows = np.concatenate([np.sort(vertex[links], axis=1), between], axis=1)
    return links[np.sort(np.unique(rows, axis=0, return_index=True)[1])]


def _in_loops(vertex: NDArray[np.intp], links: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the `links` that remain after repeatedly removing links at dead ends.

    `vertex` (n, 2): indices of the vertices at each chain's ends."""
    degree = np.bincount(vertex[links].ravel(), minlength=1)
    # The exclusive or of the links at a vertex: at a dead end it is the only link.
    met = np.zeros(len(degree), np.intp)
    np.bitwise_xor.at(met, vertex[links], links[:, None])
    dead = set()
    for end in np.flatnonzero(degree == 1).tolist():
        while degree[end] == 1:
            link = met[end]
            dead.add(int(link))
            degree[vertex[link]] -= 1
            met[vertex[link]] ^= link
            end = vertex[link].sum() - end
    return np.array([link for link in links.tolist() if link not in dead], np.intp)


def _groups(vertex: NDArray[np.intp], links: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return the `links` in each connected group, groups in order of their first link.

    `vertex` (n, 2): indices of the vertices at each chain's ends."""
    if not len(links):
        return []
    part = _components(vertex[links], int(np.max(vertex)) + 1)[vertex[links, 0]]
    order = np.argsort(part, kind="stable")
    groups = np.split(links[order], np.flatnonzero(np.diff(part[order])) + 1)
    return sorted(groups, key=lambda group: group[0])


def _walked(chains: list[Loop], members: NDArray[np.intp], vertex: NDArray[np.intp]) -> list[Loop]:
    """Return the chains along a loop or an open path, turned into its direction.

    `members`: indices of the links, in any order; `vertex` (n, 2): indices of the vertices at each
    chain's ends."""
    met: dict[int, int] = {}  # Exclusive or of the links at each vertex, as in `_in_loops`.
    open_ends: set[int] = set()
    for link in members.tolist():
        for end in vertex[link].tolist():
            met[end] = met.get(end, 0) ^ link
            open_ends ^= {end}
    start = min(open_ends, default=int(vertex[members[0], 0]))
    link = met[start] if open_ends else int(members[0])
    parts = []
    for _ in members:
        own, way = chains[link], 1 if vertex[link, 0] == start else -1
        parts.append(Loop(own.points[::way], own.joints[::way], own.unit))
        start = int(vertex[link].sum()) - start
        link ^= met[start]
    return parts


def _connected(parts: list[Loop]) -> Loop:
    """Return successive chains as a loop, as the last one ends where the first begins.

    Each gap between ends is closed from both sides in equal shares. Both chains are shifted by an
    amount that varies linearly along their length, as in surveying. Moving the end points alone
    would bend the curve there. The point that two chains share is kept once, as a joint if either
    chain has it as a joint."""
    ahead = parts[1:] + parts[:1]
    gaps = np.array([b.points[0] - a.points[-1] for a, b in zip(parts, ahead, strict=True)])
    points, joints = [], []
    for k, part in enumerate(parts):
        way, first, last = lengths_along(part.points), -gaps[k - 1] / 2, gaps[k] / 2
        points.append((part.points + first + (last - first) * way / way[-1])[:-1])
        joints.append(part.joints[:-1].copy())
        joints[-1][0] |= parts[k - 1].joints[-1]
    widest = int(np.argmax(np.abs(gaps)))
    gap = float(abs(gaps[widest])), complex(parts[widest].points[-1])
    return Loop(np.concatenate(points), np.concatenate(joints), parts[0].unit, gap)


def _widest_gap(
    ends: NDArray[np.complex128], vertex: NDArray[np.intp], links: NDArray[np.intp]
) -> tuple[float, complex]:
    """Return the widest gap (mm) between dead ends, and the dead end (mm) where it begins.

    `ends`, `vertex` (n, 2): points (mm) and vertices at each chain's ends; `links`: indices of the
    chains that count. A dead end is an end of these chains that shares its vertex with no other.
    Its gap is the distance to the nearest other dead end. With fewer than two dead ends, the gap is
    0 and the point is the first of `ends`."""
    numbers = vertex[links].ravel()
    places = ends[links].ravel()[np.bincount(numbers)[numbers] == 1]
    if len(places) < 2:
        return 0.0, complex(ends[0, 0])
    from scipy.spatial import KDTree  # Slow import.

    tree = KDTree(np.stack([places.real, places.imag], axis=1))
    away = tree.query(tree.data, k=2)[0][:, 1]
    widest = int(np.argmax(away))
    return float(away[widest]), complex(places[widest])


# Number of characters above which a library's own message is shortened.
_REASON = 120


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Suppress a library's log records and warnings in the `with` block, also those of NumPy."""
    logger = logging.getLogger("ezdxf")
    level = logger.level
    if level > logging.CRITICAL:  # Nested: entering again is slow for thousands of entities.
        yield
        return
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def guarded(name: str, fault: str, remedy: str) -> Iterator[None]:
    """Turn any exception in the `with` block, which calls a library, into an `InputError`.

    The message reads "`name`: `fault`: (the exception's message); `remedy`". `MemoryError` and
    `RecursionError` are converted, too; an `InputError` passes unchanged."""
    try:
        with silenced():
            yield
    except InputError:
        raise
    except Exception as error:
        reason = named(" ".join(str(error).split()), _REASON)
        if not reason or isinstance(error, KeyError):
            reason = f"{type(error).__name__} {reason}".strip()
        raise InputError(f"{name}: {fault}: {reason}; {remedy}") from error
