"""Each precision gives a sound result with each contact, method and form of gradient.

The usual suite compiles each contact and each method in either precision by itself. It runs one
whole command in single precision; the whole grid is in long runs."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.commands import simulate
from rootsopt.config import load
from rootsopt.dynamics.flow import strobe
from rootsopt.dynamics.integrator import METHODS, Integrator
from rootsopt.errors import InputError
from rootsopt.optimize.search import method_of
from rootsopt.response import choice, series
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.steady import steady_response
from rootsopt.scene import Scene, design_vector
from rootsopt.status import Status

CIC = "configs/cic.yaml"
PRECISIONS = ("float64", "float32")
CONTACTS = ("search", "map", "linear", "nodes")
TIGHT = {"float64": 1e-6, "float32": 1e-3}
"""Relative difference allowed from the forces by tsit5 in double precision, with the same
contact."""
SLOPES = {"float64": 1e-3, "float32": 0.05}
"""Relative difference allowed of the mean's gradient, as a share of its greatest component."""
NODES = 5e-3
"""Relative difference allowed of mean and RMS of contact by nodes.

The force has a step at every node."""
NODES_PEAK = 0.03
"""Relative difference allowed of the peak of contact by nodes.

The peak may lie on a single step, which is the error of this contact's peak."""


def config_of(precision, contact="search", method="tsit5", *overrides):
    solver = {"precision": precision, "fidelity": contact, "method": method}
    return load(CIC, [f"solver.{key}={value}" for key, value in solver.items()] + [*overrides])


def pair_of(config):
    return eqx.filter_jit(Scene.pair)(Scene.from_config(config), design_vector(config))


STATES = np.array([[-1.02, 0.0], [-1.05, 0.3], [0.5, 0.1], [-1.1, -0.2], [-1.1, -0.2]])
# The last two are one instant of a turn of three lobes.
TIMES = np.array([0.7, 1.6, 2.2, 1.7, 30_000_001.7])


def series_of(precision, contact):
    pair = pair_of(config_of(precision, contact))
    return series.series_of(pair, TIMES, STATES.astype(pair.angle_scale.dtype))


@pytest.mark.parametrize("contact", CONTACTS)
def test_series_of_every_contact(contact):
    """Times are double whatever the states are, and late times lose nothing in single precision."""
    single, double = (series_of(precision, contact) for precision in reversed(PRECISIONS))
    values = [getattr(single, field.name) for field in dataclasses.fields(single)]
    assert all(value.dtype == np.float64 for value in values if value is not None)
    assert np.all(double.force > 0)
    # The gap is known to some 3 nm where it is searched for, of a depth of micrometres.
    np.testing.assert_allclose(single.force, double.force, rtol=0.01)
    assert single.force[4] == pytest.approx(single.force[3], rel=1e-4)
    np.testing.assert_allclose(single.rotation, double.rotation, rtol=1e-12)
    np.testing.assert_allclose(single.time, double.time, rtol=1e-6)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("method", METHODS)
def test_every_method_takes_states_of_either_precision(method, precision):
    """Each method works over two mesh periods of the linear contact, the fastest to compile."""
    pair = pair_of(config_of(precision, "linear"))
    dtype = pair.angle_scale.dtype
    how = Integrator(method, jnp.asarray(1e-6), 4096)
    out = eqx.filter_jit(strobe)(pair, jnp.zeros(2, dtype), 2, how)
    assert out.states.dtype == dtype
    assert bool(out.solved)
    np.testing.assert_allclose(out.states[-1], reference(), atol=2e-3)


def reference():
    """Return the state after two mesh periods, by dopri8 at a tight tolerance."""
    if not _KNOWN:
        pair = pair_of(config_of("float64", "linear"))
        how = Integrator("dopri8", jnp.asarray(1e-10), 4096)
        _KNOWN.append(np.asarray(eqx.filter_jit(strobe)(pair, jnp.zeros(2), 2, how).states[-1]))
    return _KNOWN[0]


_KNOWN: list[np.ndarray] = []


def test_a_whole_command_in_single_precision(tmp_path):
    """Contact by search: series, figures and animation are written, and the forces are right."""
    arguments = [CIC, "-o", str(tmp_path), "--set", "solver.precision=float32", "--export", "gif"]
    assert simulate.main(arguments) == 0
    found = json.loads((tmp_path / "result.json").read_text())
    truth = Evaluator.of(load(CIC))(series=False)
    assert found["response"] == pytest.approx(truth.response, rel=TIGHT["float32"])
    forces = np.loadtxt(tmp_path / "response_design.csv", delimiter=",", skiprows=1)[:, 6]
    assert np.mean(forces) == pytest.approx(truth.response["mean_force_N"], rel=2e-3)
    assert (tmp_path / "figures" / "meshing.gif").stat().st_size > 10_000


# Contact by nodes


def test_nodes_give_forces_without_a_gradient():
    """Contact by nodes gives forces near those of the search, at its own tolerance.

    A message says so. Derivatives in Python are NaN, and an optimisation is refused before it
    simulates anything."""
    config = config_of("float64", "nodes")
    assert config.solver.orbit_tolerance == config.solver.transient_tolerance == 3e-5
    given = config_of("float64", "nodes", "tsit5", "solver.rtol=1e-6")
    assert (given.solver.orbit_tolerance, given.solver.transient_tolerance) == (1e-6, 3e-5)
    found = Evaluator.of(config)(series=False)
    truth = Evaluator.of(load(CIC))(series=False)
    assert found.status is Status.PERIODIC
    assert found.response["mean_force_N"] == pytest.approx(
        truth.response["mean_force_N"], rel=NODES
    )
    assert found.gradient == {}
    assert "no gradient" in found.message
    with pytest.raises(InputError, match=r"`solver\.fidelity` must be search.*nodes"):
        method_of(config)


@pytest.mark.long
def test_derivatives_by_nodes_are_not_numbers():
    config = config_of("float64", "nodes")
    scene = Scene.from_config(config)
    value, slope = jax.value_and_grad(lambda x: steady_response(scene, x).mean)(config.design)
    assert np.isfinite(value)
    assert np.all(np.isnan(slope))


# The whole grid


@pytest.fixture(scope="module")
def truths():
    """Return evaluations by tsit5 in double precision, by contact."""
    found: dict[str, object] = {}

    def truth(contact):
        if contact not in found:
            found[contact] = Evaluator.of(config_of("float64", contact))(series=False)
        return found[contact]

    return truth


@pytest.mark.long
@pytest.mark.parametrize("gradient", ["forward", "reverse"])
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("contact", [*CONTACTS, "auto"])
def test_grid(contact, method, precision, gradient, truths):
    """Each combination agrees with tsit5 in double precision."""
    config = config_of(precision, contact, method, f"solver.gradient={gradient}")
    config, _ = choice.resolve(config)
    found = Evaluator.of(config)()
    assert found.status is Status.PERIODIC
    truth = truths(config.solver.fidelity)
    if contact == "nodes":
        for name, value in truth.response.items():
            most = NODES_PEAK if name == "peak_force_N" else NODES
            assert found.response[name] == pytest.approx(value, rel=most)
        assert found.gradient == {}
        return
    tight = 1e-3 if contact == "auto" else TIGHT[precision]
    assert found.response == pytest.approx(truth.response, rel=tight)
    slopes, expected = (one.gradient["mean_force_N"] for one in (found, truth))
    most = max(map(abs, expected.values()))
    assert slopes == pytest.approx(expected, abs=SLOPES[precision] * most)
    assert np.mean(found.series.force) == pytest.approx(found.response["mean_force_N"], rel=2e-3)
