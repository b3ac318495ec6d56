"""What searches that follow each other know: the designs that they have evaluated."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.response.starts import Seeds


class Seen(NamedTuple):
    """A feasible design evaluated earlier.

    `point` (d,): the design in the unit box; `values` (k,): its terms; `orbit`: where the motions
    of neighbouring designs begin."""

    point: NDArray[np.float64]
    values: NDArray[np.float64]
    orbit: Seeds


class Course:
    """A course of searches, one after the other, that begins with what is `known`.

    Several courses run side by side without knowing of each other, so that the result does not
    depend on which of them is faster. `seen`: feasible designs, in the order of their evaluation;
    `evaluations`: number of designs evaluated in this course."""

    def __init__(self, known: Sequence[Seen] = ()):
        self.seen = [*known]
        self.evaluations = 0
        self._first = len(self.seen)

    def branch(self) -> "Course":
        """Return a new course that begins with what this one knows now."""
        return Course(self.seen)

    def join(self, others: Sequence["Course"]) -> None:
        """Add what `others` have seen, in their order. All must be branches of this course."""
        for other in others:
            self.seen += other.seen[other._first :]
            self.evaluations += other.evaluations
