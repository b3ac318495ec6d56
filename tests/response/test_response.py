"""`steady_response`: a pure function that JAX transforms, differentiable in design and scene."""

import doctest
import inspect
import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rootsopt
from experiments._common.shooting import differentiated
from rootsopt import Scene, Status, steady_response
from rootsopt.response import steady, terms
from tests.standins import for_a_time, registered

TIGHT = "solver.rtol=1e-11", "solver.accuracy=1e-6"
QUANTITIES = {
    "pitch radius": lambda s: s.pitch_radius,
    "length": lambda s: s.length,
    "density": lambda s: s.density,
    "stiffness": lambda s: s.law.stiffness,
    "exponent": lambda s: s.law.exponent,
    "damping": lambda s: s.law.damping,
    "full damping depth": lambda s: s.law.full_damping_depth,
    "clearance": lambda s: s.clearance,
    "speed": lambda s: s.speed,
    "load": lambda s: s.load_torque,
    "gear stiffness": lambda s: s.gear.stiffness,
    "backlash": lambda s: s.gear.half_backlash,
    "gear damping": lambda s: s.gear_damping_ratio,
    "gear damping coefficient": lambda s: s.gear.damping,
}
ROOT = Path(__file__).parents[2]
DESIGN = np.array([36.43, 9.0, 4.0])


def scene_of(*overrides: str) -> tuple[rootsopt.Config, Scene]:
    config = rootsopt.load_config("configs/cic_drawn.yaml", [*TIGHT, *overrides])
    return config, Scene.from_config(config)


def forces(response) -> jax.Array:
    return jnp.stack([response.mean, response.rms, response.peak])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of()[1]


@pytest.fixture(scope="module")
def known(scene):
    """Return the response at the config's design and its derivatives.

    They are those of the forces and of a multiplier with respect to design and quantities."""

    def found(design, *values):
        moved = eqx.tree_at(lambda s: [get(s) for get in QUANTITIES.values()], scene, values)
        response = steady_response(moved, design)
        return jnp.append(forces(response), jnp.abs(response.multipliers[0]))

    values = [get(scene) for get in QUANTITIES.values()]
    jacobian = jax.jacrev(found, tuple(range(1 + len(values))))
    # From rest, by the program that also starts from a state.
    response = steady_response(scene, DESIGN, np.zeros(2))
    return response, found, values, jacobian(jnp.asarray(DESIGN), *values)


def test_response_of_the_shipped_scene(known):
    response, *_ = known
    assert (Status.of(response.status), int(response.period)) == (Status.PERIODIC, 1)
    assert (float(response.mean), float(response.peak)) == pytest.approx((76.247, 242.11), rel=1e-5)
    assert response.residual < 1e-9
    assert np.all(np.abs(np.diff(np.abs(response.multipliers))) >= 0)
    again = rootsopt.evaluate(scene_of()[0])
    np.testing.assert_allclose(
        forces(response)[jnp.array([0, 2, 1])],
        [again.response[name] for name in ("mean_force_N", "peak_force_N", "rms_force_N")],
        rtol=1e-11,
    )
    data = again.to_dataset()
    assert (data.contact_force_N.attrs["units"], data.attrs["status"]) == ("N", "periodic")
    assert float(data.contact_force_N.mean()) == pytest.approx(76.247, rel=1e-3)
    # In SI units, and on the orbit: begun there, it is found at once.
    assert abs(float(response.state[0])) < 2e-3


def test_derivatives_by_design_and_scene_are_those_of_differences(scene, known):
    response, found, values, jacobian = known

    def moved(number, step):
        entries = [jnp.asarray(DESIGN), *values]
        entries[number] = entries[number] + step
        inner = eqx.tree_at(lambda s: [get(s) for get in QUANTITIES.values()], scene, entries[1:])
        return np.asarray(forces(steady_response(inner, entries[0], response.state)))

    def difference(number, step, along=1.0):
        # Central, extrapolated once: what is left is of the fourth order.
        coarse, fine = (
            (moved(number, h * along) - moved(number, -h * along)) / (2 * h)
            for h in (step, step / 2)
        )
        return (4 * fine - coarse) / 3

    for k, (name, value) in enumerate(zip(QUANTITIES, values, strict=True), start=1):
        # Errors of rounding and closing (1e-13) against the fourth power of the step.
        step = 3e-4 * abs(float(value)) or {"clearance": 3e-8}.get(name, 3e-4)
        np.testing.assert_allclose(
            jacobian[k][:2], difference(k, step)[:2], rtol=3e-6, atol=1e-9, err_msg=name
        )
    along = np.array([0.5, 0.2, -0.3])
    np.testing.assert_allclose(
        jacobian[0][:3] @ along, difference(0, 1e-3, along), rtol=1e-5, atol=1e-9
    )
    # Multipliers are constants, and leave the other derivatives as they are.
    assert all(np.all(slope[3] == 0) for slope in jacobian)
    # Forward mode agrees with reverse mode.
    _, change = jax.jvp(found, (jnp.asarray(DESIGN), *values), (jnp.asarray(along), *values))
    parts = [np.dot(jacobian[0], along), *map(np.multiply, jacobian[1:], values)]
    np.testing.assert_allclose(change, sum(parts), rtol=1e-10)


