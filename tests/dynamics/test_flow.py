"""Tests of what an integration compiles."""

import os
import subprocess
import sys

_COUNT = """
import jax, jax.numpy as jnp, rootsopt
from rootsopt.dynamics.flow import one_period, strobe
from rootsopt.dynamics.integrator import Integrator

jax.config.update("jax_enable_x64", True)
config = rootsopt.load_config("configs/ee.yaml")
pair = rootsopt.Scene.from_config(config).pair(config.design)
how = Integrator("tsit5", jnp.asarray(1e-8), 1024)
state = jnp.zeros(2)
programs = (
    lambda state: strobe(pair, state, 4, how),
    lambda state: one_period(pair, state, how),
)
print([str(jax.make_jaxpr(program)(state)).count("callback") for program in programs])
"""


def test_no_callback_to_python_in_an_integration():
    """An integration has no callback to Python, because programs with callbacks cannot be cached.

    Equinox's checks of the arguments of diffrax would be such callbacks. A command turns them off,
    but a caller from Python does not."""
    variables = {name: x for name, x in os.environ.items() if name != "EQX_ON_ERROR"}
    command = [sys.executable, "-c", _COUNT]
    done = subprocess.run(command, env=variables, check=True, capture_output=True, text=True)
    assert done.stdout == "[0, 0]\n"
