"""`solver.fidelity: auto`: the cheapest settings that meet a stated error.

The configured design is simulated from rest with the reference, contact by search at a
tolerance far below the error asked for. Then cheaper settings are tried, cheapest first,
and the first whose mean and peak force agree with the reference is kept: for every
further design of the run, and in the resolved config. With several speeds in the objective,
they agree at every one; `rootsopt sweep` takes what is chosen so for all its speeds. An
estimate that is a measured difference holds where a rule of thumb about tolerances would not,
and costs two or three simulations of one design.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

from rootsopt.config import Config, SolverConfig
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.response.speeds import alone, shares
from rootsopt.status import Status

_JUDGED = ("mean_force_N", "peak_force_N")
_LONG = 64
"""Transient (mesh periods) from which on a map pays."""
_MARGIN = 0.5
"""Share of the requested error that a measured difference may use up."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """Chosen settings, as a config without `auto`, and the error they were seen to leave.

    `error`: largest relative difference of mean and peak force to the reference, None where
    the scene has no periodic steady state to compare on. `tried`: every candidate with its
    error.
    """

    config: Config
    requested: float
    error: float | None
    tried: list[dict[str, Any]]

    def record(self) -> dict[str, Any]:
        """For the result file."""
        solver = self.config.solver
        return {
            "requested_error": self.requested,
            "estimated_error": self.error,
            "fidelity": solver.fidelity,
            "map_error": solver.map_error if solver.fidelity == "map" else None,
            "method": solver.method,
            "rtol": solver.rtol,
            "transient_rtol": solver.transient_rtol,
            "tried": self.tried,
        }


def choose(config: Config) -> Choice:
    """Settings for `config`, whose fidelity is `auto`, that meet `solver.accuracy`.

    Where nothing cheaper agrees (as where a coarser simulation ends on another of several
    coexisting orbits), or where the reference itself finds no periodic orbit, the
    reference's settings are chosen.
    """
    wanted = config.solver.accuracy
    tried: list[dict[str, Any]] = []
    # Noise of the steps can keep a motion from settling, or stir it up: then more closely.
    for share in (1e-4, 1e-6):
        reference = _with(config, fidelity="search", rtol=share * wanted)
        truth = _evaluations(reference)
        if not any(one.status in (Status.NOT_SETTLED, Status.CHAOTIC) for one in truth):
            break
    if not all(one.status is Status.PERIODIC for one in truth):
        return Choice(reference, wanted, None, tried)
    long = max(one.statistics["transient_mesh_periods"] for one in truth) > _LONG
    for candidate in _candidates(config, wanted, long):
        found = _evaluations(candidate)
        errors = [difference(*pair) for pair in zip(found, truth, strict=True)]
        known = [error for error in errors if error is not None]
        error = max(known) if len(known) == len(errors) else None
        status = next((one.status for one in found if not one.usable), found[0].status)
        solver = candidate.solver
        settings = {"fidelity": solver.fidelity, "rtol": solver.rtol}
        tried.append(settings | {"error": error, "status": status.label})
        if error is not None and error <= _MARGIN * wanted:
            # The reference is itself off by about its tolerance's share.
            return Choice(candidate, wanted, error + 0.01 * wanted, tried)
    return Choice(reference, wanted, 0.01 * wanted, tried)


def _evaluations(config: Config) -> list[Evaluation]:
    """The config's own design at every speed of its objective."""
    return [Evaluator.of(alone(config, speed))(series=False) for speed in shares(config)]


def resolve(config: Config) -> tuple[Config, dict[str, Any]]:
    """`config` without `auto`, and what the result file says of the choice (nothing where
    there was none to make)."""
    if config.solver.fidelity != "auto":
        return config, {}
    choice = choose(config)
    return choice.config, {"solver": choice.record()}


def _candidates(config: Config, wanted: float, long: bool) -> Iterator[Config]:
    """Cheapest first. A map costs more to build than it saves, unless the transient is long."""
    loose, tight = 1e-2 * wanted, 1e-3 * wanted
    searched = bool(config.needs_search)
    if wanted >= 3e-3 and not searched:
        yield _with(config, fidelity="linear", rtol=loose)
    for fidelity in ("map", "search") if long and not searched else ("search",):
        for rtol in (loose, tight):
            yield _with(config, fidelity=fidelity, rtol=rtol, map_error=0.1 * wanted)


def _with(config: Config, fidelity: str, rtol: float, map_error: float = 1e-4) -> Config:
    rtol = min(max(rtol, 1e-11), 1e-4)
    changes = {
        "fidelity": fidelity,
        "rtol": rtol,
        "transient_rtol": min(rtol, 1e-6),
        "map_error": min(max(map_error, 1e-6), 0.1),
        # Of the explicit methods the one with the least work at this tolerance.
        "method": "dopri8" if rtol < 1e-9 else "tsit5",
    }
    solver = SolverConfig.model_validate(config.solver.model_dump() | changes)
    return config.model_copy(update={"solver": solver})


def difference(found: Evaluation, truth: Evaluation) -> float | None:
    """Largest relative difference of mean and peak force, None unless both are periodic."""
    if not (found.usable and truth.usable):
        return None
    pairs = ((found.response[key], truth.response[key]) for key in _JUDGED)
    return max(abs(a / b - 1) if b else abs(a) for a, b in pairs)
