"""Rattle of the timing gear against closed forms, and an equation of motion integrated by SciPy."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rootsopt import InputError, Scene, Status
from rootsopt.config import parse
from rootsopt.config.units import DEG
from rootsopt.dynamics.parts import GearErrors
from rootsopt.profiles import geometry
from rootsopt.pump.rattle import SILENT, silent_limit
from rootsopt.response.evaluation import Evaluator
from rootsopt.response.terms import terms_of
from rootsopt.scene import design_vector
from tests.conformance.families import measure

BOOSTER = """
profile: {family: ee, lobes: 2, pitch_radius_mm: 62.5}
rotor: {length_mm: 300, density_kg_m3: 8237}
scene:
  speed_rpm: 3000
  load: {torque_N_m: 4}
  timing_gear: {backlash_mm: 0.05, stiffness_N_m_per_rad: 1.0e5, damping_ratio: 0.05}
contact: {clearance_mm: 0.15, stiffness_N_per_mm_e: 2.0e5, exponent: 2.2,
  max_damping_N_s_per_mm: 0.25, full_damping_depth_mm: 0.01, smoothing_mm: 0}
"""
FIVE_ARCS = (
    "profile={family: five_arcs, lobes: 2, pitch_radius_mm: 62.5, outer_radius_mm: 100, "
    "tip_arc_angle_deg: 3, tip_arc_radius_mm: 38, tip_arc_turn_deg: 45}"
)
RADIUS, SPEED, STIFFNESS, LOAD, HALF = 62.5e-3, 100 * np.pi, 1e5, 4.0, 0.05 / 125
# Eccentricity (µm) at which a silent and a noisy motion coexist.
ECCENTRICITY = 16.0
# ε (rad) and dε/dt (rad/s) at φ1 = 0, near the noisy motion.
NOISY = np.array([-2.99e-4, 0.0515])


def config_of(*changes, eccentricity=ECCENTRICITY):
    return parse(BOOSTER, [f"scene.timing_gear.eccentricity_um={eccentricity}", *changes])


def scene_of(*changes, **more):
    config = config_of(*changes, **more)
    return Scene.from_config(config), design_vector(config)


@functools.cache
def inertia_and_damping(*changes):
    scene, design = scene_of(*changes)
    inertia = scene.inertia(jax.jit(lambda design: geometry(scene.profile(design)))(design))
    return float(inertia), float(scene.gear_of(inertia).damping)


@functools.cache
def evaluations():
    evaluator = Evaluator.of(config_of())
    design = design_vector(evaluator.config)
    starts = map(evaluator.pair(design).scaled, jnp.asarray([0 * NOISY, NOISY]))
    return [evaluator.reached(design, np.asarray(start)) for start in starts]


def compliance(frequency, *changes):
    """x (rad) over the transmission error, for teeth in permanent contact at constant speed."""
    inertia, damping = inertia_and_damping(*changes)
    return 1 / (1 - (1j * damping * frequency + STIFFNESS) / (inertia * frequency**2))


def test_silent_limit_in_closed_form():
    """x = T/k + Re(c e exp(iφ)) stays positive. The gradient agrees with differences."""
    scene, design = scene_of(FIVE_ARCS, eccentricity=0)
    limit = silent_limit(scene, design)
    wanted = LOAD / STIFFNESS / abs(compliance(SPEED, FIVE_ARCS)) * RADIUS
    assert float(limit.value) == pytest.approx(wanted, rel=1e-9)
    step = 1e-3 * np.eye(len(design))
    beside = [float(silent_limit(scene, design + s).value) for s in (*step, *-step)]
    slopes = (np.array(beside[:4]) - beside[4:]) / 2e-3
    assert np.allclose(limit.slopes, slopes, rtol=1e-6, atol=1e-12)


def test_silent_limit_with_a_motor_a_tooth_angle_and_two_gears():
    """Both rotors swing, and the working flank follows the error along its line of action."""
    scene, design = scene_of(
        "scene.drive=torque",
        "scene.motor={slope_N_m_s_per_rad: 3, inertia_kg_m2: 0.05}",
        "scene.bearings={gear_pressure_angle_deg: 25}",
        "scene.timing_gear.eccentricity_angle_deg=[20, -70]",
        eccentricity="[8, 6]",
    )
    inertia, damping = inertia_and_damping()
    s, spring = 1j * SPEED, STIFFNESS + 1j * SPEED * damping
    matrix = np.array(
        [[(inertia + 0.05) * s**2 + 3 * s + spring, -spring], [-spring, inertia * s**2 + spring]]
    )
    turned = np.linalg.solve(matrix, [-spring, spring])
    # Displacements of the gears' centres, which turn in opposite senses, along the normal.
    first = 8 * np.exp(1j * (20 - 90) * DEG) * np.exp(25j * DEG)
    second = -6 * np.exp(1j * (-70 - 90) * DEG) * np.exp(-25j * DEG)
    error = abs(first + second) / 8 / math.cos(25 * DEG)
    wanted = LOAD / STIFFNESS / abs((turned[0] - turned[1] + 1) * error) * RADIUS
    assert float(silent_limit(scene, design).value) == pytest.approx(wanted, rel=1e-6)


def test_play_of_eccentric_gears_is_that_of_exact_involutes():
    """Gears at other centres are involute gears at another distance, turned by the line of their
    centres. The formulas are right to first order."""
    size, angle, tooth = np.array([3e-4, 2e-4]), np.array([0.4, 2.0]), 20 * DEG
    errors = GearErrors(jnp.asarray(size), jnp.asarray(angle), jnp.asarray(tooth))
    phi = np.linspace(0, 2 * np.pi, 50)
    middle, wider = map(np.asarray, errors(jnp.asarray(phi)))
    centers = size[0] * np.exp(1j * (phi + angle[0])), 2 - size[1] * np.exp(-1j * (phi + angle[1]))
    line = centers[1] - centers[0]
    working = np.arccos(2 * np.cos(tooth) / abs(line))
    involute = np.tan(working) - working - np.tan(tooth) + tooth
    assert np.allclose(middle, -2 * np.angle(line), atol=3e-7)
    assert np.allclose(wider, 2 * involute, atol=3e-7)


def test_silent_motion_is_the_linear_one():
    silent = evaluations()[0]
    assert (silent.status, silent.steady_state["period"]) == (Status.IDLE, 2)
    assert set(silent.steady_state["gear_rattle"].values()) == {0.0}
    error = ECCENTRICITY * 1e-6 / RADIUS * np.exp(1j * (silent.series.rotation - np.pi / 2))
    motion = error.real - HALF - (LOAD / STIFFNESS + (error * compliance(SPEED)).real)
    assert np.allclose(silent.series.relative, motion, rtol=0, atol=1e-6 * HALF)
    wanted = LOAD / STIFFNESS / abs(compliance(SPEED)) * RADIUS
    assert silent.response[SILENT] == pytest.approx(1e6 * wanted, rel=1e-6)


def test_noisy_motion_coexists_with_the_silent_one():
    """SciPy integrates both from the package's states, and finds its flights and impacts."""
    inertia, damping = inertia_and_damping()
    size = ECCENTRICITY * 1e-6 / RADIUS

    def torque(time, relative, rate):
        away = relative - size * np.sin(SPEED * time)
        excess = abs(away) - HALF
        moving = rate - size * SPEED * np.cos(SPEED * time)
        return np.where(excess > 0, STIFFNESS * excess * np.sign(away) + damping * moving, 0.0)

    def slope(time, state):
        return [state[1], -(LOAD + torque(time, *state)) / inertia]

    turn = 2 * np.pi / SPEED
    times = np.linspace(0, turn, 20001)
    how = {"rtol": 1e-10, "atol": 1e-13, "max_step": turn / 2000, "t_eval": times}
    for evaluation, noisy in zip(evaluations(), (False, True), strict=True):
        series, rattle = evaluation.series, evaluation.steady_state["gear_rattle"]
        begin = [series.relative[0], series.rate[0]]
        found = solve_ivp(slope, (0, turn), begin, **how).y
        assert np.allclose(found[:, -1], begin, rtol=0, atol=[1e-7 * HALF, 1e-6])
        assert np.allclose(np.interp(series.time, times, found[0]), series.relative, atol=1e-9)
        touches = torque(times, *found) != 0
        assert bool(np.any(~touches)) is noisy
        assert rattle["time_apart"] == pytest.approx(np.mean(~touches), abs=2e-4)
        assert rattle["impacts_per_revolution"] == np.sum(touches[1:] & ~touches[:-1])
        hardest = np.max(np.abs(torque(times, *found))) * noisy
        assert rattle["greatest_impact_N_m"] == pytest.approx(hardest, rel=1e-3)


