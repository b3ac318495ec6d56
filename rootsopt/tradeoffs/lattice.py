"""Grid of reference points between the ends of a front: a line for two terms, a triangle for three.

A *key* of the grid has one whole number per term; their sum is the number of divisions. The key of
the end of a term has all of them in the entry of that term."""

import itertools
from collections.abc import Sequence

Key = tuple[int, ...]


def keys(count: int, divisions: int) -> list[Key]:
    """Return all keys for `count` terms, from the end of the first term on.

    Neighbours of a key that come before it are those at minus one of `directions`."""
    every = itertools.product(range(divisions, -1, -1), repeat=count)
    return [key for key in every if sum(key) == divisions]


def corners(count: int, divisions: int) -> list[Key]:
    """Return the keys of the ends, in the order of the terms."""
    return [tuple(divisions * (i == k) for i in range(count)) for k in range(count)]


def directions(count: int) -> list[Key]:
    """Return the steps from a key to those neighbours that come after it."""
    pairs = itertools.combinations(range(count), 2)
    return [tuple((k == j) - (k == i) for k in range(count)) for i, j in pairs]


def links(found: Sequence[Key]) -> list[tuple[int, int]]:
    """Return pairs of numbers of the keys in `found` that are neighbours on the grid."""
    place = {key: number for number, key in enumerate(found)}
    pairs = []
    for key, number in place.items():
        for step in directions(len(key)):
            other = place.get(tuple(a + b for a, b in zip(key, step, strict=True)))
            if other is not None:
                pairs.append((number, other))
    return pairs


__all__ = ["Key", "corners", "directions", "keys", "links"]
