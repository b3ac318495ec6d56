"""The steady response as a pure function, differentiable with respect to scene and design.

The derivative of an orbit comes from the implicit function theorem: JAX never differentiates
through the search for the orbit. All requested derivatives are columns of one matrix, computed with
the orbit. JAX transformations only multiply by this matrix. Therefore forward and reverse mode
agree to rounding. Derivatives that are not requested are not computed.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Complex, Float, Int
from numpy.typing import ArrayLike

from rootsopt.dynamics.closed import Start, examined, steady_motion
from rootsopt.dynamics.integrator import Solver
from rootsopt.dynamics.linear import eigenvalues
from rootsopt.dynamics.pair import RotorPair
from rootsopt.dynamics.reserve import reserve
from rootsopt.dynamics.steady import CLOSED, OPEN, Steady, among, varied
from rootsopt.profiles.soundness import Soundness
from rootsopt.runtime.environment import check_precision
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene.build import Scene, along
from rootsopt.status import Status


class Response(NamedTuple):
    """The steady response of one design in one scene. If it was mapped (`vmap`), all fields have
    leading axes.

    `mean`, `peak`, `rms`: contact force (N); `lines` (lines,): amplitudes (N) of the spectral lines
    that the scene requests, in the same order (0 if the motion does not contain the line);
    `peak_norm`: p-norm (N), None unless the scene requests it; `period`: mesh periods of the orbit;
    `multipliers` (n,): Floquet multipliers, greatest modulus first; `residual`: scaled distance
    between the start and the end of the orbit; `status`: code of a `Status` (`Status.of(code)`);
    `state` (n,) at φ1 = 0 in SI units: ε (rad), dε/dt (rad/s), then the states of parts, such as
    the excess of a motor's speed over the scene's (rad/s); `margins`: margins of all checks of the
    design (m, rad or ratios, see `Soundness`). The status is unsound if one of them is negative;
    `Response.margins.failed` names it. `contact_reserve`: least gap of the flanks (m); negative:
    greatest penetration; `backlash_reserve`: half the backlash (rad) by which that of the timing
    gear may grow until the flanks touch, as `scene.gear.half_backlash`. Both are None unless the
    scene has a gear and requests them (`response.reserve`), and NaN without an orbit. `start`:
    argument `start` for similar designs and scenes, a pytree of arrays whose shapes depend only on
    the kind of scene. It can be mapped, carried by `scan`, and pickled.

    The forces are those of the orbit, or 0 without contact (status idle). If the motion does not
    settle, the forces are those of a window of 128 mesh periods. In all other cases, the forces are
    NaN. If the motion is not periodic, `period` is 0, and `multipliers` and `residual` are NaN. If
    the design is unsound, `state` is NaN, too.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic")
    >>> scene = rootsopt.Scene.from_config(config)
    >>> response = rootsopt.steady_response(scene, config.design, start=[0.0, 0.0])  # at rest
    >>> rootsopt.Status.of(response.status).label, int(response.period), response.lines.shape
    ('periodic', 1, (0,))
    """

    mean: Float[Array, ""]
    peak: Float[Array, ""]
    rms: Float[Array, ""]
    lines: Float[Array, " lines"]
    peak_norm: Float[Array, ""] | None
    period: Int[Array, ""]
    multipliers: Complex[Array, " n"]
    residual: Float[Array, ""]
    status: Int[Array, ""]
    state: Float[Array, " n"]
    margins: Soundness
    contact_reserve: Float[Array, ""] | None
    backlash_reserve: Float[Array, ""] | None
    start: Start


def steady_response(
    scene: Scene, design: ArrayLike, start: Start | ArrayLike | None = None
) -> Response:
    """Return the steady response of a `design` (d,) in config units, in a `scene`.

    `start`: `Response.start` of a similar design or scene, near whose orbit this one is closed in a
    few milliseconds; or a state (n,) at φ1 = 0 from which the motion begins (SI units, as
    `Response.state`); by default at rest. If the orbit cannot be used, the motion begins at its
    state. All values of `start` that lead to the same motion give the same response.

    This is a pure function. It works under `jit`, `vmap`, `grad`, `jvp`, `jacfwd` and `jacrev`,
    with respect to the design and to every physical quantity of the scene. The derivatives of
    forces, `state` and reserves are those of the orbit, by the implicit function theorem. They are
    NaN unless the status is periodic, or idle on a stable orbit. `multipliers`, `residual` and
    `margins` are constants to JAX, with derivative 0. Only first derivatives are available. On a
    CPU, `vmap` computes one motion after the other; on a GPU, all together.

    `jax.jit` of a function that calls this one compiles twice as fast with the option
    `compiler_options=rootsopt.COMPILER_OPTIONS`.

    Without a usable orbit, forces are those of a window of the motion, and derivatives
    are NaN.

    Raises ValueError if the design has the wrong shape, or if `start` belongs to another kind of
    scene; RuntimeError if JAX is not set to double precision; NotImplementedError if a
    second derivative is requested.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> config = rootsopt.load_config("cic")
    >>> scene = rootsopt.Scene.from_config(config)
    >>> response = rootsopt.steady_response(scene, config.design, start=[0.0, 0.0])  # at rest
    >>> print(f"mean {response.mean:.1f} N, peak {response.peak:.1f} N")
    mean 26.8 N, peak 102.0 N

    With `jax.grad(lambda design: rootsopt.steady_response(scene, design).mean)(config.design)` the
    gradient of the mean force follows, in N per unit of `config.design_keys`.
    """
    check_precision()
    design = jnp.asarray(design, float)
    if design.ndim != 1:
        raise ValueError(
            f"Argument `design` must be an array (d,), but has shape {design.shape}; map over "
            "several designs with jax.vmap"
        )
    expected = scene.design_size
    if design.shape[0] != expected:
        raise ValueError(
            f"Argument `design` must have {expected} entries for this scene, but has "
            f"{design.shape[0]}; see `config.design_keys`"
        )
    if not (start is None or isinstance(start, Start)):
        start = jnp.asarray(start, float)
    return _response(scene, design, start)


@eqx.filter_custom_jvp
def _response(scene: Scene, design, start) -> Response:
    return _solved(scene, design, start, ())[0]


@_response.def_jvp
def _response_jvp(primals, tangents):
    scene, design, start = primals
    moved, without = _moved(*tangents[:2])
    response, slopes = _solved(scene, design, start, tuple(at for at, _ in moved))
    values = _change(slopes, [tangent for _, tangent in moved], without)
    same: Any = {name: jax.tree.map(lambda _: None, getattr(response, name)) for name in _CONSTANT}
    return response, response._replace(**same, **_split(values, response))


@jax.jit
def _change(slopes: Array, moved: list[Array], without: list[Array]) -> Array:
    """Return `slopes` (rows, m) times the `moved` tangents, which have m entries in total.

    Leaves that cannot be differentiated make every derivative NaN; their tangents are `without`.
    As one program, it compiles quickly where the caller does not use `jax.jit`."""
    flat = [jnp.ravel(tangent) for tangent in moved]
    vector = jnp.concatenate(flat) if flat else jnp.zeros(0, slopes.dtype)
    unknown = jnp.nan * sum((jnp.sum(tangent) for tangent in without), start=jnp.sum(vector))
    return slopes @ vector + (unknown if without else 0.0)


def _moved(scene: Any, design: Any) -> tuple[list[tuple[int, Array]], list[Array]]:
    """Return the tangents that are not None, in two lists. A tangent of None stands for zero.

    The first list holds (number of the leaf, tangent) for differentiable leaves. The second list
    holds the tangents of a measured outline, for which there are no derivatives."""
    numbers, leaves = [], []
    every = jax.tree_util.tree_leaves_with_path((scene, design), is_leaf=lambda x: x is None)
    for number, (path, leaf) in enumerate(every):
        name = getattr(path[1], "name", "") if len(path) > 1 else ""
        # The solver holds numerical settings, not physical quantities.
        if leaf is None or name == "solver":
            continue
        if name == "outline":
            leaves.append(leaf)
        else:
            numbers.append((number, leaf))
    return numbers, leaves


# Fields of a response that are constant to JAX.
_CONSTANT = "period", "multipliers", "residual", "status", "margins", "start"


def _split(values, response: Response) -> dict[str, Any]:
    fields, place = {}, 0
    for name, old in response._asdict().items():
        if name not in _CONSTANT:
            end = place + jnp.size(old) if old is not None else place
            fields[name] = None if old is None else values[place:end].reshape(jnp.shape(old))
            place = end
    return fields


def _solved(scene: Scene, design, start, along: tuple[int, ...]) -> tuple[Response, Array]:
    """Return the response, and the derivatives (rows, m) of its differentiated fields.

    `along`: indices of the leaves of scene and design with respect to which to differentiate. The
    leaves have m entries in total."""
    arguments = scene, design, start, along
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arguments)):
        return _inline(*arguments)
    solution = _compiled(*arguments, False)
    # Rare: a window has a separate program, which is compiled only now.
    status = Status.of(solution[0].status)
    return _compiled(*arguments, True) if status in OPEN else solution


def _solve(
    scene: Scene, design, start, numbers: tuple[int, ...], windowed: bool = True
) -> tuple[Response, Array]:
    """Return the results of `_solved`.

    `numbers`: its argument `along`; `windowed`: whether to examine a motion that does not settle.
    """
    leaves, tree = jax.tree.flatten((scene, design), is_leaf=lambda x: x is None)
    chosen = [leaves[k] for k in numbers]

    def build(values):
        every = list(leaves)
        for k, value in zip(numbers, values, strict=True):
            every[k] = value
        moved, parameters = jax.tree.unflatten(tree, every)
        return moved.pair_and_shape(parameters)

    pair, tangents, _ = along(build, chosen, _basis(chosen))
    start = _start_of(pair, start, scene.solver)
    radius, solver = scene.pitch_radius, scene.solver
    motion = steady_motion(pair, tangents, start, radius, solver)
    if windowed:
        motion = examined(pair, motion, solver)
    return _named(scene.solver, pair, tangents, motion)


def _start_of(pair: RotorPair, start: Any, solver: Solver) -> Start:
    """Return the argument `start` of `steady_response` as a `Start` for the motion of `pair`.

    Raises ValueError if it belongs to another kind of scene."""
    if not isinstance(start, Start):
        rest = pair.in_si(jnp.zeros(pair.states, pair.angle_scale.dtype))
        state = rest if start is None else jnp.asarray(start)
        if state.shape != rest.shape:
            raise ValueError(
                f"Argument `start` must be a state ({pair.states},) of this scene, or the field "
                f"`start` of a response, but has shape {state.shape}; see `Response.state`"
            )
        return Start.at(pair, state, solver.max_orbit)
    usual = jax.eval_shape(lambda: Start.at(pair, start.state, solver.max_orbit))
    if not start.fits(usual):
        raise ValueError(
            "Argument `start` must come from a response of the same kind of scene (family, lobes, "
            "parts, solver settings), but comes from another one; pass its `start.state`, or None"
        )
    return start


def _state(pair: RotorPair, tangents: RotorPair, motion: Steady):
    """Return the state (n,) in SI units, and its derivatives (n, m) along the family of orbits.

    The state is on the orbit or, without an orbit, at the end of the transient."""
    dynamic, static = eqx.partition(pair, eqx.is_inexact_array)

    def in_si(dynamic, state):
        return eqx.combine(dynamic, static).in_si(state)

    def along(tangent, moved):
        return jax.jvp(in_si, (dynamic, motion.orbit.state), (tangent, moved))[1]

    closed = among(motion.status, (*CLOSED, Status.IDLE))
    state = jnp.where(closed, motion.orbit.state, motion.settled.state)
    state = jnp.where(pair.sound, state, jnp.nan)
    directions = eqx.filter(tangents, eqx.is_inexact_array)
    return pair.in_si(state), jax.vmap(along)(directions, motion.orbit.moved.T).T


def _basis(leaves: list[Array]) -> list[Array]:
    """Return the unit directions of all entries of the `leaves`, stacked along a leading axis."""
    sizes = [leaf.size for leaf in leaves]
    unit, ends = np.eye(sum(sizes)), np.cumsum(sizes, dtype=int)
    return [
        jnp.asarray(unit[:, end - leaf.size : end].reshape(len(unit), *leaf.shape), leaf.dtype)
        for leaf, end in zip(leaves, ends, strict=True)
    ]


def _next_start(pair: RotorPair, motion: Steady, state: Float[Array, " n"]) -> Start:
    """Return `Response.start`. After a motion that fails, the next one begins at rest."""
    lost = Status.UNSOUND, Status.PASSED_THROUGH, Status.STALLED
    failed = among(motion.status, (*lost, Status.NON_FINITE, Status.SOLVER_FAILED))
    rest = pair.in_si(jnp.zeros_like(state))
    closed = among(motion.status, CLOSED) | motion.held
    known = motion.known._replace(sound=motion.known.sound & closed)
    numbers = eqx.filter(pair, eqx.is_inexact_array)
    return Start(jnp.where(failed, rest, state), known, numbers)


def _named(solver: Solver, pair: RotorPair, tangents: RotorPair, motion: Steady):
    measures = solver.measures
    orbit, period = motion.orbit, motion.period
    closed = among(motion.status, CLOSED) | motion.held
    mean, square, peak, *others = motion.forces
    by_mean, by_square, by_peak, *by_others = motion.sensitivity
    rms = jnp.sqrt(jnp.maximum(square, 0.0))
    by_rms = by_square / (2 * jnp.maximum(rms, 1e-150))
    sizes, slopes = measures.amplitudes(others, by_others, period)
    state, by_state = _state(pair, tangents, motion)
    rows = [by_mean, by_peak, by_rms, *slopes]
    reserves: list[Any] = [None, None]
    by_reserves = jnp.zeros((0, by_mean.shape[0]))
    if solver.variation and pair.gear is not None:
        known, by_reserves = reserve(pair, tangents, varied(motion))
        reserves = [*jnp.where(closed, known, jnp.nan)]
    norm = None
    if measures.norm is not None:
        norm = others[-1]
        rows.append(by_others[-1])
    periodic = (motion.status == Status.PERIODIC.code) | motion.held
    rows = jnp.concatenate([jnp.stack(rows), by_state, by_reserves])
    monodromy = jnp.where(closed, orbit.monodromy, jnp.nan)
    assert pair.soundness is not None
    response = Response(
        mean=mean,
        peak=peak,
        rms=rms,
        lines=sizes,
        peak_norm=norm,
        period=jnp.where(closed, period, 0),
        multipliers=eigenvalues(monodromy),
        residual=jnp.where(closed, orbit.residual, jnp.nan),
        status=motion.status,
        state=state,
        margins=pair.soundness,
        contact_reserve=reserves[0],
        backlash_reserve=reserves[1],
        start=_next_start(pair, motion, state),
    )
    # Without weak types: a start that has them would be compiled for once more.
    response, rows = jax.tree.map(
        lambda x: x.astype(float) if eqx.is_inexact_array(x) and jnp.isrealobj(x) else x,
        (response, rows),
    )
    return response, jnp.where(periodic, rows, jnp.nan)


@eqx.filter_custom_jvp
def _once(scene, design, start, numbers):
    dynamic, static = eqx.partition((scene, design, start), eqx.is_array)

    def solve(dynamic):
        scene, design, start = eqx.combine(dynamic, static)
        return _solve(scene, design, start, numbers)

    # On a CPU, the motions of a batch are computed one by one. As arrays, all of them would take
    # as many steps as the longest, and both branches of every condition: 20 times longer.
    if jax.default_backend() == "cpu":
        solve = sequential_vmap(solve)
    return solve(dynamic)


@_once.def_jvp
def _once_jvp(primals, tangents):
    del primals, tangents
    raise NotImplementedError(
        "The steady response has first derivatives only: differentiate it once, and use a method "
        "that needs no second derivatives (BFGS, Gauss-Newton)"
    )


_inline = eqx.filter_jit(_once)
_compiled = CachedFunction(_solve)