def test_limit_is_a_term():
    """Load 40 N·m: the teeth part only at some 1.6 mm, where the flanks have long touched."""
    (term,) = terms_of([SILENT])
    scene, design = scene_of("scene.load.torque_N_m=40")
    limit, profile = silent_limit(scene, design), scene.profile(design)
    value = eqx.filter_jit(term.value)(scene, profile, measure(profile), None)
    assert float(value) == pytest.approx(1e6 * float(limit.value))
    assert float(limit.depth) > 0
    with pytest.raises(InputError, match="needs a timing gear with errors"):
        term.value(scene_of(eccentricity="null")[0], profile, None, None)


def test_measured_error(tmp_path):
    """A spline through a table follows a smooth error, and its value counts as that of a gear."""
    file = tmp_path / "gear.csv"

    def smooth(phi):
        return 6 * np.cos(phi - 1) + 2 * np.sin(3 * phi) + 1

    rows = [f"{x},0,{smooth(x * DEG):.9f}" for x in np.arange(0, 361, 7.5)]
    file.write_text("# single flank test\nrotation_deg,raw,error_um\n" + "\n".join(rows))
    scene, _ = scene_of(f"scene.timing_gear.transmission_error_file={file}", eccentricity="null")
    along = jax.jit(lambda phi: jax.jvp(scene.gear.errors, (phi,), (jnp.ones_like(phi),)))
    phi = np.linspace(-7.0, 9.0, 333)
    (middle, wider), (slope, _) = along(phi)
    assert np.allclose(1e6 * RADIUS * middle, smooth(phi), atol=1e-4)
    assert not np.any(wider)
    wanted = -6 * np.sin(phi - 1) + 6 * np.cos(3 * phi)
    assert np.allclose(1e6 * RADIUS * slope, wanted, atol=2e-3)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("angle,error_um\n0,1", "has no rotation_deg"),
        ("", "has no rotation_deg"),
        ("rotation_deg,error_um\n0,x", "line 2: must hold"),
        ("rotation_deg,error_um\n0,1\n50,2", "at least 8 rows"),
        ("rotation_deg,error_um\n" + "\n".join(f"{x},1" for x in range(8)), "has a gap of 353°"),
        (
            "rotation_deg,error_um\n" + "\n".join(f"{x % 320},1" for x in range(0, 400, 40)),
            "at row 8",
        ),
        ("rotation_deg,error_um\n" + "\n".join(f"{x},{x}" for x in range(0, 361, 40)), "360 µm"),
        ("rotation_deg,error_um\n" + "\n".join(f"{x},2e3" for x in range(0, 361, 40)), "2000 µm"),
    ],
)
def test_tables_are_checked(tmp_path, rows, message):
    (tmp_path / "gear.csv").write_text(rows)
    with pytest.raises(InputError, match=message):
        scene_of(f"scene.timing_gear.transmission_error_file={tmp_path}/gear.csv")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("scene.timing_gear.eccentricity_um=[1, 2, 3]", "a number from 0 to 1000, or one for each"),
        ("scene.timing_gear.eccentricity_um=-1", "a number from 0 to 1000"),
        (
            "scene.timing_gear={backlash_mm: 1,stiffness_N_m_per_rad: 9,eccentricity_angle_deg: 4}",
            "eccentricity_um` is missing",
        ),
        ("scene.timing_gear.transmission_error_file=nowhere.csv", "can be read"),
        ("scene.bearings={gear_pressure_angle_deg: 45}", "bind"),
    ],
)
def test_config_is_checked(change, message):
    with pytest.raises(InputError, match=message):
        scene_of("scene.timing_gear.backlash_mm=0.03", change)
