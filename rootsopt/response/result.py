"""The evaluation of one design, at one point or at several speeds or in several scenes.

An evaluation begins at a `Seed`: on the closed orbit of a similar design or scene, or at a
state."""

import base64
import dataclasses
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rootsopt.config.units import COLUMNS
from rootsopt.dynamics.closed import Start
from rootsopt.dynamics.collocation.mesh import KnownOrbit, padded, room_for, trimmed
from rootsopt.dynamics.maxima import Maxima
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import Steady
from rootsopt.status import Status

if TYPE_CHECKING:
    import xarray


# Types of numbers in an orbit.
_KINDS = ("float64", "int64", "bool")


class Seed(NamedTuple):
    """Where an evaluation of a similar design or scene begins.

    `state` (n,): scaled, at φ1 = 0; `orbit`: the closed orbit through it, as the arrays of a
    `KnownOrbit` (see `collocation.mesh.trimmed`), then those of its pair. It is empty if the orbit
    is not known.
    """

    state: NDArray[np.float64]
    orbit: tuple[NDArray[Any], ...] = ()

    @classmethod
    def of(cls, motion: Steady, pair: RotorPair) -> "Seed":
        """Return a seed on the `motion` of `pair`.

        Only a periodic orbit is part of it."""
        state = np.asarray(motion.orbit.state, np.float64)
        if Status.of(motion.status) is not Status.PERIODIC:
            return cls(state)
        return cls(state, tuple(jax.tree.leaves((trimmed(motion.known), _numbers(pair)))))


Seeds = Seed | NDArray[np.float64] | tuple[Any, ...] | None
"""Type of the argument `start` of an evaluator: a seed or a scaled state (n,) for one motion; one
entry for each part (speed, sample, coexisting motion) for several motions; `None` for rest."""


def begun(pair: RotorPair, start: Seed | ArrayLike | None, longest: int) -> Start:
    """Return where the search for an orbit of `pair` begins, in arrays of NumPy.

    `start`: a seed, or a scaled state (n,) at φ1 = 0; `None`: at rest. An orbit that does not
    belong to a pair of this kind is not used; the search then begins at its state. `longest`:
    longest period of an orbit (mesh periods). Unlike elsewhere, the state of the result is scaled.
    """
    dtype, room = pair.angle_scale.dtype, room_for(pair, longest)
    seed = start if isinstance(start, Seed) else None
    state = start if seed is None else seed.state
    given = np.zeros(pair.states, dtype) if state is None else np.asarray(state, dtype)
    empty = KnownOrbit.empty(room, pair.states, pair.flanks)
    nothing = Start(given, empty, _numbers(pair))
    leaves, kind = jax.tree.flatten((empty, nothing.pair))
    if seed is None or len(seed.orbit) != len(leaves):
        return nothing
    known, numbers = jax.tree.unflatten(kind, seed.orbit)
    if known.elements.mesh.used >= room[0]:
        return nothing
    begin = Start(given, padded(known, room), numbers)
    return begin if begin.fits(nothing) else nothing


def plain(start: Seeds) -> Any:
    """Return a `start` as plain values for JSON, exact to the last bit."""
    if isinstance(start, Seed):
        return {"state": start.state.tolist(), "orbit": [_plain(one) for one in start.orbit]}
    if start is None or isinstance(start, np.ndarray):
        return None if start is None else start.tolist()
    return {"parts": [plain(one) for one in start]}


def read(value: Any) -> Seeds:
    """Return the start from the plain value that `plain` returned.

    Raises `ValueError`, `LookupError` or `TypeError` if it is not valid."""
    if not isinstance(value, dict):
        return None if value is None else np.asarray(value, np.float64)
    if "parts" in value:
        return tuple(read(one) for one in value["parts"])
    orbit = tuple(_read(*one) for one in value["orbit"])
    return Seed(np.asarray(value["state"], np.float64), orbit)


def _plain(array: NDArray[Any]) -> list[Any]:
    data = base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
    return [array.dtype.name, [*array.shape], data]


def _read(kind: str, shape: list[int], data: str) -> NDArray[Any]:
    if kind not in _KINDS:
        raise ValueError(f"an orbit has no numbers of type {kind}")
    return np.frombuffer(base64.b64decode(data, validate=True), kind).reshape(shape)


def _numbers(pair: RotorPair) -> RotorPair:
    """Return the numbers of `pair` in arrays of NumPy, with `None` in place of all other leaves."""
    return jax.tree.map(np.asarray, eqx.filter(pair, eqx.is_inexact_array))


RESPONSES = ("mean_force_N", "peak_force_N", "rms_force_N")
"""Keys of the mean, peak and RMS force in a response."""
ERRORS = {name: name.replace("_N", "_standard_error_N") for name in RESPONSES}
"""Keys of the standard errors in `steady_state`, keyed by the name of the response."""
# Entries of `steady_state` in the row of a speed.
_STEADY = (
    "kind",
    "period",
    "floquet_multiplier",
    "lyapunov_exponent_per_mesh_period",
    "lyapunov_standard_error",
)


