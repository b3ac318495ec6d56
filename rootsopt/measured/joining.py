"""Joins a drawing's entities into closed loops.

A chain is the points on one entity. A vertex is a place where ends of chains meet. A link is a
chain whose two ends are at different vertices.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from rootsopt.errors import InputError
from rootsopt.measured.loop import Loop, place, signed_area

JOIN = 1e-3
"""Default distance (mm) below which two ends of entities share a vertex."""
_ALONE = "draw the outline alone on a layer OUTLINE"
_CROWDED = 50
"""Number of other points within the joining distance of a point, on average, above which a drawing
is rejected. The points are the ends of all chains, or those of `_quarters`. Points at the same
place count once."""


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
    together."""
    ends = np.array([chain.points[[0, -1]] for chain in chains]).reshape(-1, 2)
    vertex = _clusters(ends.ravel(), name, join).reshape(-1, 2)
    lengths = np.array([np.sum(np.abs(np.diff(chain.points))) for chain in chains])
    alone = (vertex[:, 0] == vertex[:, 1]) & (lengths > 2 * join)
    alone &= np.array([len(chain.points) > 2 for chain in chains], bool)
    loops = [_connected([c], closed=True) for c in _where(chains, alone)]
    links = np.flatnonzero(vertex[:, 0] != vertex[:, 1])
    links = links[_first_of_each(_where(chains, links), vertex[links], name, join)]
    inner = links[_in_loops(vertex[links])]
    branched: list[tuple[NDArray, int]] = []
    for group in _groups(vertex[inner]):
        members = inner[group]
        branches = np.flatnonzero(np.bincount(vertex[members].ravel()) > 2)
        if len(branches):
            branched.append((members, int(branches[0])))
        else:
            loops.append(_walked(chains, members, vertex))
    best = max(loops, key=lambda loop: abs(signed_area(loop.points)), default=None)
    for members, branch in branched:
        whole = np.concatenate([c.points for c in _where(chains, members)])
        if best is None or _extent(whole) >= _extent(best.points):
            at = complex(ends.ravel()[np.flatnonzero(vertex.ravel() == branch)[0]])
            return loops, InputError(
                f"{name}: an outline must not branch, but "
                f"{np.count_nonzero(vertex[members] == branch)} ends meet at {place(at)}; remove "
                f"the entities that do not belong to it, or {_ALONE}"
            )
    dead = np.setdiff1d(links, inner)
    if best is None:
        gap, at = _widest_gap(ends, vertex, links if len(links) else np.arange(len(chains)))
        return loops, InputError(
            f"{name}: the outline must be closed within {join:g} mm (`profile.outline_join_mm`), "
            f"but the entities form no closed loop (widest gap {gap:.4g} mm, at {place(at)}); join "
            f"them in the drawing, or {_ALONE}"
        )
    for group in _groups(vertex[dead]):
        members = dead[group]
        if len(members) < 3 or np.max(np.bincount(vertex[members].ravel())) > 2:
            continue
        around = _walked(chains, members, vertex).points
        if abs(signed_area(around)) > abs(signed_area(best.points)):
            gap, at = _widest_gap(ends, vertex, members)
            return loops, InputError(
                f"{name}: the outline must be closed within {join:g} mm "
                f"(`profile.outline_join_mm`), but {len(members)} entities that enclose more than "
                f"any closed loop have a gap of {gap:.4g} mm at {place(at)}; join them in the "
                f"drawing, or {_ALONE}"
            )
    return loops, None


def _where(chains: list[Loop], which: NDArray) -> list[Loop]:
    which = np.flatnonzero(which) if which.dtype == bool else which
    return [chains[k] for k in which]


def _extent(points: NDArray[np.complex128]) -> float:
    return float(np.hypot(np.ptp(points.real), np.ptp(points.imag)))


def _clusters(points: NDArray[np.complex128], name: str, join: float) -> NDArray[np.intp]:
    """Return the index of the cluster of each point. Points closer than `join` share a cluster.

    Raises `InputError` if too many points are close together."""
    unique, which = np.unique(points, return_inverse=True)
    tree = KDTree(np.stack([unique.real, unique.imag], axis=1))
    # Count the pairs before listing them: there may be n².
    if tree.count_neighbors(tree, join) > (1 + _CROWDED) * len(unique):
        raise InputError(
            f"{name}: ends of entities must be farther apart than {join:g} mm, but many are "
            "closer; check the drawing's units, or draw longer entities"
        )
    pairs = tree.query_pairs(join, output_type="ndarray")
    return _components(pairs, len(unique))[which]


def _components(pairs: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.intp)


def _first_of_each(
    chains: list[Loop], vertex: NDArray[np.intp], name: str, join: float
) -> NDArray[np.intp]:
    """Return the indices of the chains that do not repeat an earlier chain.

    `vertex` (n, 2): indices of the vertices at each chain's ends; `name`, `join`: as in `joined`. A
    chain repeats another if the ends and the points of `_quarters` of both coincide."""
    if not chains:
        return np.zeros(0, np.intp)
    quarters = np.array(
        [
            _quarters(chain.points, a > b)
            for chain, (a, b) in zip(chains, vertex.tolist(), strict=True)
        ]
    )
    between = _clusters(quarters.ravel(), name, join).reshape(len(chains), -1)
    rows = np.concatenate([np.sort(vertex, axis=1), between], axis=1)
    return np.sort(np.unique(rows, axis=0, return_index=True)[1])


