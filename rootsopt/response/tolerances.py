"""One design in many scenes with scattered values (`tolerances` of a config).

The scenes of a sample differ only in the values of arrays, so they share compiled programs.
"""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax.numpy as jnp

from rootsopt.config import Config
from rootsopt.response.result import Evaluation, Part, together
from rootsopt.response.runs import HERE, Runs
from rootsopt.response.scatter import Shift, draw, shifts
from rootsopt.response.starts import Seeds
from rootsopt.response.wrapper import Evaluates, Wrapper
from rootsopt.scene import design_vector
from rootsopt.status import Status


@dataclasses.dataclass(frozen=True)
class ToleranceEvaluator(Wrapper):
    """Evaluates designs in the nominal scene and in every scene of a fixed sample.

    `single`: the evaluator used in each scene; `shifts`: how far the scenes and their designs are
    from the nominal ones; `runs`: where the sample is simulated. The response is reported in the
    nominal scene. A design is usable only if it is usable in every scene.
    """

    shifts: tuple[Shift, ...] = ()
    runs: Runs = dataclasses.field(default=HERE, compare=False, repr=False)

    @classmethod
    def of(cls, config: Config, single: Evaluates, runs: Runs = HERE) -> "ToleranceEvaluator":
        """Return the evaluator over the fixed sample of `tolerances` in a `config`.

        `single`: evaluator of the config's nominal scene; `runs`: where the sample is simulated."""
        assert config.tolerances is not None
        return cls(single, shifts(config, draw(config, config.tolerances.samples)), runs)

    def relative_to(self, baseline: Evaluation) -> "ToleranceEvaluator":
        """Return another evaluator that compares coexisting motions in each scene by their forces
        relative to those of the `baseline` in the nominal scene."""
        return self._around(self.single.relative_to(baseline.nominal))

    def __call__(self, design=None, start=None, series=True) -> Evaluation:
        """Evaluate a design.

        `design` (d,): in config units, by default the config's own; `start`: the `start` of a
        neighbouring design's evaluation; `series`: whether to compute the series in the nominal
        scene. Without a usable motion in the nominal scene, no sample is simulated."""
        nominal = design_vector(self.config) if design is None else jnp.asarray(design)
        begin = (None,) * (1 + len(self.shifts)) if start is None else start
        head = self.single(nominal, begin[0], series)
        if not head.usable:
            return over_scenes((Part({}, head),))

        def at(number: int) -> Part:
            shift = self.shifts[number - 1]
            return in_scene(self.single, shift, nominal, begin[number], self.runs)

        with ThreadPoolExecutor(self.runs.slots) as pool:
            parts = tuple(pool.map(at, range(1, 1 + len(self.shifts))))
        return over_scenes((Part({}, head), *parts))


def in_scene(
    evaluator: Evaluates,
    shift: Shift,
    design: Any,
    start: Seeds,
    runs: Runs = HERE,
) -> Part:
    """Evaluate a `design` (d,) in a scene that differs from the nominal one by `shift`.

    `evaluator`: that of the nominal scene; `start`: as in `Evaluates.__call__`; `runs`: where."""
    if shift.scene is not None:
        evaluator = evaluator.shifted(shift.scene)
    return Part(shift.values, runs.evaluated(evaluator, design + shift.design, start))


def over_scenes(parts: Sequence[Part]) -> Evaluation:
    """Return the evaluation over several scenes, reported in the nominal scene.

    `parts`: that of the nominal scene first. The status is that of the first part that is not
    usable, or of the nominal scene if all are."""
    head = parts[0].evaluation
    found = together(head, parts, overall(parts), {"samples": len(parts) - 1})
    return dataclasses.replace(found, scenes=tuple(parts))


def overall(parts: Sequence[Part]) -> tuple[Status, str]:
    """Return status and message of the first part that is not usable, or of the nominal scene if
    all are."""
    failed = [part for part in parts if not part.evaluation.usable]
    if not failed or failed[0] is parts[0]:
        return parts[0].evaluation.status, parts[0].evaluation.message
    first, count = failed[0], len(parts) - 1
    values = ", ".join(f"{key} = {value:.6g}" for key, value in first.values.items())
    return first.evaluation.status, (
        f"In {len(failed)} of the {count} scenes of `tolerances`, the motion is not usable. With "
        f"{values}: {first.evaluation.message}"
    )


__all__ = ["ToleranceEvaluator", "in_scene", "over_scenes", "overall"]