@dataclasses.dataclass(frozen=True)
class Series:
    """Motion, force and penetration over the reported window, as NumPy arrays (samples,).

    `time` (s): uniform unless rotor 1 is free; `rotation` of rotor 1 (rad), uniform; `relative`: ε
    (rad); `rate`: dε/dt (rad/s); `drive_force`, `coast_force`: normal force (N) on each flank;
    `depth`: greatest penetration (m; negative: gap); `bearing_loads` (samples, 4): loads (N) on the
    bearings, None without `scene.bearings` or without an orbit. Order of the bearings: rotor 1 at
    the timing gear's end, rotor 1 at the other end, then rotor 2 likewise."""

    time: NDArray[np.float64]
    rotation: NDArray[np.float64]
    relative: NDArray[np.float64]
    rate: NDArray[np.float64]
    drive_force: NDArray[np.float64]
    coast_force: NDArray[np.float64]
    depth: NDArray[np.float64]
    bearing_loads: NDArray[np.float64] | None = None

    @property
    def force(self) -> NDArray[np.float64]:
        """Contact force (N): sum of the normal forces on both flanks."""
        return self.drive_force + self.coast_force


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Everything known about one design in one scene.

    `design`: parameters in config units; `geometry`, `response` (N), `gradient` (N per config
    unit): dicts with the keys of the result file. `gradient` is empty unless it can be trusted.
    `steady_state`: kind of motion and its properties; `status` and `message`: outcome and advice;
    `statistics`: effort and accuracy; `series`: whole orbits over at least one revolution, or a
    window of a motion that does not settle; `start`: argument `start` for a neighbouring design,
    None if not known; `maxima`: local maxima of the force over the orbit, slopes in N per config
    unit; None unless requested and periodic. `rivals`: evaluations of the other motions, if the
    worst of several motions counts. `speeds`: parts at the speeds of an objective, empty for one
    speed; `scenes`: parts in the nominal scene and in those of a sample, empty for one scene. The
    other fields are those at the scene's own speed, in the nominal scene.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic")
    >>> evaluation = rootsopt.evaluate(config)
    >>> slope = evaluation.gradient["peak_force_N"]["pressure_angle_deg"]
    >>> print(f"{evaluation.status.label}, {slope:.2f} N per degree")
    periodic, -2.93 N per degree
    """

    design: dict[str, float]
    geometry: dict[str, float]
    response: dict[str, float]
    gradient: dict[str, dict[str, float]]
    steady_state: dict[str, Any]
    status: Status
    message: str
    statistics: dict[str, int | float]
    series: Series | None
    start: Seeds = None
    maxima: Maxima | None = None
    rivals: "tuple[Evaluation, ...]" = ()
    speeds: "tuple[Part, ...]" = ()
    scenes: "tuple[Part, ...]" = ()

    @property
    def nominal(self) -> "Evaluation":
        """Evaluation in the nominal scene."""
        return self.scenes[0].evaluation if self.scenes else self

    @property
    def samples(self) -> "tuple[Part, ...]":
        """Parts in the scenes of a sample, without the nominal scene."""
        return self.scenes[1:]

    @property
    def by_speed(self) -> "tuple[Part, ...]":
        """Parts at all speeds; an evaluation at one speed is its only part."""
        return self.speeds or (Part({}, self),)

    @property
    def usable(self) -> bool:
        """Whether the numbers describe a steady state with a gradient."""
        return self.status.usable

    def to_dataset(self) -> "xarray.Dataset":
        """Return the series as an `xarray.Dataset` over time, with units and long names.

        Design, geometry, response and status are its attributes.

        Raises ValueError if the evaluation has no series."""
        series = self.series
        if series is None:
            raise ValueError(
                f"An evaluation must have a series to become a dataset, but this one is "
                f"{self.status.label} and has none; pass `series=True`, or choose another design"
            )
        import xarray  # Slow import.

        columns = {
            name: ("time_s", factor * getattr(series, field), {"units": unit, "long_name": long})
            for field, (name, unit, long, factor) in COLUMNS.items()
        }
        time = ("time_s", series.time, {"units": "s", "long_name": "time"})
        attributes = {
            "status": self.status.label,
            "message": self.message,
            **{f"design_{name}": value for name, value in self.design.items()},
            **self.geometry,
            **self.response,
        }
        return xarray.Dataset(columns, coords={"time_s": time}, attrs=attributes)

    @property
    def state(self) -> NDArray[np.float64] | None:
        """Scaled state (n,) of the orbit at φ1 = 0; None without an orbit, or if there are several
        motions."""
        return self.start.state if isinstance(self.start, Seed) else None

    def record(self) -> dict[str, Any]:
        """Return the record for the result file."""
        if self.scenes:
            own = {"status": self.status.label, "message": self.message}
            return self.nominal.record() | own | {"samples": [one.row() for one in self.samples]}
        record = {
            "design": self.design,
            "geometry": self.geometry,
            "response": self.response,
            "gradient": self.gradient,
            "steady_state": self.steady_state,
            "status": self.status.label,
            "message": self.message,
            "statistics": self.statistics,
        }
        if self.speeds:
            record["speeds"] = [one.row(whole=True) | {"share": one.share} for one in self.speeds]
        return record


class Part(NamedTuple):
    """The evaluation at one of several points: a speed, or a scene of a sample.

    `values`: value of each key in which the points differ, in its unit: `speed_rpm` of rotor 1, or
    the keys that scatter; empty for the nominal scene. `share` of the point in the objective."""

    values: dict[str, float]
    evaluation: Evaluation
    share: float = 1.0

    @property
    def speed_rpm(self) -> float:
        """Speed of rotor 1 (rpm); NaN unless the points are speeds."""
        return self.values.get("speed_rpm", math.nan)

    def row(self, whole: bool = False) -> dict[str, Any]:
        """Return a table row: values, forces and status.

        `whole`: whether to add all other quantities and the kind of motion."""
        response, steady = self.evaluation.response, self.evaluation.steady_state
        further, kind = (tuple(response), _STEADY) if whole else ((), ())
        return {
            **self.values,
            **{name: response.get(name) for name in (*RESPONSES, *further)},
            **{name: steady.get(name) for name in kind},
            "status": self.evaluation.status.label,
        }
