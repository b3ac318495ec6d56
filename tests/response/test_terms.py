"""Objective terms: the table, the package's own, and the one of docs/extending.md."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from rootsopt import InputError, Scene, load_config, register_term
from rootsopt.config.sources import import_named
from rootsopt.optimize.problem import Problem
from rootsopt.response import terms
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.result import RESPONSES
from rootsopt.response.terms import values_of
from tests.standins import Own

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
CIC = "configs/cic_drawn.yaml"
OUTSIDE = "revolutions_per_litre"


@pytest.fixture(scope="module")
def outside(tmp_path_factory):
    """Register the term of docs/extending.md from its file."""
    (text,) = re.findall(
        r"^```python displacement.py\n(.*?)^```", PAGE.read_text("utf-8"), re.S | re.M
    )
    assert len(text.splitlines()) <= 60
    path = tmp_path_factory.mktemp("term") / "displacement.py"
    path.write_text(text, encoding="utf-8")
    import_named(str(path))
    yield terms.terms_of([OUTSIDE])[0]
    del terms._terms[OUTSIDE]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_config(load_config(CIC))


@pytest.mark.parametrize(
    "name",
    [
        "rms_force_N",
        "polar_inertia_kg_m2",
        "flow_ripple",
        OUTSIDE,
    ],
)
def test_gradients_of_terms_are_those_of_differences(outside, scene, name):
    """Every term, the one from outside among them, has the slopes of differences."""
    design, forces = np.array([36.43, 9.0, 4.0]), np.array([76.0, 242.0, 113.0])
    slopes = np.array([[-1.7, 7.9, -0.1], [-6.9, 4.7, 1.1], [-1.7, 6.3, 0.0]])
    wanted = terms.terms_of([name])
    _, gradient = values_of(scene, wanted, design, forces, slopes)
    step = 1e-4
    for k in range(3):
        move = step * np.eye(3)[k]
        above, below = (
            float(
                values_of(scene, wanted, design + s * move, forces + s * slopes @ move, slopes)[0][
                    0
                ]
            )
            for s in (1, -1)
        )
        expected = (above - below) / (2 * step)
        scale = max(abs(float(g)) for g in gradient[0])
        assert float(gradient[0][k]) == pytest.approx(expected, abs=1e-6 * scale)


def test_outside_term_is_in_results_and_objective(outside):
    """The outside term is in the results, and an objective can consist of it alone.

    Its value is that of its own formula."""
    only = [f"objective.terms.{OUTSIDE}=1", "objective.mean_weight=0", "objective.peak_weight=0"]
    config = load_config(CIC, only)
    evaluator = Evaluator.of(config)
    found = evaluator(series=False)
    geometry = found.geometry
    area = np.pi * geometry["outer_radius_mm"] ** 2 - geometry["area_mm2"]
    litres = 2e-6 * config.rotor.length_mm * area
    assert found.response[OUTSIDE] == pytest.approx(1 / litres, rel=1e-12)
    assert list(found.response) == [*RESPONSES, OUTSIDE]
    problem = Problem.of(config, evaluator.scene, found)
    assert problem.objective(found) == pytest.approx(1.0, rel=1e-14)
    point = problem.point(config.design)
    _, jacobian, *_ = problem.look(point)
    slope = np.array(list(found.gradient[OUTSIDE].values())) / found.response[OUTSIDE]
    np.testing.assert_allclose(problem.slope(found, point), slope @ jacobian, rtol=1e-12)


def test_unknown_terms_are_refused(scene):
    with pytest.raises(InputError, match="names noise; correct it, or register it"):
        Evaluator.of(load_config(CIC, ["objective.terms.noise=1"]))
    with pytest.raises(InputError, match="belong to a periodic motion"):
        load_config(CIC, ["objective.terms.area_mm2=1", "objective.motion=ensemble"])


def test_table_keeps_names_apart():
    with pytest.raises(ValueError, match="'area_mm2' is that of `Formula`"):
        register_term("area_mm2", Own(lambda *_: jnp.ones(())))
    with pytest.raises(ValueError, match="must be a word"):
        register_term("two words", Own(lambda *_: jnp.ones(())))
