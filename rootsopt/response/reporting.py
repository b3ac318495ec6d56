"""Checks the quantities that objective, trade-offs and limits can name: forces, lines, terms."""

import re
from collections.abc import Sequence

from rootsopt.config import Config
from rootsopt.dynamics.measures import PEAK_NORM, line_name
from rootsopt.errors import InputError
from rootsopt.response.records import RESPONSES

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


__all__ = ["is_force", "reporting"]
