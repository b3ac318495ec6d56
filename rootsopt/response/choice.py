"""`solver.fidelity: auto`: choose the cheapest settings that meet a stated error.

The config's design is first simulated from rest with the reference settings: the contact is found
by search, at a tolerance far below the requested error. Cheaper settings are then tried, cheapest
first. The first settings whose mean and peak force agree with the reference are chosen. They must
agree at every speed of the objective. The chosen settings are used for all further designs of the
run, and in the resolved config. `rootsopt sweep` uses the chosen settings at all its speeds.

Measuring the difference costs two or three simulations of one design. In return, the error does not
depend on a rule of thumb about tolerances.
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
"""Length of the transient (mesh periods) above which contact maps are tried: they then save
time."""
_MARGIN = 0.5
"""Largest accepted difference from the reference, as a fraction of the requested error."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """Chosen settings and their measured error.

    `config`: the config with the settings in place of `auto`; `requested`: requested relative
    error; `error`: greatest relative error of mean or peak force, None if the scene has no periodic
    steady state to compare; `tried`: all tried settings, each with its difference from the
    reference.
    """

    config: Config
    requested: float
    error: float | None
    tried: list[dict[str, Any]]

    def record(self) -> dict[str, Any]:
        """Return the record for the result file."""
        solver = self.config.solver
        return {
            "requested_error": self.requested,
            "estimated_error": self.error,
            "fidelity": solver.fidelity,
            "map_error": solver.map_error if solver.fidelity == "map" else None,
            "method": solver.method,
            "rtol": solver.orbit_tolerance,
            "transient_rtol": solver.transient_tolerance,
            "tried": self.tried,
        }


def choose(config: Config) -> Choice:
    """Choose solver settings that meet `solver.accuracy`, for a `config` whose fidelity is `auto`.

    The reference's settings are chosen if no cheaper settings agree with the reference, or if the
    reference itself finds no periodic orbit. Cheaper settings can also disagree because the motion
    settles on another of several coexisting orbits.
    """
    wanted = config.solver.accuracy
    tried: list[dict[str, Any]] = []
    # Noise of the steps can excite a motion or keep it from settling. In this case, try a finer
    # tolerance.
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
        settings = {"fidelity": solver.fidelity, "rtol": solver.orbit_tolerance}
        tried.append(settings | {"error": error, "status": status.label})
        if error is not None and error <= _MARGIN * wanted:
            # Add the error of the reference itself, about its tolerance.
            return Choice(candidate, wanted, error + 0.01 * wanted, tried)
    return Choice(reference, wanted, 0.01 * wanted, tried)


def _evaluations(config: Config) -> list[Evaluation]:
    """Return evaluations of the config's own design at every speed of its objective."""
    return [Evaluator.of(alone(config, speed))(series=False) for speed in shares(config)]


def resolve(config: Config) -> tuple[Config, dict[str, Any]]:
    """Return `config` with the chosen settings in place of `auto`, and a record for the result
    file.

    If the config's fidelity is not `auto`, the config is returned unchanged, and the record is
    empty."""
    if config.solver.fidelity != "auto":
        return config, {}
    choice = choose(config)
    return choice.config, {"solver": choice.record()}


def _candidates(config: Config, wanted: float, long: bool) -> Iterator[Config]:
    """Yield the settings to try, as configs, cheapest first.

    `wanted`: requested relative error; `long`: whether the transient is long, so that a contact map
    saves more time than it costs."""
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
        # The explicit method with the least work at this tolerance.
        "method": "dopri8" if rtol < 1e-9 else "tsit5",
    }
    solver = SolverConfig.model_validate(config.solver.model_dump() | changes)
    return config.model_copy(update={"solver": solver})


def difference(found: Evaluation, truth: Evaluation) -> float | None:
    """Return the larger of the differences in mean and in peak force, relative to `truth`.

    The result is None unless both evaluations are usable. If a force of `truth` is 0, its
    difference is absolute (N)."""
    if not (found.usable and truth.usable):
        return None
    pairs = ((found.response[key], truth.response[key]) for key in _JUDGED)
    return max(abs(a / b - 1) if b else abs(a) for a, b in pairs)
