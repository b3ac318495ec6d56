"""Steady state: closed orbit, its statistics and gradients, and the status of what has none."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.dynamics.flow import Integrator, flow, strobe
from rootsopt.dynamics.steady import floquet
from rootsopt.evaluate import RESPONSES, Evaluator, evaluate
from rootsopt.model import DESIGN_KEYS
from rootsopt.status import Status

# The scene of the shipped configs as it was when the figures below were measured.
SCENE = (
    "scene.speed_rpm=3000",
    "scene.load.torque_N_m=4.775",
    "scene.timing_gear={stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.3, backlash_mm: 0.1}",
)
# The reference settings: contact by search, and a solver of order eight near rounding.
SHARP = ("solver.fidelity=search", "solver.method=dopri8", "solver.rtol=1e-12")
DESIGNS = {"paper": (36.43, 9.0, 4.0), "shorter involute": (36.43, 8.0, 4.0)}


def config_of(*overrides, path="configs/cic.yaml"):
    return load(path, [*SCENE, *overrides])


def gear(**changes):
    """Overrides for a scene with another gear, load or speed."""
    names = {"damping": "timing_gear.damping_ratio", "backlash": "timing_gear.backlash_mm"}
    names |= {"load": "load.torque_N_m", "speed": "speed_rpm"}
    return [f"scene.{names[key]}={value}" for key, value in changes.items()]


def numbers(evaluation):
    return np.array([evaluation.response[name] for name in RESPONSES])


def gradients(evaluation):
    """(response, design parameter)."""
    rows = (evaluation.gradient[name] for name in RESPONSES)
    return np.array([[row[key] for key in DESIGN_KEYS] for row in rows])


@eqx.filter_jit
def run_strobe(pair, state, periods, how):
    return strobe(pair, state, periods, how)


@eqx.filter_jit
def force_between(pair, start, fractions, how):
    """Contact force at `fractions` of a mesh period, each integrated to, from `start`."""
    ends = strobe_at(pair, start, fractions, how)
    return jax.vmap(lambda t, y: pair.contact_at(t, y).total)(fractions, ends)


def strobe_at(pair, start, times, how):
    """States at ascending `times` (mesh periods), every one of them a solver step."""
    import diffrax

    return diffrax.diffeqsolve(
        diffrax.ODETerm(lambda tau, y, _: pair.derivative(tau, y)[0]),
        how.solver,
        t0=0.0,
        t1=times[-1],
        dt0=1e-4,
        y0=start,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.ClipStepSizeController(how.controller, step_ts=times),
        max_steps=200_000,
    ).ys
