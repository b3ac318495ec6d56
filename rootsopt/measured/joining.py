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

TOGETHER = 1e-3
"""Distance (mm) below which two ends of entities share a vertex."""
_CROWDED = 50
"""Number of other points within `TOGETHER` of a point, on average, above which a drawing is
rejected. The points are the ends of all chains, or those of `_quarters`. Points at the same place
count once."""


def joined(chains: list[Loop], layer: str, name: str) -> Loop:
    """Join `chains` of points at their ends; return the closed loop of the largest area.

    A chain may run in either direction. A chain given twice counts once. Chains that lead to a dead
    end, such as centre lines, belong to no loop. `layer`: layer that messages recommend for the
    outline; `name`: name of the drawing in messages.

    Raises `InputError` in four cases: there is no closed loop; open chains, if closed, would
    enclose a larger area than any loop; more than two ends meet at a vertex of a possible outline;
    too many ends are close together.
    """
    remedy = f"join them in the drawing, on a layer {layer}"
    ends = np.array([chain.points[[0, -1]] for chain in chains]).reshape(-1, 2)
    vertex = _clusters(ends.ravel(), name).reshape(-1, 2)
    lengths = np.array([np.sum(np.abs(np.diff(chain.points))) for chain in chains])
    alone = (vertex[:, 0] == vertex[:, 1]) & (lengths > 2 * TOGETHER)
    alone &= np.array([len(chain.points) > 2 for chain in chains], bool)
    loops = [Loop(c.points[:-1], _closing(c.joints)) for c in _where(chains, alone)]
    links = np.flatnonzero(vertex[:, 0] != vertex[:, 1])
    links = links[_first_of_each(_where(chains, links), vertex[links], name)]
    inner = links[_in_loops(vertex[links])]
    clear, tangled = [], []
    for group in _groups(vertex[inner]):
        members = inner[group]
        branches = np.flatnonzero(np.bincount(vertex[members].ravel()) > 2)
        (tangled if len(branches) else clear).append((members, branches))
    for members, _ in clear:
        points, joints = _walked(chains, members, vertex)
        loops.append(Loop(points[:-1], _closing(joints)))
    best = max(loops, key=lambda loop: abs(signed_area(loop.points)), default=None)
    size = _extent(best.points) if best else 0.0
    for members, branches in tangled:
        if _extent(np.concatenate([c.points for c in _where(chains, members)])) >= size:
            at = ends.ravel()[np.flatnonzero(vertex.ravel() == branches[0])[0]]
            meeting = np.count_nonzero(vertex[members] == branches[0])
            raise InputError(
                f"{name}: an outline must not branch, but {meeting} ends meet at "
                f"{place(complex(at))}; remove the entities that do not belong to it, or draw it "
                f"on a layer {layer}"
            )
    dead = np.setdiff1d(links, inner)
    if best is None:
        gap, at = _widest_gap(ends, vertex, links if len(links) else np.arange(len(chains)))
        raise InputError(
            f"{name}: the outline must be closed within {TOGETHER:g} mm, but the entities form no "
            f"closed loop (widest gap {gap:.4g} mm, at {place(at)}); {remedy}"
        )
    for group in _groups(vertex[dead]):
        members = dead[group]
        if len(members) < 3 or np.max(np.bincount(vertex[members].ravel())) > 2:
            continue
        if abs(signed_area(_walked(chains, members, vertex)[0])) > abs(signed_area(best.points)):
            gap, at = _widest_gap(ends, vertex, members)
            raise InputError(
                f"{name}: the outline must be closed within {TOGETHER:g} mm, but {len(members)} "
                f"entities that enclose more than any closed loop have a gap of {gap:.4g} mm at "
                f"{place(complex(at))}; {remedy}"
            )
    return best


def _where(chains: list[Loop], which: NDArray) -> list[Loop]:
    which = np.flatnonzero(which) if which.dtype == bool else which
    return [chains[k] for k in which]


def _closing(joints: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask of a closed chain's joints without its last point, which repeats the first.

    The first point becomes a joint if it or the last point is one."""
    joints = joints.copy()
    joints[0] |= joints[-1]
    return joints[:-1]


def _extent(points: NDArray[np.complex128]) -> float:
    return float(np.hypot(np.ptp(points.real), np.ptp(points.imag)))


def _clusters(points: NDArray[np.complex128], name: str) -> NDArray[np.intp]:
    """Return the index of the cluster of each point. Points closer than `TOGETHER` share a cluster.

    Raises `InputError` if too many points are close together."""
    unique, which = np.unique(points, return_inverse=True)
    tree = KDTree(np.stack([unique.real, unique.imag], axis=1))
    # Count the pairs before listing them: there may be n².
    if tree.count_neighbors(tree, TOGETHER) > (1 + _CROWDED) * len(unique):
        raise InputError(
            f"{name}: ends of entities must be farther apart than {TOGETHER:g} mm, but many are "
            "closer; check the drawing's units, or draw longer entities"
        )
    pairs = tree.query_pairs(TOGETHER, output_type="ndarray")
    return _components(pairs, len(unique))[which]


def _components(pairs: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.intp)


def _first_of_each(chains: list[Loop], vertex: NDArray[np.intp], name: str) -> NDArray[np.intp]:
    """Return the indices of the chains that do not repeat an earlier chain.

    `vertex` (n, 2): indices of the vertices at each chain's ends; `name`: name of the drawing in
    messages. A chain repeats another if the ends and the points of `_quarters` of both coincide."""
    if not chains:
        return np.zeros(0, np.intp)
    quarters = np.array(
        [
            _quarters(chain.points, a > b)
            for chain, (a, b) in zip(chains, vertex.tolist(), strict=True)
        ]
    )
    between = _clusters(quarters.ravel(), name).reshape(len(chains), -1)
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


def _walked(
    chains: list[Loop], members: NDArray[np.intp], vertex: NDArray[np.intp]
) -> tuple[NDArray[np.complex128], NDArray[np.bool_]]:
    """Return (points, mask of joints) along the links of one loop or one open path in `chains`.

    `members`: indices of the links, in any order; `vertex` (n, 2): indices of the vertices at each
    chain's ends."""
    at: dict[int, list[int]] = {}
    for link in members.tolist():
        for v in vertex[link].tolist():
            at.setdefault(v, []).append(link)
    open_ends = [v for v, links in at.items() if len(links) == 1]
    link = at[open_ends[0]][0] if open_ends else int(members[0])
    start = open_ends[0] if open_ends else int(vertex[link, 0])
    points, joints = [], []
    for _ in range(len(members)):
        a, b = vertex[link].tolist()
        way = slice(None) if a == start else slice(None, None, -1)
        start = b if a == start else a
        own, marks = chains[link].points[way], chains[link].joints[way]
        # Keep the point that two links share once, as a joint if either link has it as a joint.
        if joints:
            joints[-1][-1] |= marks[0]
            own, marks = own[1:], marks[1:]
        points.append(own)
        joints.append(marks.copy())
        link = next((k for k in at[start] if k != link), -1)
    return np.concatenate(points), np.concatenate(joints)


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
