"""The free form: spline, conjugacy, projections, gradients, config, optimisation, likeness."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

from rootsopt.commands.table import profile as command
from rootsopt.config import parse
from rootsopt.optimize.problem import Problem
from rootsopt.profiles import CIC, EE, FreeForm, arc, four_arcs, project
from rootsopt.profiles.geometry import departure
from rootsopt.scene import Scene, design_vector
from rootsopt.scene.families import check, free_form_of
from rootsopt.scene.space import sobol
from tests.conformance.families import R, measure
from tests.optimize.test_optimize import SCENE
from tests.standins import evaluation_of, refusal

DEG = np.pi / 180
TIP = 2 * DEG
SHARES = np.array([0.7, 0.9, 0.95, 0.8, 0.4, 0.1, -0.3])
CIC_KEYS = "pressure_angle_deg: 36.43,\n          involute_length_mm: 8.0, tip_arc_angle_deg: 4.0"


INSIDE = {
    "free_form": f"tip_arc_angle_deg: 2.0, coefficients: {SHARES.tolist()}",
    "four_arcs": "arc_center_mm: 30.0, tip_arc_radius_mm: 13.0, tip_arc_turn_deg: 40.0",
}


def free(*overrides, family="free_form"):
    """Return the scene of the optimiser's tests with another profile."""
    text = SCENE.replace("family: cic", f"family: {family}").replace(CIC_KEYS, INSIDE[family])
    return parse(text, [*overrides])


@pytest.fixture(scope="module")
def profile():
    return FreeForm(3, R, TIP, SHARES)


def test_shares_and_pressure_angle_are_the_spline(profile):
    """τ and ψ at given normals are those of SciPy's B-spline and its integral.

    So are the ends of the addendum."""
    spans = len(SHARES) - 2
    spline = BSpline(np.concatenate([[0, 0], np.arange(spans + 1), [spans, spans]]), SHARES, 2)
    half = np.pi / 6
    length = (half - TIP) / (1 - spline.integrate(0, spans) / spans)
    assert float(profile.pitch_normal) == pytest.approx(TIP + length, rel=1e-14)
    for share in (0.0, 0.13, 0.5, 0.77, 0.999):
        nu = jnp.asarray(TIP + share * length)
        turned = spline.integrate(0, share * spans) / spans * length
        assert float(profile.addendum(nu).psi) == pytest.approx(np.pi / 2 - turned, abs=1e-13)
        assert float(profile.roll_rate(nu)) == pytest.approx(1 - spline(share * spans), abs=1e-12)
    assert float(profile.roll_angle(profile.pitch_normal)) == pytest.approx(half, rel=1e-14)
    assert float(profile.contact_distance(profile.pitch_normal)) == pytest.approx(0, abs=1e-17)


def test_inverse_of_the_roll_angle_is_one_whatever_the_coefficients(profile):
    """ν(β(ν)) has no derivative with respect to the coefficients."""
    nu = jnp.linspace(TIP, float(profile.pitch_normal), 33)[1:-1]

    @jax.jit
    @jax.jacfwd
    def slopes(shares):
        made = FreeForm(3, R, TIP, shares)
        return made.normal_at(made.roll_angle(nu))

    np.testing.assert_allclose(slopes(jnp.asarray(SHARES)), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("other", "within"),
    [
        # Distance (µm) by number of coefficients. Arcs that are tangent alone bend suddenly.
        (CIC(3, R, 27.3 * DEG, 0.77e-3, 1.27 * DEG), {6: 5.0, 12: 0.5}),
        pytest.param(arc(3, R, 0.0297), {6: 2.0, 12: 0.05, 24: 0.01}, marks=pytest.mark.long),
        pytest.param(
            four_arcs(3, R, 0.03, 0.013, 40 * DEG),
            {6: 200.0, 12: 50.0, 24: 10.0},
            marks=pytest.mark.long,
        ),
        (EE(3, R), {6: 1e-6}),
    ],
)
def test_projections_come_closer_with_more_coefficients(other, within):
    away = np.array([departure(other, project(other, count)) * 1e6 for count in within])
    assert np.all(away < [*within.values()])
    if away[0] > 1:
        assert np.all(away[1:] < away[:-1] / 2)


# In a config


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("profile.coefficients=[0.5, 0.5]", ("profile.coefficients", "3")),
        ("profile.coefficients=[0.5, 1.5, 0]", ("profile.coefficients", "at most 1")),
        ("profile.coefficients=null", ("profile.coefficients", "required")),
        ("profile.coefficients=0.5", ("profile.coefficients", "list")),
        ("optimizer.bounds.coefficients=[0, 2]", ("optimizer.bounds.coefficients", "[-1, 1]")),
        ("optimizer.bounds.coefficient=[0, 1]", ("did you mean", "optimizer.bounds.coefficients")),
    ],
)
def test_what_is_wrong_with_a_config_is_said(override, words):
    message = refusal(free, override)
    assert all(word in message for word in words)


@pytest.mark.parametrize("last", [0.7, 0.9, 0.95])
def test_coefficients_may_reach_their_bound(last):
    """A flank that begins as an arc centred on the pitch circle (τ = 1) is sound.

    The roll angle rises from its constant value at a knot. No value is below those at the points:
    a parabola across the knot would claim so. Just above the bound, the roll angle turns back."""
    shares = np.array([1, 1, 1, 1, 1, last, 0.2, 0.4, 0.15, 0.15, 0, 0])
    config = free("profile.tip_arc_angle_deg=0", f"profile.coefficients={shares.tolist()}").profile
    check(config)
    beyond = config.with_design([0.0, *(shares + 1e-6 * (shares == 1))])
    assert "two points of a flank would mesh at once" in refusal(check, beyond)


def test_profile_command_projects(tmp_path, capsys):
    """`--project` writes a config of the same pair, within the distance that it prints."""
    source = tmp_path / "cic.yaml"
    source.write_text(SCENE)
    arguments = [str(source), "-o", str(tmp_path / "out"), "--no-figures", "--export", "svg"]
    assert command.main([*arguments, "--project", "16"]) == 0
    assert "free_form.yaml" in capsys.readouterr().out
    found = parse((tmp_path / "out" / "free_form.yaml").read_text())
    profile, distance = free_form_of(parse(SCENE).profile, 16)
    assert (found.profile, found.scene) == (profile, parse(SCENE).scene)
    assert distance < 4e-6
    with pytest.raises(SystemExit, match=r"^2$"):
        command.main([*arguments, "--project", "2"])
    assert "--project" in capsys.readouterr().err


# Optimised


@pytest.mark.parametrize("family", [pytest.param("four_arcs", marks=pytest.mark.long), "free_form"])
def test_points_of_any_box_become_sound_profiles(family):
    limits = "constraints.area_efficiency_min=0.42", "constraints.seal_width_min_mm=0"
    settings = free(*limits, family=family)
    model, design = Scene.from_config(settings), design_vector(settings)
    efficiency = float(measure(model.profile(design)).area_efficiency)
    alone = dataclasses.replace(evaluation_of(), geometry={"area_efficiency": efficiency})
    problem = Problem.of(settings, model, alone)
    start = problem.project(problem.point(design))
    assert problem.feasible(start)
    drawn = 0
    for sample in sobol(12, 1, len(start)):
        found = problem.toward(sample, start)
        assert problem.feasible(found)
        drawn += not problem.feasible(problem.project(sample))
        check(settings.profile.with_design(problem.design(found).tolist()))
    assert drawn > 0
