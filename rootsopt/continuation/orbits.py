"""Periodic orbits as the solutions of equations in a state and a parameter.

The unknowns are the state at φ1 = 0 and the parameter. The unit of ε stays that of the first config
when the parameter changes. The equations require that the state returns after k mesh periods. Their
derivatives come from the linearised solver steps. `rootsopt.continuation.branch` follows the curves
of solutions.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike, NDArray

from rootsopt.config import Config, parse
from rootsopt.config.reading import TWIST
from rootsopt.config.units import MM, RPM
from rootsopt.continuation.arclength import (
    End,
    Linearization,
    Spot,
    StepSizes,
    StoppedError,
    corrected,
)
from rootsopt.dynamics.flow import Flow, flow
from rootsopt.dynamics.integrator import Integrator
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.steady import SAMPLES
from rootsopt.dynamics.switches import with_switches
from rootsopt.dynamics.verdict import RESIDUAL, TOO_DEEP
from rootsopt.errors import InputError
from rootsopt.runtime.programs import Program
from rootsopt.scene import (
    Scene,
    check_geometry,
    design_keys,
    design_vector,
    integrators,
)

PLACES = {
    "speed_rpm": "scene.speed_rpm",
    "torque_N_m": "scene.load.torque_N_m",
    "pressure_difference_Pa": "scene.load.pressure_difference_Pa",
    "backlash_mm": "scene.timing_gear.backlash_mm",
    "damping_ratio": "scene.timing_gear.damping_ratio",
}
"""Names of the scene parameters along which orbits can be followed, and their config keys. Orbits
can also be followed along design parameters, whose keys are in the section `profile`."""
_GEAR = ("backlash_mm", "damping_ratio")
SPAN = 20.0
"""Change of the scaled state that has the same length as the whole range of the parameter, when
step lengths are measured."""
LOOKS = 504
"""Number of uniform instants on an orbit at which contact of flanks and gear is checked."""
LONGEST = 8
"""Longest orbit that can be followed (mesh periods)."""
_STEP = 1 / 256
"""Length (mesh periods) above which solver steps are divided. Slightly longer steps may remain."""
HALF_ALIKE = 1e-5
"""Distance (unit of `StepSizes`) between the states at the start and the middle of an orbit below
which the orbit has half the period. States between steps are interpolated, so the limit is not 0.
"""


@dataclasses.dataclass(frozen=True)
class BranchPoint:
    """One periodic orbit of a branch.

    `value` of the parameter (config's unit); `state` (n,) at φ1 = 0, scaled for the config with
    that value, so that an `Evaluator` can start there; `period` (mesh periods); `mean`, `peak`,
    `rms` of the contact force (N); `multipliers` (n,): Floquet multipliers; `residual`: greatest
    entry of |Φ(z) - z|, divided by the greatest entry of |z| if that exceeds 1; `slope`: derivative
    of the parameter, as a fraction of its range, with respect to arclength; `gap_time`: longest
    time (mesh periods) in which neither flanks nor gear touch; `depth`: greatest penetration (m);
    `reach`: greatest |ε| (rad); `looks`: number of integrations.
    """

    value: float
    state: NDArray[np.float64]
    period: int
    mean: float
    peak: float
    rms: float
    multipliers: NDArray[np.complex128]
    residual: float
    slope: float
    gap_time: float
    depth: float
    reach: float
    looks: int

    @property
    def stable(self) -> bool:
        """Whether all multipliers lie inside the unit circle."""
        return bool(np.max(np.abs(self.multipliers)) < 1)


def parameters(config: Config) -> tuple[str, ...]:
    """Return the names of the parameters along which orbits of `config` can be followed."""
    gear = _GEAR if config.scene.timing_gear is not None else ()
    gas = config.scene.load.pressure_difference_Pa is not None
    load = "pressure_difference_Pa" if gas else "torque_N_m"
    return ("speed_rpm", load, *gear, *design_keys(config))


def value_of(config: Config, parameter: str) -> float:
    """Return the value of a parameter, in the config's unit.

    Raises `InputError` for an unknown parameter."""
    _check(config, parameter)
    keys = design_keys(config)
    if parameter in keys:
        return float(design_vector(config)[keys.index(parameter)])
    found: Any = config
    for key in PLACES[parameter].split("."):
        found = getattr(found, key)
    return float(found)


def place_of(parameter: str) -> str:
    """Return the dotted config key of a parameter."""
    if parameter == TWIST:
        return f"rotor.{TWIST}"
    return PLACES.get(parameter, f"profile.{parameter}")


def with_value(config: Config, parameter: str, value: float) -> Config:
    """Return `config` with another `value` of a parameter, in the config's unit.

    Raises `InputError` for an unknown parameter or a value out of bounds.
    """
    _check(config, parameter)
    if parameter in design_keys(config):
        return parse(_with_design(config, parameter, value).to_yaml())
    return parse(config.to_yaml(), [f"{PLACES[parameter]}={float(value)!r}"])


def _with_design(config: Config, parameter: str, value: float) -> Config:
    """Return `config` with another value of a design parameter, without any check."""
    design = np.asarray(design_vector(config)).copy()
    design[design_keys(config).index(parameter)] = value
    return config.with_design(design)


def _check(config: Config, parameter: str) -> None:
    valid = parameters(config)
    if parameter in valid:
        return
    why = "this config has no timing gear" if parameter in _GEAR else "valid here"
    raise InputError(
        f"Argument `parameter` must be one that can be followed, but is {parameter!r}; {why}: "
        f"{', '.join(valid)}"
    )


class _Shot(NamedTuple):
    """Result of integrating k mesh periods from a state.

    `out`: the flow; `grid`: step ends for repeating the integration (see `_shoot`); `lost`: whether
    |ε| has reached its limit at a sample, or `RotorPair.lost` holds at the end; `touching`: whether
    flanks or gear touch, at `LOOKS` uniform times; `scale` (rad): unit of ε in the config at this
    value of the parameter.
    """

    out: Flow
    grid: Float[Array, " steps"]
    lost: Bool[Array, ""]
    touching: Bool[Array, " looks"]
    scale: Float[Array, ""]


class OrbitData(NamedTuple):
    """Data of an orbit in `Linearization.data`, in addition to residual and Jacobian.

    `monodromy` (n, n): monodromy matrix of the scaled state at some instant; `to_state` (n, n):
    derivative of the state at φ1 = 0 with respect to that at this instant; `statistics`: mean, peak
    and RMS force (N); `half_way`: distance (unit of `StepSizes`) between the states at the start
    and the middle of the orbit. For the other fields, see `BranchPoint`.
    """

    monodromy: NDArray[np.float64]
    to_state: NDArray[np.float64]
    state: NDArray[np.float64]
    statistics: NDArray[np.float64]
    half_way: float
    residual: float
    depth: float
    reach: float
    gap_time: float


class OrbitFamily:
    """Equations for orbits of k mesh periods, as a `SolutionCurve`.

    The unknowns (n + 1,), called a *place*, are the scaled state divided by `SPAN`, then the
    parameter as a fraction of its range. `config` of the first orbit; `parameter`: name of the
    parameter; `period`: k; `limits`: range of the parameter (config's unit) and step sizes.

    Raises `InputError` for an unknown parameter.
    """

    def __init__(self, config: Config, parameter: str, period: int, limits: StepSizes):
        _check(config, parameter)
        self.config, self.parameter, self.period, self.limits = config, parameter, period, limits
        self.names = parameters(config)
        self.values = np.array([value_of(config, name) for name in self.names])
        self.index = self.names.index(parameter)
        self.scene = Scene.from_config(config)
        self.integrator = integrators(config)[1]
        self.width = limits.high - limits.low
        self.steps = dataclasses.replace(limits, low=0.0, high=1.0)
        # Keep the unit of ε of the first config while the parameter changes.
        self.unit = float(_unit(self.scene, self.names, self.values))

    @property
    def pair(self) -> RotorPair:
        """The pair of the first orbit."""
        return _pair(self.scene, self.names, self.values)

    def value(self, place: NDArray[np.float64]) -> float:
        """Return the value of the parameter (config's unit) at a `place`.

        `place` (n + 1,): unknowns, whose last entry is the parameter as a fraction of its range. At
        either end of the range, the value is that of `limits`, without rounding."""
        share = place[-1]
        return float(self.limits.high if share == 1 else self.limits.low + share * self.width)

    def place(self, state: ArrayLike, value: float) -> NDArray[np.float64]:
        """Return the unknowns (n + 1,) of an orbit at a `value` of the parameter (config's unit).

        `state` (n,): scaled for the config with this value."""
        scale = float(_unit(self.scene, self.names, self._values(value)))
        share = (value - self.limits.low) / self.width
        return np.append(np.asarray(state) * (scale / self.unit / SPAN), share)

    def _values(self, value: float) -> NDArray[np.float64]:
        values = self.values.copy()
        values[self.index] = value
        return values

    def closed(self, guess: NDArray[np.float64]) -> BranchPoint:
        """Return the orbit near the unknowns `guess` (n + 1,), at the same value of the parameter.

        Raises `StoppedError` if no orbit is found."""
        fixed = np.eye(len(guess))[-1]
        return self.point(corrected(self, guess, fixed, fixed))

    def __call__(self, place: NDArray[np.float64], memory: Any, careful: bool) -> Linearization:
        self._check_design(self.value(place))
        shot = self._shot(place, memory, refine=memory is None)
        if careful and memory is None:
            # Integrate again, on steps short enough to see contacts that the chosen steps skip.
            shot = self._shot(place, shot.grid, refine=True)
        out: Flow = shot.out
        count = len(place) - 1
        if not out.solved:
            raise StoppedError(End.SOLVER_FAILED)
        if not (np.all(np.isfinite(out.end)) and np.all(np.isfinite(out.slope[:count]))):
            raise StoppedError(End.NON_FINITE)
        if shot.lost:
            raise StoppedError(End.LOST_MESH)
        if out.depth > TOO_DEEP * float(self.scene.pitch_radius):
            raise StoppedError(End.TOO_DEEP)
        state = SPAN * place[:-1]
        miss = np.asarray(out.end) - state
        monodromy = np.asarray(out.slope)[:count, :count]
        by_share = out.slope[:count, count] * self.width / SPAN
        seen = OrbitData(
            monodromy=monodromy,
            to_state=np.eye(count),
            state=state * (self.unit / shot.scale),
            statistics=np.array([out.mean, out.peak, np.sqrt(out.mean_square)]),
            half_way=float(np.max(np.abs(out.states[len(out.states) // 2] - state))) / SPAN,
            residual=float(np.max(np.abs(miss)) / max(1.0, np.max(np.abs(state)))),
            depth=float(out.depth),
            reach=self.unit * float(np.max(np.abs(out.states[:, 0]))),
            gap_time=longest_gap(np.asarray(shot.touching)) * self.period,
        )
        if self.period % 2 == 0 and seen.half_way < HALF_ALIKE and seen.residual < RESIDUAL:
            raise StoppedError(End.HALVED)
        jacobian = np.column_stack([monodromy - np.eye(count), by_share])
        return Linearization(miss / SPAN, jacobian, shot.grid, seen)

    def _shot(self, place: NDArray[np.float64], grid: Any, refine: bool) -> "_Shot":
        return jax.device_get(
            _shoot(
                self.scene,
                self.names,
                self._values(self.value(place)),
                np.eye(len(self.names))[self.index],
                np.asarray(self.unit),
                SPAN * place[:-1],
                np.asarray(float(self.period)),
                self.integrator,
                np.full(self.integrator.max_steps, np.inf) if grid is None else grid,
                np.asarray(grid is not None),
                np.asarray(refine),
            )
        )

    def _check_design(self, value: float) -> None:
        """Raise `StoppedError` if the design has no valid profile at this `value`."""
        if self.parameter in design_keys(self.config):
            try:
                check_geometry(_with_design(self.config, self.parameter, value))
            except InputError:
                raise StoppedError(End.NO_GEOMETRY) from None

    def point(self, spot: Spot) -> BranchPoint:
        """Return the orbit at a `spot` of the curve."""
        seen: OrbitData = spot.look.data
        mean, peak, rms = map(float, seen.statistics)
        return BranchPoint(
            value=self.value(spot.place),
            state=seen.state,
            period=self.period,
            mean=mean,
            peak=peak,
            rms=rms,
            multipliers=np.linalg.eigvals(seen.monodromy).astype(complex),
            residual=seen.residual,
            slope=float(spot.tangent[-1]),
            gap_time=seen.gap_time,
            depth=seen.depth,
            reach=seen.reach,
            looks=spot.looks,
        )


def longest_gap(touching: NDArray[np.bool_]) -> float:
    """Return the longest run of False around a cycle, as a fraction of the cycle."""
    if not touching.any():
        return 1.0
    ends = np.flatnonzero(touching)
    gaps = np.diff(ends, append=ends[0] + len(touching)) - 1
    return float(np.max(gaps)) / len(touching)


def pair_at(
    scene: Scene, names: tuple[str, ...], values: Float[Array, " p"]
) -> tuple[RotorPair, Float[Array, ""]]:
    """Return the pair with these parameter `values` (config's units), and its unit of ε (rad).

    `names`: names of the parameters, as from `parameters`; `scene`: everything else."""
    at = dict(zip(names, values, strict=True))
    gear = scene.gear
    if gear is not None:
        half = at["backlash_mm"] * MM / (2 * scene.pitch_radius)
        gear = eqx.tree_at(lambda g: g.half_backlash, gear, half)
    tuned = dataclasses.replace(
        scene,
        speed=at["speed_rpm"] * RPM,
        load_torque=at.get("torque_N_m", scene.load_torque),
        pressure=at.get("pressure_difference_Pa"),
        gear=gear,
        gear_damping_ratio=at.get("damping_ratio", scene.gear_damping_ratio),
    )
    design = [value for name, value in at.items() if name not in PLACES]
    pair = tuned.pair(jnp.stack(design) if design else jnp.zeros(0))
    return pair, pair.angle_scale


@Program
def _pair(scene, names, values):
    return pair_at(scene, names, values)[0]


@Program
def _unit(scene, names, values):
    return pair_at(scene, names, values)[1]


@Program
def _shoot(  # Eleven parameters, since a compiled program takes its arrays one by one.
    scene: Scene,
    names: tuple[str, ...],
    values: Float[Array, " p"],
    direction: Float[Array, " p"],
    unit: Float[Array, ""],
    state: Float[Array, " n"],
    period: Float[Array, ""],
    integrator: Integrator,
    grid: Float[Array, " steps"],
    repeat: Bool[Array, ""],
    refine: Bool[Array, ""],
) -> _Shot:
    """Integrate `period` mesh periods from the scaled `state` (n,); `unit`: fixed unit of ε (rad).

    `names`, `values` (p,): names of the parameters, as from `parameters`, and their values
    (config's units), which replace those of `scene`. Derivatives are with respect to the state, and
    along `direction` (p,), a change of `values`. If `repeat`, the solver takes the steps of `grid`
    instead of adaptive ones. If `refine`, the returned grid is that of the flow, with step ends
    added where the equation is not smooth, and in long steps. Otherwise, it is `grid`.
    """

    def build(values):
        pair, scale = pair_at(scene, names, values)
        return eqx.tree_at(lambda p: p.angle_scale, pair, unit), scale

    def arrays(values):
        return eqx.filter(build(values)[0], eqx.is_inexact_array)

    pair, scale = build(values)
    _, tangent = jax.jvp(arrays, (values,), (direction,))
    tangents = jax.tree.map(lambda x: x[None], tangent)
    out = flow(pair, state, period, integrator, SAMPLES, tangents, grid, repeat)
    tolerance = integrator.tolerance
    finer = lax.cond(
        refine,
        lambda: _without_long(with_switches(pair, out, period, tolerance), period),
        lambda: grid,
    )
    stride = SAMPLES // LOOKS
    times = period * jnp.arange(LOOKS) / LOOKS

    def touches(tau, state):
        held = pair.gear is not None and jnp.any(pair.gear.switches(pair.motion(tau, state), None))
        return (pair.contact_at(tau, state).total > 0) | held

    touching = jax.vmap(touches)(times, out.states[::stride])
    farthest = jnp.maximum(jnp.max(jnp.abs(out.states[:, 0])), jnp.abs(out.end[0]))
    lost = (unit * farthest >= pair.angle_limit) | pair.lost(out.end)
    return _Shot(out, finer, lost, touching, scale)


def _without_long(grid: Float[Array, " steps"], period: Float[Array, ""]) -> Float[Array, " steps"]:
    """Return `grid` with step ends added, so that no step is much longer than `_STEP`.

    In free flight, the error control takes steps so long that a short contact may be missed. The
    end state would then jump when the initial state changes a little. `period`: length of the
    motion (mesh periods).
    """
    ends = _STEP * jnp.arange(1, LONGEST / _STEP)
    after = jnp.searchsorted(grid, ends)
    before = jnp.where(after > 0, grid[after - 1], 0.0)
    clear = jnp.minimum(ends - before, grid[after] - ends) > _STEP / 4
    ends = jnp.where(clear & (ends < period), ends, jnp.inf)
    return jnp.sort(jnp.concatenate([grid, ends]))[: grid.shape[0]]
