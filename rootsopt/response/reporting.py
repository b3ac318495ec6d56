"""Checks the quantities that objective, trade-offs and limits can name: forces, lines, terms."""

import re
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from rootsopt.config import Config
from rootsopt.dynamics.measures import PEAK_NORM, line_name
from rootsopt.errors import InputError
from rootsopt.response.records import RESPONSES
from rootsopt.response.terms import needs_forces, terms_of
from rootsopt.scene import Scene

_LINE = re.compile(r"line_(\d+(?:\.\d+)?)_force_N")


def is_force(config: Config, name: str, key: str) -> bool:
    """Return whether `name` is a measure of the force; otherwise, it can only be a registered term.

    `key`: config key that holds the name, for the message. Raises `InputError` for a measure that
    cannot exist."""
    if name == PEAK_NORM and config.objective.peak_norm is None:
        raise InputError(
            f"`{key}` names {PEAK_NORM}, which needs `objective.peak_norm`; set it, or name "
            "peak_force_N"
        )
    found = _LINE.fullmatch(name)
    if found is None:
        return name in RESPONSES or name == PEAK_NORM
    order = float(found[1])
    if not 1e-2 <= order <= 1e3 or line_name(order) != name:
        raise InputError(
            f"`{key}` must name a line as line_ORDER_force_N with an order from 0.01 to "
            f"1000, as in line_2_force_N, but names {name}"
        )
    return True


def depends_on_forces(config: Config, scene: Scene, name: str, key: str) -> bool:
    """Return whether the quantity `name` is a force, or a term that reads forces.

    `key`: config key that holds the name. Raises `InputError` if no quantity has this name."""
    if is_force(config, name, key):
        return True
    (term,) = terms_of([name], key)
    return needs_forces(scene, term, jnp.asarray(np.asarray(config.design, np.float64)))


def reporting(config: Config, names: Sequence[str], key: str) -> Config:
    """Return a copy of a `config` whose evaluations report all quantities in `names`.

    `key`: config key that holds the names."""
    lines = [*config.response.lines]
    terms = dict(config.objective.terms)
    for name in names:
        forced = is_force(config, name, key)
        if found := _LINE.fullmatch(name):
            order = float(found[1])
            lines += [order] * (order not in lines)
        elif not forced:
            terms.setdefault(name, 0.0)
    response = config.response.model_copy(update={"lines": tuple(lines)})
    objective = config.objective.model_copy(update={"terms": terms})
    return config.model_copy(update={"response": response, "objective": objective})
