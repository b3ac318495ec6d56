"""Calls into rootsopt's evaluators and models that several studies make."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from experiments._common.scenes import FORCES
from experiments._common.tables import Row
from rootsopt.config import Config
from rootsopt.optimize.problem import Problem
from rootsopt.profiles import Profile
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.scene import Scene, design_vector

# Compiled `Scene.pair`: returns the rotor pair of a scene and a design.
pair_of_model = eqx.filter_jit(Scene.pair)


def evaluator_of(config: Config, give_up_early: bool = False) -> Evaluator:
    """Make the evaluator of a config.

    `give_up_early`: whether to give up motions that settle late.
    """
    found = Evaluator.of(config)
    return found.surveying() if give_up_early else found


def evaluate(config: Config) -> Evaluation:
    """Simulate the design of a config from rest, without time series."""
    return evaluator_of(config)(series=False)


def at(evaluator: Evaluator, rtol: float, transient: float | None = None) -> Evaluator:
    """Return an evaluator with the tolerances `rtol` of the orbit and `transient` of the transient.

    By default the transient's tolerance is unchanged. Nothing is compiled again.
    """
    coarse = jnp.asarray(rtol if transient is None else transient)
    scene = eqx.tree_at(lambda scene: scene.solver.transient.rtol, evaluator.scene, coarse)
    return dataclasses.replace(evaluator, scene=scene).at_tolerance(rtol)


def profile_of(config: Config, design: ArrayLike | None = None) -> Profile:
    """Return the profile of a design (d,) in config units; default: the config's design."""
    chosen = design_vector(config) if design is None else jnp.asarray(design)
    return Scene.from_config(config).profile(chosen)


def objective(evaluation: Evaluation, reference: dict[str, float]) -> float:
    """Return the average of mean and peak force, each divided by the force in `reference` (N).

    The result is NaN without a periodic motion."""
    if not evaluation.usable:
        return float("nan")
    return float(np.mean([evaluation.response[key] / reference[key] for key in FORCES]))


def feasible(problem: Problem, points: Iterable[Any]) -> list[NDArray[np.float64]]:
    """Move `points` (d,) of the unit box onto the constraints; return those that are feasible."""
    moved = [problem.project(point) for point in points]
    return [point for point in moved if problem.feasible(point)]


def numbers_of(evaluation: Evaluation) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and peak force (2,) in N, and their gradients (2, d), NaN if unknown."""
    unknown = dict.fromkeys(evaluation.design, np.nan)
    forces = [evaluation.response.get(key, np.nan) for key in FORCES]
    slopes = [list(evaluation.gradient.get(key, unknown).values()) for key in FORCES]
    return np.array(forces), np.array(slopes)


def errors_of(found: Any, truth: Any) -> Row:
    """Return the largest relative errors of forces and gradients, over all designs.

    `found`, `truth`: forces (..., 2), and gradients (..., 2, d) or None. The error of a gradient is
    relative to its largest entry."""
    (forces, slopes), (force, slope) = found, truth
    errors = {"value_error": float(np.max(np.abs(np.asarray(forces) / force - 1)))}
    if slopes is not None:
        off = np.max(np.abs(np.asarray(slopes) - slope), -1) / np.max(np.abs(slope), -1)
        errors["gradient_error"] = float(np.max(off))
    return errors