def _quarters(points: NDArray[np.complex128], backwards: bool) -> NDArray[np.complex128]:
    """Return the points (3,) at 1/4, 1/2 and 3/4 of a chain's length.

    `backwards`: whether the length is measured from the last point."""
    points = points[::-1] if backwards else points
    if len(points) == 2:
        return points[0] + (points[1] - points[0]) * np.array([0.25, 0.5, 0.75])
    way = np.append(0.0, np.cumsum(np.abs(np.diff(points))))
    return np.interp(way[-1] * np.array([0.25, 0.5, 0.75]), way, points)


def _in_loops(vertex: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the indices of the links that remain after repeatedly removing links at dead ends.

    `vertex` (n, 2): indices of the vertices at each link's ends."""
    at: dict[int, set[int]] = {}
    for link, (a, b) in enumerate(vertex.tolist()):
        at.setdefault(a, set()).add(link)
        at.setdefault(b, set()).add(link)
    ends = [v for v, links in at.items() if len(links) == 1]
    while ends:
        links = at[ends.pop()]
        if not links:
            continue
        link = links.pop()
        for v in vertex[link].tolist():
            at[v].discard(link)
            if len(at[v]) == 1:
                ends.append(v)
    return np.array(sorted(set().union(*at.values())), np.intp)


def _groups(vertex: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return the indices of the links in each connected group.

    `vertex` (n, 2): indices of the vertices at each link's ends. Groups are ordered by the first
    index in each."""
    if not len(vertex):
        return []
    _, which = np.unique(vertex, return_inverse=True)
    which = which.reshape(-1, 2)
    part = _components(which, int(np.max(which)) + 1)[which[:, 0]]
    order = np.argsort(part, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(part[order])) + 1)
    return sorted(groups, key=lambda group: group[0])


def _walked(chains: list[Loop], members: NDArray[np.intp], vertex: NDArray[np.intp]) -> Loop:
    """Return the loop or the open path along some links in `chains`.

    `members`: indices of the links, in any order; `vertex` (n, 2): indices of the vertices at each
    chain's ends."""
    at: dict[int, list[int]] = {}
    for link in members.tolist():
        for v in vertex[link].tolist():
            at.setdefault(v, []).append(link)
    open_ends = [v for v, links in at.items() if len(links) == 1]
    link = at[open_ends[0]][0] if open_ends else int(members[0])
    start = open_ends[0] if open_ends else int(vertex[link, 0])
    parts = []
    for _ in range(len(members)):
        a, b = vertex[link].tolist()
        way = slice(None) if a == start else slice(None, None, -1)
        start = b if a == start else a
        own = chains[link]
        parts.append(Loop(own.points[way], own.joints[way], own.unit))
        link = next((k for k in at[start] if k != link), -1)
    return _connected(parts, closed=not open_ends)


def _connected(parts: list[Loop], closed: bool) -> Loop:
    """Return successive chains as one; `closed`: whether the last one ends where the first begins.

    Each gap between ends is closed from both sides in equal shares. Both chains are shifted by an
    amount that varies linearly along their length, as surveyors do, because moving the end points
    alone would bend the curve there. The point that two chains share is kept once, as a joint if
    either chain has it as a joint."""
    starts = np.array([part.points[0] for part in parts])
    stops = np.array([part.points[-1] for part in parts])
    gaps = np.roll(starts, -1) - stops
    if not closed:
        gaps[-1] = 0
    points, joints = [], []
    for k, part in enumerate(parts):
        joints.append(part.joints.copy())
        joints[-1][0] |= parts[k - 1].joints[-1] and (closed or k > 0)
        points.append(_shifted(part.points, -gaps[k - 1] / 2, gaps[k] / 2))
    last = slice(None) if closed else slice(len(parts) - 1)
    points[last], joints[last] = ([x[:-1] for x in each[last]] for each in (points, joints))
    widest = int(np.argmax(np.abs(gaps)))
    gap = float(abs(gaps[widest])), complex(stops[widest])
    return Loop(np.concatenate(points), np.concatenate(joints), parts[0].unit, gap)


def _shifted(points: NDArray[np.complex128], first: complex, last: complex) -> NDArray:
    """Return points along a chain, shifted by `first` at its start and by `last` at its end."""
    if first == last == 0:
        return points
    way = np.append(0.0, np.cumsum(np.abs(np.diff(points))))
    return points + first + (last - first) * way / way[-1]


def _widest_gap(
    ends: NDArray[np.complex128], vertex: NDArray[np.intp], links: NDArray[np.intp]
) -> tuple[float, complex]:
    """Return the widest gap (mm) between dead ends, and the dead end (mm) where it begins.

    `ends`, `vertex` (n, 2): points (mm) and vertices at each chain's ends; `links`: indices of the
    chains that count. A dead end is an end of these chains that shares its vertex with no other.
    Its gap is the distance to the nearest other dead end. With fewer than two dead ends, the gap is
    0 and the point is the first of `ends`."""
    places = ends[links].ravel()
    numbers = vertex[links].ravel()
    single = np.flatnonzero(np.bincount(numbers)[numbers] == 1)
    places = places[single]
    if len(places) < 2:
        return 0.0, complex(ends[0, 0])
    tree = KDTree(np.stack([places.real, places.imag], axis=1))
    away = tree.query(tree.data, k=2)[0][:, 1]
    widest = int(np.argmax(away))
    return float(away[widest]), complex(places[widest])