PARTS = {
    "bore and phase error": (
        ("rotor.bore_mm=20", "scene.phase_error_mrad=0.4"),
        {
            "bore radius": lambda s: s.bore_radius,
            "phase error": lambda s: s.gear.offset,
            "length": lambda s: s.length,
        },
    ),
    "motor": (
        (
            "scene.drive=torque",
            "scene.motor={slope_N_m_s_per_rad: 0.05, inertia_kg_m2: 2e-3}",
        ),
        {
            "motor slope": lambda s: s.motor.slope,
            "motor inertia": lambda s: s.motor.inertia,
            "speed": lambda s: s.speed,
        },
    ),
    "gas load": (
        ("scene.load={pressure_difference_Pa: 20000}",),
        {"pressure": lambda s: s.pressure, "pitch radius": lambda s: s.pitch_radius},
    ),
    "friction": (
        (
            "contact.friction={static: 0.12, kinetic: 0.08, stiction_speed_mm_s: 20, "
            "friction_speed_mm_s: 40}",
        ),
        {
            "kinetic friction": lambda s: s.friction.kinetic,
            "static friction": lambda s: s.friction.static,
            "stiction speed": lambda s: s.friction.stiction_speed,
            "friction speed": lambda s: s.friction.friction_speed,
        },
    ),
    "bearings": (
        ("scene.supports={stiffness_N_per_mm: 20000, damping_N_s_per_mm: 2}",),
        {
            "bearing stiffness": lambda s: s.supports.stiffness,
            "bearing damping": lambda s: s.supports.damping,
        },
    ),
    "center distance": (
        ("scene.center_distance_error_mm=0.02",),
        {"center distance error": lambda s: s.center_distance_error},
    ),
}
"""Scenes with single parts, and the quantities of those parts."""


@pytest.mark.long
@pytest.mark.parametrize("kind", PARTS)
def test_derivatives_with_respect_to_quantities_of_parts(kind):
    """Derivatives agree to 1e-6 of the change, or to the error of the differences.

    The change is the force's, with the relative change of a quantity. With the quantities of the
    shipped scene they are more than twenty."""
    overrides, gets = PARTS[kind]
    _, scene = scene_of(*overrides)
    values = [get(scene) for get in gets.values()]

    @jax.jit
    def found(values, start):
        moved = eqx.tree_at(lambda s: [get(s) for get in gets.values()], scene, values)
        response = steady_response(moved, DESIGN, start)
        return jnp.stack([response.mean, response.rms]), response

    known, response = found(values, None)
    assert Status.of(response.status) is Status.PERIODIC
    (jacobian,) = jax.jit(jax.jacfwd(lambda v: (found(v, None)[0],)))(values)
    for k, (name, value) in enumerate(zip(gets, values, strict=True)):

        def moved(step, k=k):
            entries = [x * (1 + step * (k == j)) for j, x in enumerate(values)]
            return np.asarray(found(entries, response.state)[0])

        slope, error = differentiated(moved, 8e-3, 6)
        allowed = np.maximum(1e-6 * np.maximum(abs(slope), 1e-2 * known), error)
        assert np.all(error < 1e-4 * abs(known)), name
        assert np.all(abs(jacobian[k] * value - slope) <= allowed), name


def test_batch_is_computed_one_by_one(scene, known, monkeypatch):
    """On a CPU, motions of a batch are computed one by one; on a GPU, together.

    As arrays, every motion would take as long as all of them."""

    def solved(scene, design, *_):
        """Stand in for a solution; it has no loop of its own."""
        return known[0]._replace(mean=jnp.sum(design)), design

    def loops(backend):
        monkeypatch.setattr(jax, "default_backend", lambda: backend)
        means = jax.vmap(lambda design: steady_response(scene, design).mean)
        return "scan[" in str(jax.make_jaxpr(means)(jnp.stack([DESIGN] * 7)))

    monkeypatch.setattr(steady, "_solve", solved)
    # `_inline` would reuse what JAX traced for the other backend.
    monkeypatch.setattr(steady, "_inline", steady._once)
    assert (loops("cpu"), loops("gpu")) == (True, False)


