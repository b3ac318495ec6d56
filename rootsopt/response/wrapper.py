"""The protocol of all evaluators, and the base class of evaluators that wrap another evaluator."""

import dataclasses
from typing import Any, Protocol, TypeVar, runtime_checkable

from numpy.typing import ArrayLike

from rootsopt.config import Config
from rootsopt.dynamics.pair import RotorPair
from rootsopt.response.evaluation import Evaluation
from rootsopt.response.starts import Seeds
from rootsopt.scene import Scene

W = TypeVar("W", bound="Wrapper")
"""Type variable for the class of a wrapper, which its methods return. (`Self` does not work with
the run-time type checks of the tests.)"""


@runtime_checkable
class Evaluates(Protocol):
    """Evaluates designs of one config. An evaluator is immutable (see `Evaluator`)."""

    @property
    def config(self) -> Config:
        """Config whose designs are evaluated."""
        ...

    @property
    def scene(self) -> Scene:
        """Scene in which designs are evaluated."""
        ...

    def __call__(self, design: Any = None, start: Seeds = None, series: bool = True) -> Evaluation:
        """Evaluate `design` (d,), in config units; by default the config's own.

        `start`: where to begin, such as the `start` of a neighbouring design's evaluation;
        `series`: whether to compute the series."""
        ...

    def prepare(self, design: Any = None, series: bool = True, maxima: bool = False) -> None:
        """Compile the programs for evaluating `design` (d,), in config units, in the background.

        `series`: whether the evaluations will compute the series; `maxima`: whether evaluators
        `with_maxima` will follow."""
        ...

    def pair(self, design: ArrayLike) -> RotorPair:
        """Return the rotor pair of `design` (config units)."""
        ...

    def at_speed(self, speed_rpm: float) -> "Evaluates":
        """Return another evaluator at the speed `speed_rpm`."""
        ...

    def shifted(self, shift: Scene) -> "Evaluates":
        """Return another evaluator whose scene's arrays are moved by those of `shift`.

        `shift`: change in SI units, as a `Scene` with None in place of all that is not moved."""
        ...

    def at_tolerance(self, rtol: float) -> "Evaluates":
        """Return another evaluator with the orbit tolerance `rtol`."""
        ...

    def surveying(self) -> "Evaluates":
        """Return another evaluator for a search over many designs.

        It gives up sooner on a design that does not settle (see `Evaluator.surveying`)."""
        ...

    def relative_to(self, baseline: Evaluation) -> "Evaluates":
        """Return another evaluator that compares coexisting motions by their forces relative to
        those of the `baseline`."""
        ...

    def with_maxima(self) -> "Evaluates":
        """Return another evaluator that adds all local maxima of the force to an evaluation."""
        ...

    def without_gradient(self) -> "Evaluates":
        """Return an evaluator that skips the gradient, if computing it takes most of the time."""
        ...


@dataclasses.dataclass(frozen=True)
class Wrapper:
    """Base class of evaluators that combine several evaluations made by another evaluator,
    `single`.

    A subclass defines the call, which combines evaluations of one design. The other methods
    delegate to `single`.
    """

    single: Evaluates

    @property
    def config(self) -> Config:
        """Config whose designs are evaluated."""
        return self.single.config

    @property
    def scene(self) -> Scene:
        """Scene in which designs are evaluated."""
        return self.single.scene

    def __call__(self, design=None, start=None, series=True) -> Evaluation:
        """Evaluate `design` (config units; default: the config's own).

        Arguments: see `Evaluates.__call__`."""
        raise NotImplementedError

    def pair(self, design: ArrayLike) -> RotorPair:
        """Return the rotor pair of `design` (config units)."""
        return self.single.pair(design)

    def prepare(self, design=None, series=True, maxima=False) -> None:
        """Compile the programs for evaluating a design in the background.

        Arguments: see `Evaluates.prepare`."""
        self.single.prepare(design, series, maxima)

    def at_speed(self: W, speed_rpm: float) -> W:
        """Return another evaluator at the speed `speed_rpm`."""
        return self._around(self.single.at_speed(speed_rpm))

    def shifted(self: W, shift: Scene) -> W:
        """Return another evaluator whose scene's arrays are moved by those of `shift`."""
        return self._around(self.single.shifted(shift))

    def at_tolerance(self: W, rtol: float) -> W:
        """Return another evaluator with the orbit tolerance `rtol`."""
        return self._around(self.single.at_tolerance(rtol))

    def surveying(self: W) -> W:
        """Return another evaluator for a search over many designs.

        It gives up sooner on a design that does not settle (see `Evaluator.surveying`)."""
        return self._around(self.single.surveying())

    def relative_to(self: W, baseline: Evaluation) -> W:
        """Return another evaluator that compares coexisting motions by their forces relative to
        those of the `baseline`."""
        return self._around(self.single.relative_to(baseline))

    def with_maxima(self: W) -> W:
        """Return another evaluator that adds all local maxima of the force to an evaluation."""
        return self._around(self.single.with_maxima())

    def without_gradient(self: W) -> W:
        """Return an evaluator that skips the gradient, if computing it takes most of the time."""
        return self._around(self.single.without_gradient())

    def _around(self: W, single: Evaluates) -> W:
        return dataclasses.replace(self, single=single)


__all__ = ["Evaluates", "Wrapper"]
