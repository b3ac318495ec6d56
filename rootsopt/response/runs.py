"""Where evaluations of a search run: in this process, or on other processes."""

import os
from typing import Any, Protocol, runtime_checkable

from rootsopt.response.evaluation import Evaluation
from rootsopt.response.starts import Seeds
from rootsopt.response.wrapper import Evaluates


@runtime_checkable
class Runs(Protocol):
    """Runs evaluations for threads that wait for them.

    An evaluation is a pure function, so that its result does not depend on where it runs."""

    @property
    def slots(self) -> int:
        """Number of evaluations that should be asked for at a time."""
        ...

    def evaluated(self, evaluator: Evaluates, design: Any, start: Seeds = None) -> Evaluation:
        """Return `evaluator(design, start, series=False)`."""
        ...


class Here:
    """Runs evaluations in this process, in the thread that asks for them."""

    @property
    def slots(self) -> int:
        """Number of cores."""
        return os.cpu_count() or 1

    def evaluated(self, evaluator: Evaluates, design: Any, start: Seeds = None) -> Evaluation:
        """Return `evaluator(design, start, series=False)`."""
        return evaluator(design, start, series=False)


HERE = Here()

__all__ = ["HERE", "Here", "Runs"]
