"""Tests that execute docs/extending.md: its files pass the suites of the package's own objects.

Motions with its part and its law conserve energy and have correct gradients."""

import functools
import importlib
import json
import re
import sys
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.shooting import closed, differentiated, forces_near
from rootsopt import steady_response
from rootsopt.commands.table import profile
from rootsopt.config import load
from rootsopt.config.families import (
    Family,
    Parameter,
    families,
    parameters,
    register_family,
)
from rootsopt.config.sources import import_named
from rootsopt.dynamics.parts import Context
from rootsopt.scene import Scene
from rootsopt.scene.families import profile_of
from rootsopt.status import Status
from tests.conformance import families as suite
from tests.conformance.laws import check_law
from tests.conformance.parts import check_in_pair, check_part
from tests.standins import ROOT, for_a_time, refusal

PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```python ?(\S*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def block_of(name, most):
    """Return the code block of the page that is a file, of no more lines than `most`."""
    blocks = BLOCK.findall(PAGE)
    text = next(text for title, text in blocks if title == name or text.startswith(f'"""{name}'))
    assert len(text.splitlines()) <= most
    return text


def imported(name, folder, most):
    """Write the file `name` of the page into a folder, import it and return its path."""
    path = folder / name
    path.write_text(block_of(name, most), encoding="utf-8")
    import_named(str(path))
    return path


@pytest.fixture(scope="module")
def blunt_cycloid(tmp_path_factory):
    """Return the path of the family's file, after importing it."""
    with for_a_time():
        yield imported("blunt_cycloid.py", tmp_path_factory.mktemp("family"), 60)


def test_family_given_by_its_law(blunt_cycloid):
    """It conforms; with an even fall it is the blunt cycloid, to 1e-9 pitch radii."""
    imported("early_fall.py", blunt_cycloid.parent, 35)
    suite.curve_is_the_one_its_normals_say("early_fall")
    nu = jnp.linspace(0.0, 1.5, 7)

    @functools.partial(jax.jit, static_argnums=0)
    def values(name, *design):
        made = profile_of(name, 3, jnp.asarray(1.0), jnp.asarray(design))
        return jax.vmap(lambda nu: jnp.stack([made.lever(nu), made.support(nu)]))(nu)

    even, other = (values("early_fall", 3.0, 20.0, fall) for fall in (0.0, 0.3))
    np.testing.assert_allclose(even, values("blunt_cycloid", 3.0, 20.0), atol=1e-9)
    assert np.max(np.abs(other - even)) > 1e-2


@pytest.mark.parametrize("holds", suite.CHECKS, ids=lambda one: one.__name__)
def test_family_conforms(blunt_cycloid, holds):
    holds(blunt_cycloid.stem)


def another(name, path):
    """Write the file of the blunt cycloid to `path`, for a family called `name`."""
    text = block_of("blunt_cycloid.py", 60).replace("blunt_cycloid", name)
    path.write_text(text, encoding="utf-8")


def test_family_is_known_to_a_command_by_its_file(tmp_path):
    another("filed_cycloid", tmp_path / "filed.py")
    call = ["configs/ee.yaml", "--no-figures", "--import", str(tmp_path / "filed.py")]
    for change in ("family=filed_cycloid", "tip_arc_angle_deg=3", "crossing_angle_deg=20"):
        call += ["--set", f"profile.{change}"]
    with for_a_time():
        assert profile.main([*call, "-o", str(tmp_path / "out")]) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert result["design"] == {"tip_arc_angle_deg": 3.0, "crossing_angle_deg": 20.0}
    assert min(result["margins"].values()) >= 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("import no_such_module_at_all", "ModuleNotFoundError"),
        ("1 / 0", "ZeroDivisionError: division by zero (line 1 of"),
        ("def f(:", "SyntaxError"),
        (None, "FileNotFoundError"),
    ],
)
def test_file_that_fails_is_one_line(tmp_path, text, words):
    path = tmp_path / "broken.py"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    message = refusal(import_named, str(path))
    assert words in message
    assert "--import" in message


def test_installed_package_is_found_by_its_entry_point(tmp_path, monkeypatch):
    another("offered_cycloid", tmp_path / "offered.py")
    folder = tmp_path / "offered-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: offered\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[rootsopt.families]\noffered_cycloid = offered\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    changes = "{family: Offered-Cycloid, lobes: 3, pitch_radius_mm: 33, tip_arc_angle_deg: 3, "
    with for_a_time():
        config = load("configs/ee.yaml", [f"profile={changes} crossing_angle_deg: 20}}"])
        assert config.profile.family == "offered_cycloid"


DEPTH = Parameter("depth_mm", "a depth", 1, 9, usual=(2, 3))
GOOD = {
    "name": "mine",
    "help": "mine",
    "maker": lambda lobes, pitch_radius, depth: None,
    "parameters": (DEPTH,),
    "example": {"depth_mm": 2.0},
    "remedy": "dig",
}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": "Mine!"}, "lower-case"),
        ({"name": "cic"}, "cic is taken"),
        ({"name": "five__arcs"}, "five_arcs is taken"),
        ({"remedy": ""}, "`remedy`"),
        ({"example": {}}, "`example`"),
        ({"example": {"depth_mm": 10.0}}, "limits of depth_mm"),
        ({"inherent": frozenset({"rollin"})}, "rollin"),
        ({"parameters": (DEPTH, DEPTH)}, "every key once"),
        ({"maker": lambda lobes, pitch_radius: None}, "lobes, pitch_radius, depth"),
        ({"parameters": (Parameter("arc_center_mm", "other", 0, 1),)}, "arc, arcs_epicycloid"),
        *(
            ({"parameters": (Parameter(key, "other", 0, 1),)}, f"{key} is reserved")
            for key in ("lobes", "outline_join_mm", "helix_deg")
        ),
        ({"parameters": (Parameter("depth_mm", "a depth", 9, 1),)}, "increasing"),
        ({"parameters": (parameters()["coefficients"], DEPTH)}, "list of numbers last"),
    ],
)
def test_incomplete_families_are_refused(change, words):
    """The message names what is missing, and the table of families is unchanged."""
    before = families()
    with pytest.raises(ValueError, match=re.escape(words)):
        register_family(Family(**(GOOD | change)))
    assert families() == before


# A part and a contact law

COUPLING = {"stiffness": 8000.0, "damping": 6.0, "buffer": 4000.0, "stop": 7.0e-4}
LAW = {"stiffness": 2.0e10, "exponent": 1.5, "loss": 0.4}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Return the page's modules of a part and a law by name."""
    folder = tmp_path_factory.mktemp("outside")
    names = ("coupling", "law")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        for name in names:
            (folder / f"{name}.py").write_text(block_of(f"{name}.py", 60), "utf-8")
        yield SimpleNamespace(**{name: importlib.import_module(name) for name in names})
    for name in names:
        sys.modules.pop(name, None)


def test_scripts_of_the_page_run(page, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    scripts = [text for name, text in BLOCK.findall(PAGE) if name == "run"]
    assert len(scripts) == 2
    for script in scripts:
        exec(compile(script, "extending.md", "exec"), {})
    said = capsys.readouterr().out
    assert "twist of the coupling (rad)" in said
    assert float(said.splitlines()[-1]) > 0


@pytest.fixture(scope="module")
def model():
    return Scene.from_config(load("configs/cic_drawn.yaml", ["solver.accuracy=1e-7"]))


DESIGN_OF_PAIR = np.array([36.43, 8.0, 4.0])
built = eqx.filter_jit(Scene.pair)


def stored(part, motion, own):
    """Return the energy (J) of the coupling."""
    excess = jnp.maximum(jnp.abs(own[0]) - part.stop, 0)
    return (part.stiffness * own[0] ** 2 + part.buffer * excess**2) / 2


def transmitted(part, motion, own):
    """Return the power (W) that the drive supplies at its own speed."""
    return part.torque_on_1(motion, own) * part.speed


def damped(part, motion, own):
    return part.damping * (part.speed - motion.speed) ** 2


def test_the_coupling_conforms(page, model):
    numbers = (2e-3, 3.0, 0.033, 1.5e-3, 4.8, 314.0)
    (coupling,) = model.with_parts(page.coupling.FlexibleCoupling(**COUPLING)).extra
    coupling = coupling.prepare(Context(*(jnp.asarray(x) for x in numbers)))
    check_part(coupling, energy=stored, supply=transmitted, losses=damped)
    check_in_pair(built(model, DESIGN_OF_PAIR), coupling)


def test_the_law_conforms(page, model):
    check_law(model.with_law(page.law.HuntCrossley(**LAW)).law, 2e-5, 3.0)


@pytest.mark.long
def test_gradient_with_respect_to_numbers_of_ones_own(page, model):
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
        found = steady_response(varied(factors), jnp.asarray(DESIGN_OF_PAIR))
        return jnp.stack([found.mean, found.rms]), found

    slopes, here = jax.jacfwd(forces, has_aux=True)(jnp.ones(4))
    assert Status.of(here.status) is Status.PERIODIC
    pair, period = built(scene, DESIGN_OF_PAIR), int(here.period)
    motion = here.start.known.elements.motion(period * jnp.arange(2000) / 2000)[:, 3]
    twist = motion * float(pair.angle_scale) + float(pair.parts[0].start(None)[0])
    assert np.min(twist) < COUPLING["stop"] < np.max(twist)
    assert 0.1 < np.max(np.abs(motion)) < 10
    orbit = closed(pair, pair.scaled(here.state), period)
    # Along two directions in which all four count.
    for way in (np.array([1.0, 0.6, 0.8, 0.3]), np.array([-0.4, 1.0, 0.5, -0.2])):

        def moved(change, way=way):
            return built(varied(jnp.asarray(1 + change * way)), DESIGN_OF_PAIR)

        truth, _ = differentiated(forces_near(moved, orbit, period), 1e-3)
        assert slopes @ way == pytest.approx(truth[::2], rel=5e-6)
    sizes = np.abs(np.asarray(slopes)[0])
    assert np.min(sizes) > 1e-3 * np.max(sizes)
