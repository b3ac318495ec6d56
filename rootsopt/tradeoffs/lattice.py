"""Grid of reference points between the ends of a front: a line for two terms, a triangle for three.

A *key* identifies a grid point by one whole number per term; their sum is the number of divisions.
At the end of a term (the optimum of this term alone), the number of this term is that sum, and all
others are 0."""

import itertools
from collections.abc import Sequence

Key = tuple[int, ...]


def keys(count: int, divisions: int) -> list[Key]:
    """Return all keys for `count` terms, beginning with the end of the first term. `divisions`:
    number of steps from one end to another.

    Subtract one of the `directions` from a key to get a neighbour that comes before it."""
    every = itertools.product(range(divisions, -1, -1), repeat=count)
    return [key for key in every if sum(key) == divisions]


def corners(count: int, divisions: int) -> list[Key]:
    """Return the keys of the ends of the front, in the order of the `count` terms."""
    return [tuple(divisions * (i == k) for i in range(count)) for k in range(count)]


def directions(count: int) -> list[Key]:
    """Return the steps from a key to those neighbours that come after it in `keys`, for `count`
    terms."""
    pairs = itertools.combinations(range(count), 2)
    return [tuple((k == j) - (k == i) for k in range(count)) for i, j in pairs]


def links(found: Sequence[Key]) -> list[tuple[int, int]]:
    """Return the pairs of neighbours on the grid, as indices of the keys in `found`."""
    place = {key: number for number, key in enumerate(found)}
    pairs = []
    for key, number in place.items():
        for step in directions(len(key)):
            other = place.get(tuple(a + b for a, b in zip(key, step, strict=True)))
            if other is not None:
                pairs.append((number, other))
    return pairs