@pytest.mark.long
def test_batch_on_a_gpu_is_that_of_single_motions(scene, monkeypatch):
    """Motions that are computed together are those computed one by one, whichever branch each of
    them takes: from rest and from a neighbour, near and far, sound and unsound."""

    def mean(design, start):
        found = steady_response(scene, design, start)
        return found.mean, found

    start = steady_response(scene, DESIGN).start
    rest = eqx.tree_at(lambda s: s.known.sound, start, jnp.zeros((), bool))
    both = jax.value_and_grad(mean, has_aux=True)
    moved = np.array([[1, 1, 1], [1.002, 0.999, 1.001], [0.93, 0.95, 1.3], [0.5, 1, 1]])
    cases = [(design, begin) for design in moved * DESIGN for begin in (start, rest)]
    single = [jax.jit(both)(*case) for case in cases]
    jax.clear_caches()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    designs, starts = (
        jax.tree.map(lambda *x: jnp.stack(x), *part) for part in zip(*cases, strict=True)
    )
    (values, found), slopes = jax.jit(jax.vmap(both))(designs, starts)
    jax.clear_caches()
    for k, ((value, alone), slope) in enumerate(single):
        assert int(found.status[k]) == int(alone.status)
        np.testing.assert_allclose(values[k], value, rtol=1e-9)
        np.testing.assert_allclose(slopes[k], slope, rtol=1e-6)
    assert len(set(found.status.tolist())) > 1


def test_design_without_parameters():
    config = rootsopt.load_config("configs/ee.yaml")
    slopes = jax.grad(lambda design, scene: steady_response(scene, design).mean, (0, 1))
    by_design, by_scene = jax.eval_shape(slopes, config.design, Scene.from_config(config))
    assert (by_design.shape, by_scene.speed.shape) == ((0,), ())


def test_second_derivatives_are_refused(scene, monkeypatch):
    # Without tracing a solution that is not used.
    monkeypatch.setattr(steady, "_inline", steady._once)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.hessian(lambda design: steady_response(scene, design).mean)(DESIGN)


@pytest.mark.parametrize(
    ("design", "message"),
    [([1.0, 2.0], "must have 3 entries.*but has 2"), ([[1.0]], r"array \(d,\), but has shape")],
)
def test_designs_of_another_size_are_refused(scene, design, message):
    with pytest.raises(ValueError, match=message):
        steady_response(scene, design)


_SLOW = "identify", "Identification"
"""Names whose examples fit a record, which `tests/identification` does faster."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=[pytest.mark.long] * (one in _SLOW)) for one in rootsopt.__all__],
)
def test_example_in_the_docstring_runs(name, monkeypatch):
    """It prints what it says, and sets double precision itself where it needs it.

    The docstring of a constant stands below it; the version is shown in that of the package."""
    value = getattr(rootsopt, name)
    text = rootsopt.__doc__ if name == "__version__" else inspect.getdoc(value)
    if isinstance(value, dict):
        source = inspect.getsource(sys.modules[rootsopt._PUBLIC[name]])
        (text,) = re.findall(rf'^{name}.*?^"""(.*?)"""', source, re.M | re.S)
    example, told = doctest.DocTestParser().get_doctest(text, {}, name, None, 0), []
    assert "rootsopt" in "".join(one.source for one in example.examples), "no example"
    monkeypatch.setattr(terms, "_terms", dict(terms._terms))
    jax.config.update("jax_enable_x64", False)
    try:
        with for_a_time():
            result = doctest.DocTestRunner(verbose=False).run(example, out=told.append)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert result.failed == 0, "".join(told)


def test_every_public_name_is_there():
    with pytest.raises(AttributeError, match="no attribute 'Rotor'"):
        rootsopt.Rotor  # noqa: B018
    assert set(rootsopt.__all__) <= set(dir(rootsopt))


@pytest.mark.long
def test_example_of_the_readme_runs():
    (text,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)
    found = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, cwd=ROOT)
    assert (found.returncode, found.stderr) == (0, "")
    assert float(found.stdout.split()[0]) > 0


def test_an_evaluation_adds_terms_with_their_gradients():
    """A term of forces and profile follows the quotient rule; 1° is π/180 rad."""
    with registered(crest=lambda profile, shape, force: force.peak / force.mean
                    + profile.pressure_angle):  # fmt: skip
        found = rootsopt.evaluate(rootsopt.load_config("cic", ["objective.terms={crest: 0.1}"]))
    mean, peak = (found.response[name] for name in ("mean_force_N", "peak_force_N"))
    slopes = found.gradient
    for key, angle in (("pressure_angle_deg", np.pi / 180), ("involute_length_mm", 0.0)):
        rise = slopes["peak_force_N"][key] * mean - peak * slopes["mean_force_N"][key]
        assert slopes["crest"][key] == pytest.approx(rise / mean**2 + angle, rel=1e-9)
    own = np.radians(found.design["pressure_angle_deg"])
    assert found.response["crest"] == pytest.approx(peak / mean + own, rel=1e-12)
