"""Tests that execute docs/extending.md: its files pass the suites of the package's own objects."""

import functools
import json
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt.config import load
from rootsopt.config.families import (
    Family,
    Parameter,
    families,
    parameters,
    register_family,
)
from rootsopt.config.sources import import_named
from rootsopt.errors import InputError
from rootsopt.scene.families import profile_of
from tests.conformance import families as suite
from tests.standins import for_a_time

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
MOST_LINES = 60, 35


def block_of(name):
    """Return the code block of the page that begins with a file's name."""
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    return next(block for block in blocks if block.startswith(f'"""{name}'))


def imported(name, folder):
    """Write the file `name` of the page into a folder, import it and return its path."""
    path = folder / name
    path.write_text(block_of(name), encoding="utf-8")
    import_named(str(path))
    return path


@pytest.fixture(scope="module")
def blunt_cycloid(tmp_path_factory):
    """Return the path of the family's file, after importing it."""
    with for_a_time():
        yield imported("blunt_cycloid.py", tmp_path_factory.mktemp("family"))


@pytest.fixture(scope="module")
def early_fall(blunt_cycloid):
    """Return the path of the file of the family given by its law, after importing it."""
    return imported("early_fall.py", blunt_cycloid.parent)


def test_families_are_short(blunt_cycloid, early_fall):
    for path, most in zip((blunt_cycloid, early_fall), MOST_LINES, strict=True):
        assert len(path.read_text(encoding="utf-8").splitlines()) <= most


def test_law_of_the_roll_angle_gives_the_closed_form(early_fall):
    """With an even fall, the family is the blunt cycloid, to 1e-9 pitch radii."""
    nu = jnp.linspace(0.0, 1.5, 7)

    @functools.partial(jax.jit, static_argnums=0)
    def values(name, *design):
        profile = profile_of(name, 3, jnp.asarray(1.0), jnp.asarray(design))
        return jax.vmap(lambda nu: jnp.stack([profile.lever(nu), profile.support(nu)]))(nu)

    np.testing.assert_allclose(
        values("early_fall", 3.0, 20.0, 0.0), values("blunt_cycloid", 3.0, 20.0), atol=1e-9
    )
    assert (
        np.max(np.abs(values("early_fall", 3.0, 20.0, 0.3) - values("blunt_cycloid", 3.0, 20.0)))
        > 1e-2
    )


@pytest.mark.parametrize("holds", [one for one in suite.CHECKS if "curve" in one.__name__])
def test_family_given_by_its_law_conforms(early_fall, holds):
    holds(early_fall.stem)


@pytest.mark.parametrize("holds", suite.CHECKS, ids=lambda one: one.__name__)
def test_family_conforms(blunt_cycloid, holds):
    """A family from outside passes the checks of the package's own families."""
    holds(blunt_cycloid.stem)


DESIGN = (
    *("--set", "profile.family=blunt_cycloid", "--set", "profile.tip_arc_angle_deg=3"),
    *("--set", "profile.crossing_angle_deg=20"),
)


def test_family_is_known_to_a_command_by_its_file(blunt_cycloid, tmp_path):
    """A new process knows the family with the option `--import`, and does not know it without."""
    call = [sys.executable, "-m", "rootsopt.profile", "configs/ee.yaml", "--no-figures", *DESIGN]
    call += ["-o", str(tmp_path / "out")]
    run = functools.partial(subprocess.run, capture_output=True, text=True, cwd=ROOT, check=False)
    done = run([*call, "--import", str(blunt_cycloid)])
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert result["design"] == {"tip_arc_angle_deg": 3.0, "crossing_angle_deg": 20.0}
    assert min(result["margins"].values()) >= 0
    done = run(call)
    assert done.returncode == 2
    assert "crossing_angle_deg" in done.stderr


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
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        import_named(str(path))
    assert "--import" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_installed_package_is_found_by_its_entry_point(tmp_path, monkeypatch):
    """A config that names an unknown family loads the installed package that offers it."""
    (tmp_path / "offered.py").write_text(
        block_of("blunt_cycloid.py").replace("blunt_cycloid", "offered_cycloid"), encoding="utf-8"
    )
    folder = tmp_path / "offered-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: offered\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[rootsopt.families]\noffered_cycloid = offered\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    changes = "{family: Offered-Cycloid, lobes: 3, pitch_radius_mm: 33, tip_arc_angle_deg: 3, "
    with for_a_time():
        config = load("configs/ee.yaml", [f"profile={changes} crossing_angle_deg: 20}}"])
        assert config.profile.family == "offered_cycloid"


def made(lobes, pitch_radius, depth):
    """Stand in for a maker that is never called."""


DEPTH = Parameter("depth_mm", "a depth", 1, 9, usual=(2, 3))
GOOD = {"name": "mine", "help": "mine", "maker": made, "parameters": (DEPTH,)} | {
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
        ({"parameters": (Parameter("lobes", "other", 0, 1),)}, "reserved"),
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
