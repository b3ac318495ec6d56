"""Tests of the page on parts and contact laws: its files are imported from outside the package.

They pass the conformance suites. Their motions conserve energy and have correct gradients."""

import importlib
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.shooting import closed, differentiated
from rootsopt import steady_response
from rootsopt.config import load
from rootsopt.dynamics.parts import Context
from rootsopt.scene import Scene
from rootsopt.status import Status
from tests.conformance.laws import check_law
from tests.conformance.parts import check_in_pair, check_part

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
BLOCK = re.compile(r"^```python (\S+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
MODULES = "coupling.py", "law.py"
LONGEST = 60
COUPLING = {"stiffness": 8000.0, "damping": 6.0, "buffer": 4000.0, "stop": 7.0e-4}
LAW = {"stiffness": 2.0e10, "exponent": 1.5, "loss": 0.4}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Return the page's modules by name, and its scripts."""
    folder, scripts = tmp_path_factory.mktemp("outside"), []
    found = {}
    sys.path.insert(0, str(folder))
    try:
        for name, text in BLOCK.findall(PAGE.read_text("utf-8")):
            if name == "run":
                scripts.append(text)
            if name not in MODULES:
                continue
            assert len(text.splitlines()) <= LONGEST, f"{name} is longer than {LONGEST} lines"
            (folder / name).write_text(text, "utf-8")
            stem = name.removesuffix(".py")
            found[stem] = importlib.import_module(stem)
        yield SimpleNamespace(**found, scripts=scripts)
    finally:
        sys.path.remove(str(folder))
        for name in found:
            sys.modules.pop(name, None)


def test_scripts_of_the_page_run(page, monkeypatch, capsys):
    monkeypatch.chdir(PAGE.parents[1])
    assert len(page.scripts) == 2
    for script in page.scripts:
        exec(compile(script, str(PAGE), "exec"), {})
    said = capsys.readouterr().out
    assert "twist of the coupling (rad)" in said
    assert float(said.splitlines()[-1]) > 0


@pytest.fixture(scope="module")
def model():
    """Return a scene of the paper's pair with a part and a law from outside the package."""
    return Scene.from_config(load("configs/cic_drawn.yaml", ["solver.accuracy=1e-7"]))


@pytest.fixture(scope="module")
def design(model):
    return jnp.asarray([36.43, 8.0, 4.0])


@eqx.filter_jit
def built(model, design):
    return model.pair(design)


def stored(part, motion, own):
    """Return the energy (J) of the coupling."""
    excess = jnp.maximum(jnp.abs(own[0]) - part.stop, 0)
    return (part.stiffness * own[0] ** 2 + part.buffer * excess**2) / 2


def transmitted(part, motion, own):
    """Return the power (W) that the drive supplies at its own speed."""
    return part.torque_on_1(motion, own) * part.speed


def damped(part, motion, own):
    return part.damping * (part.speed - motion.speed) ** 2


def test_the_coupling_conforms(page, model, design):
    numbers = (2e-3, 3.0, 0.033, 1.5e-3, 4.8, 314.0)
    context = Context(*(jnp.asarray(x) for x in numbers))
    (coupling,) = model.with_parts(page.coupling.FlexibleCoupling(**COUPLING)).extra
    coupling = coupling.prepare(context)
    check_part(coupling, energy=stored, supply=transmitted, losses=damped)
    check_in_pair(built(model, design), coupling)


def test_the_law_conforms(page, model):
    law = model.with_law(page.law.HuntCrossley(**LAW)).law
    check_law(law, 2e-5, 3.0)


@pytest.mark.long
def test_gradient_with_respect_to_numbers_of_ones_own(page, model, design):
    """Gradients of mean and RMS force agree with central differences of orbits by shooting.

    They are with respect to stiffness and stop of the coupling, stiffness of the law, and load. The
    orbit crosses the stop, a kink."""
    scene = model.with_parts(page.coupling.FlexibleCoupling(**COUPLING))
    scene = scene.with_law(page.law.HuntCrossley(**LAW))

    def entries(scene):
        (coupling,) = scene.extra
        return coupling.stiffness, scene.law.stiffness, coupling.stop, scene.load_torque

    def varied(factors):
        values = [x * f for x, f in zip(entries(scene), factors, strict=True)]
        return eqx.tree_at(entries, scene, values)

    @jax.jit
    def forces(factors):
        found = steady_response(varied(factors), design)
        return jnp.stack([found.mean, found.rms]), found

    slopes, here = jax.jacfwd(forces, has_aux=True)(jnp.ones(4))
    assert Status.of(here.status) is Status.PERIODIC
    pair, period = built(scene, design), int(here.period)
    motion = here.start.known.elements.motion(period * jnp.arange(2000) / 2000)[:, 3]
    twist = motion * float(pair.angle_scale) + float(pair.parts[0].start(None)[0])
    assert np.min(twist) < COUPLING["stop"] < np.max(twist)
    assert 0.1 < np.max(np.abs(motion)) < 10
    # Along two directions in which all four count.
    for way in (np.array([1.0, 0.6, 0.8, 0.3]), np.array([-0.4, 1.0, 0.5, -0.2])):

        def shot(change, way=way):
            moved = built(varied(jnp.asarray(1 + change * way)), design)
            return closed(moved, pair.scaled(here.state), period).forces[::2]

        assert slopes @ way == pytest.approx(differentiated(shot, 1e-3)[0], rel=5e-6)
    sizes = np.abs(np.asarray(slopes)[0])
    assert np.min(sizes) > 1e-3 * np.max(sizes)
