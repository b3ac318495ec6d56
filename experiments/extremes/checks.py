"""Checks of each scene: finite numbers, named status, deviation from a reference."""

import dataclasses
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from experiments._common.batch import coarse, respond
from experiments._common.shooting import closed as shot_of
from experiments._common.simulation import pair_of_model, stacked
from experiments.extremes.scenes import Kind
from rootsopt.config import Config
from rootsopt.dynamics.integrator import Integrator
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene, design_vector
from rootsopt.status import Status

# Longest transient (mesh periods) of most scenes.
HORIZON = 24

# Maximum number of solver steps in a mesh period.
STEPS = 1024

# Deviation of a force (tolerances, relative to the larger of true and static force) above which a
# promise is broken.
ALLOWED = 100.0

# Tolerance below which the limit on the deviation no longer falls. A peak on a corner of the
# force is known only to about 1e-8 (docs/accuracy.md).
CORNER = 1e-9

# Distance between start and end (scaled) above which a reference is not closed.
CLOSED = 1e-9

# Contact oscillations per mesh period above which SciPy (explicit, in Python) is not used.
FEW = 50
DEPTHS = np.concatenate([[-1e-3, 0.0], np.geomspace(1e-36, 1e-2, 39)])
RATES = np.concatenate([-np.geomspace(1e-9, 1e3, 7), [0.0], np.geomspace(1e-9, 1e3, 4)])

# Number of random states of each scene at which the equation of motion is evaluated.
POSES = 4


@dataclasses.dataclass
class Case:
    """A scene, its row in the table, and the scaled state of its orbit if known."""

    kind: Kind
    config: Config
    row: dict[str, Any]
    state: Any = None


# Promise 1: the law and the equation


@eqx.filter_jit
def _law_values(laws, depths, rates):
    def one(law):
        def at(depth, rate):
            slopes = jax.grad(lambda *x: x[0](*x[1:]), argnums=(0, 1, 2))(law, depth, rate)
            return jnp.stack([law(depth, rate), *jax.tree.leaves(slopes)])

        table = jax.vmap(lambda d: jax.vmap(lambda r: at(d, r))(rates))(depths)
        return jnp.sum(~jnp.isfinite(table)), jnp.sum(table[..., 0] < 0)

    return jax.lax.map(one, laws)


@eqx.filter_jit
def _equation_values(models: Scene, designs, poses):
    def one(at):
        model, design, poses = at

        def slope(design, pose):
            pair = model.pair(design)
            scale = pair.angle_scale
            state = pose[1:].astype(scale.dtype)
            found, contact = pair.derivative(pose[0].astype(scale.dtype), state)
            return jnp.append(found, contact.total)

        def all_of(pose):
            jacobians = jax.jacfwd(slope, argnums=(0, 1))(design, pose)
            return jnp.concatenate([slope(design, pose), *(x.ravel() for x in jacobians)])

        return jnp.sum(~jnp.isfinite(jax.vmap(all_of)(poses)))

    return jax.lax.map(one, (models, designs, poses))


def law(cases: list[Case]) -> dict[str, Any]:
    """Count the values of the contact laws that are not finite or negative, over all scenes."""
    laws = [jax.tree.map(np.asarray, Scene.from_config(case.config).law) for case in cases]
    laws = jax.tree.map(lambda *leaves: np.stack(leaves), *laws)
    bad, negative = _law_values(laws, jnp.asarray(DEPTHS), jnp.asarray(RATES))
    return {
        "values": len(cases) * DEPTHS.size * RATES.size,
        "not_finite": int(np.sum(bad)),
        "negative": int(np.sum(negative)),
    }


def equation(cases: list[Case], seed: int) -> dict[str, Any]:
    """Count non-finite values of the equation of motion and of its derivatives.

    Derivatives are with respect to state and design. Times and states are random; ε reaches 30 of
    the solver's units (play and static penetration together) on either side.
    """
    draw = np.random.default_rng(seed)
    found: dict[str, Any] = {}
    groups: dict[tuple, list[Case]] = {}
    for case in cases:
        kind = case.kind
        groups.setdefault((kind.family, kind.lobes, kind.scene), []).append(case)
    for (family, lobes, scene), members in groups.items():
        if lobes in (4, 5):
            continue
        states = members[0].kind.states
        configs = [case.config for case in members]
        designs = np.stack([np.asarray(design_vector(config)) for config in configs])
        size = np.exp(draw.uniform(np.log(1e-9), np.log(30), (len(members), POSES, states)))
        signed = size * draw.choice([-1, 1], size.shape)
        signed[..., 1] *= 100
        times = draw.uniform(0, 1, (*size.shape[:2], 1))
        poses = np.concatenate([times, signed], axis=-1)
        bad = _equation_values(stacked(configs), designs, poses)
        name = f"{family} {lobes}, {scene}"
        found[name] = {"scenes": len(members), "not_finite": int(np.sum(bad))}
    return found


# Promise 2: the motion


@CachedFunction
def _simulate(model: Scene, design, tolerances, method: str):
    pair = model.pair(design)
    transient, orbit = (Integrator(method, tolerances[k], STEPS) for k in range(2))
    solver = coarse(model, transient, orbit, HORIZON)
    out = respond(model, design, jnp.zeros(pair.states), solver)
    assert pair.timescales is not None
    swings = pair.mesh_period / (2 * jnp.pi * pair.timescales.swing)
    return out, swings, pair.force_scale


def _arguments(case: Case) -> tuple[Any, ...]:
    model = jax.tree.map(np.asarray, Scene.from_config(case.config))
    solver = case.config.solver
    tolerances = np.array([solver.transient_tolerance, solver.orbit_tolerance])
    return model, np.asarray(design_vector(case.config)), tolerances, case.kind.method


def prepare(case: Case) -> None:
    """Compile in the background the program that simulates scenes of this kind."""
    _simulate.prepare(*_arguments(case))


def simulate(case: Case) -> None:
    """Simulate a scene from rest and complete its row."""
    arguments = _arguments(case)
    began = time.perf_counter()
    found = _simulate(*arguments)
    out, swings, force = jax.device_get(found)
    status = Status.of(int(out.status))
    numbers = np.concatenate([np.ravel(out.response), np.ravel(out.gradient)])
    mean, peak, rms = map(float, out.response)
    case.state = np.asarray(out.state, np.float64)
    case.row |= {
        "seconds": time.perf_counter() - began,
        "steps": int(out.steps),
        "swings": float(swings),
        "static_force_N": float(force),
        "status": status.label,
        "period": int(out.period),
        "multiplier": float(out.multiplier),
        "mean_force_N": mean,
        "peak_force_N": peak,
        "rms_force_N": rms,
        # A usable status must have finite numbers, and only a usable status may look like a result.
        "named": bool(np.all(np.isfinite(numbers)) if status.usable else np.all(np.isnan(numbers))),
    }


# Promise 3: the truth


@eqx.filter_jit
def _rates(pair, tau, state):
    slope, contact = pair.derivative(tau, state)
    return jnp.append(slope, contact.total / pair.force_scale)


def refine(case: Case) -> None:
    """Measure how far a periodic result deviates from the nearby orbit closed by shooting."""
    pair = pair_of_model(Scene.from_config(case.config), design_vector(case.config))
    truth = shot_of(pair, case.state, int(case.row["period"]))
    closed = truth.miss < CLOSED
    mean, peak, _ = truth.forces
    names = ("mean_force_N", "peak_force_N", "rms_force_N")
    found = np.array([case.row[name] for name in names])
    off = np.abs(found - truth.forces) / np.maximum(truth.forces, case.row["static_force_N"])
    allowed = ALLOWED * max(case.config.solver.orbit_tolerance, CORNER)
    case.row |= {
        "reference": "closed" if closed else "not closed",
        "reference_mean_N": float(mean),
        "reference_peak_N": float(peak),
        "mean_off": float(off[0]),
        "peak_off": float(off[1]),
        "share_of_allowed": float(max(off[:2]) / allowed),
    }
    case.state = truth.state


def by_scipy(case: Case) -> None:
    """Integrate one period of the orbit (of the reference, if there is one) with SciPy.

    Writes the distance between start and end, and the mean force, into the row.
    """
    model = Scene.from_config(case.config)
    pair = pair_of_model(model, design_vector(case.config))
    period = case.row["period"]
    done = solve_ivp(
        lambda tau, y: np.asarray(_rates(pair, tau, y[:2])),
        (0.0, float(period)),
        np.append(case.state, 0.0),
        method="DOP853",
        rtol=1e-11,
        atol=1e-11,
        max_step=1 / 32,
    )
    mean = done.y[2, -1] / period * float(pair.force_scale)
    truth = case.row.get("reference_mean_N", case.row["mean_force_N"])
    case.row |= {
        "scipy_end": float(np.max(np.abs(done.y[:2, -1] - case.state))),
        "scipy_mean_off": abs(mean - truth) / max(truth, case.row["static_force_N"]),
    }
