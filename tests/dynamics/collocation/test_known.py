"""Tests of orbits closed from those of neighbouring pairs."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.shooting import closed as shooting
from rootsopt import Status, load_config
from rootsopt.dynamics.collocation.closing import Closer, Loop, gained
from rootsopt.dynamics.collocation.elements import GAUSS, POINTS, Elements, Mesh
from rootsopt.dynamics.collocation.equation import Points
from rootsopt.dynamics.collocation.events import (
    FIXED,
    FlagScan,
    extra,
    found_events,
    kinds,
    look,
    rooted,
)
from rootsopt.dynamics.collocation.mesh import KnownOrbit, padded, roughness, sizes, trimmed
from rootsopt.dynamics.collocation.peak import Rivals, peak_of, rivals_of
from rootsopt.dynamics.collocation.system import Step, moved_at, unchanged
from rootsopt.dynamics.orbit import Orbit
from rootsopt.dynamics.steady import VariedOrbit
from rootsopt.response.evaluation import Evaluator

PERIOD, BEGIN, USED = 2, 0.3, 10
TURN = 2 * np.pi / PERIOD


def inside(mesh):
    """Return the Gauss points of elements."""
    return mesh.ends[0][:, None] + mesh.lengths[:, None] * GAUSS.nodes


@jax.jit
def _known():
    """Return a sine over two mesh periods on equal elements, from τ = 0.3, with an end at τ = 2."""
    elements, times = 48, 51
    edges = np.concatenate([np.linspace(BEGIN, 2.0, 8), [2.1, 2.2, BEGIN + PERIOD]])
    filled = np.arange(elements) < USED
    share = np.append((edges - BEGIN) / PERIOD, np.ones(elements))
    mesh = Mesh(
        times=jnp.full(times, BEGIN + PERIOD).at[0].set(BEGIN),
        which=jnp.full(times, -1),
        interval=jnp.where(filled, 0, times - 2),
        left=jnp.where(filled, share[:elements], 1.0),
        right=jnp.where(filled, share[1 : elements + 1], 1.0),
        used=jnp.asarray(USED),
    )
    state, slopes = jnp.sin(TURN * mesh.ends[0]), TURN * jnp.cos(TURN * inside(mesh))
    roots = jnp.zeros((elements, POINTS + 1, 1, 2))
    motion = Elements(mesh, state[:, None], slopes[..., None], roots)
    return KnownOrbit(motion, *3 * [jnp.ones(())], *2 * [jnp.ones((), bool)])


def test_orbit_varies_at_constant_time():
    """The variation of sin(ωτ + p) is cos(ωτ), on a mesh whose inner time also moves.

    The states are those of the orbit, and follow its derivative with respect to time."""
    known, asked = _known().elements, np.array([0.0, 0.7, 1.9, 1.95, 2.05])

    @jax.jit
    def varied(elements, asked):
        mesh, number = elements.mesh, jnp.arange(elements.state.shape[0])
        # Seven elements before τ = 2, and three after it.
        late, filled = number >= 7, number < USED
        parts = (jnp.where(late, (number + k - 7) / 3, (number + k) / 7) for k in (0, 1))
        left, right = (jnp.where(filled, x, 1.0) for x in parts)
        interval = jnp.where(filled, late.astype(int), mesh.interval)
        two = mesh.times.at[1].set(2.0)
        mesh = mesh._replace(times=two, interval=interval, left=left, right=right)
        elements = elements._replace(mesh=mesh)
        begin, tau = mesh.ends[0], inside(mesh)
        times = jnp.zeros((mesh.times.shape[0], 1)).at[1].set(0.1)
        still = unchanged(elements, 1)._replace(times=times)

        def moves(tau):
            """Return how places that move with the mesh change their times."""
            k = jnp.broadcast_to(number.reshape(-1, *(1,) * (tau.ndim - 1)), tau.shape)
            return moved_at(elements, still, k, elements.share(k, tau))[0][..., 0]

        # There, the state and its slope change along the motion as well.
        state = jnp.cos(TURN * begin) * (1 + TURN * moves(begin))
        slopes = -TURN * jnp.sin(TURN * tau) * (1 + TURN * moves(tau))
        variation = Step(state[:, None, None], slopes[..., None, None], times, still.monodromy)
        return VariedOrbit(elements, variation).at(asked)

    found, rate, moved = varied(known, asked)
    np.testing.assert_allclose(found[:, 0], np.sin(TURN * asked), atol=1e-5)
    # The slopes' cubic misses by h⁴ ω⁵ / (4! 70) = 6.4e-4 at the ends of elements.
    np.testing.assert_allclose(rate[:, 0], TURN * np.cos(TURN * asked), atol=7e-4)
    np.testing.assert_allclose(moved[:, 0, 0], np.cos(TURN * asked), atol=2e-4)


def test_known_orbit_is_stored_without_unused_elements():
    """It returns as it was, in arrays of any size that has room for it."""
    known, tau = _known(), jnp.asarray([0.0, 0.7, 2.25])
    cut = trimmed(known)
    assert cut.elements.state.shape[0] == USED
    again = padded(cut, (48, 51)).elements.mesh
    jax.tree.map(np.testing.assert_array_equal, again, known.elements.mesh)
    large = jax.tree.map(jnp.asarray, padded(cut, sizes(8, 1, False)))
    for one in (lambda x: x.elements.motion(tau), lambda x: roughness(x.elements)):
        np.testing.assert_allclose(one(large), one(known), rtol=1e-15)


def test_flags_are_evaluated_where_a_short_touch_shows():
    """Beside zeros of the first state, and where it is extreme."""
    elements = _known().elements
    begin, length = elements.mesh.ends[0], elements.mesh.lengths
    bend = -(TURN**2) * jnp.sin(TURN * inside(elements.mesh))
    state = jnp.stack([jnp.sin(TURN * begin), TURN * jnp.cos(TURN * begin)], axis=1)
    slopes = jnp.concatenate([elements.slopes, bend[..., None]], axis=-1)
    moving = elements._replace(state=state, slopes=slopes)
    found = np.asarray(begin[:, None] + length[:, None] * extra(moving))[:USED]
    first, last = np.asarray(begin)[:USED], np.asarray(begin + length)[:USED]
    for zero in (1.0, 2.0):
        near = found[(first < zero - 1e-3) & (zero + 1e-3 < last)]
        # The elements are only near a sine.
        np.testing.assert_allclose(near, zero, rtol=0, atol=3e-6)
        np.testing.assert_allclose(np.diff(near), 4e-7, rtol=1e-6)
    assert np.sum(np.abs(found - 1.0) < 3e-6) == 2
    for turn in (0.5, 1.5):
        assert np.min(np.abs(found - turn)) < 1e-5


def _bump(tau, place, corner):
    """Return a force and its derivative with respect to the time `tau`: 200 at `place`."""
    away = tau - place
    bell = 200.0 * jnp.exp(-5.0 * away**2 + 2.0 * away**3)
    slope = bell * (-10.0 * away + 6.0 * away**2)
    # The corner is an event: the element before it has the slope of its own side at its end.
    behind = away > 1e-12
    return bell - 400.0 * corner * away * behind, slope - 400.0 * corner * behind


@jax.jit
def _located(elements, place, corner):
    """Return the peak of this force, and its instant."""
    force, rate = _bump(elements.places[0], place, corner)
    nothing = jnp.zeros((*force.shape, 1))
    points = Points(nothing, nothing[..., None], jnp.zeros((*force.shape, 1, 2)), force)
    rivals = Rivals.anywhere(elements)
    for _ in range(2):
        rivals = rivals_of(elements, points, force, rate, rivals)
        new = _bump(rivals.places(elements)[0], place, corner)
        force, rate = (x.at[USED].set(y) for x, y in zip((force, rate), new, strict=True))
    found = peak_of(elements, rivals, force, rate)
    begin, length = elements.mesh.ends[0][found.element], elements.mesh.lengths[found.element]
    return found, begin + length * found.share


@pytest.mark.parametrize(
    ("place", "corner"),
    [
        (0.8, 0.0),
        (0.8004, 0.0),
        (0.78571, 0.0),
        (0.3 + 1.7 * 3 / 7, 1.0),
        (0.6501, 0.0),
        (1.03, 0.0),
    ],
)
def test_peak_is_located(place, corner):
    """The peak lies beside or at an element's end, or in its middle, or is a corner at an end."""
    found, instant = _located(_known().elements, place, corner)
    np.testing.assert_allclose(instant, place, atol=2e-7)
    np.testing.assert_allclose(found.force, 200.0, rtol=1e-10)


ARCS = (
    "profile={family: four_arcs, lobes: 3, pitch_radius_mm: 33.0, arc_center_mm: 23.964, "
    "tip_arc_radius_mm: 20.659, tip_arc_turn_deg: 34.22}",
    "scene.center_distance_error_mm=-0.05",
    "optimizer.bounds={}",
)


def test_a_jump_and_a_handover_of_the_contact_are_events():
    """At constant ε, the contact of four arcs jumps over their joint twice in a mesh period, and
    twice slides over a lobe's axis to the other flank.

    Other changes of segment are events of their own. The jumps are those of a search at many
    instants. At a handover, the tip arc's centre lies on the axis of the other rotor's root."""
    config = load_config("cic_drawn", ARCS)
    pair, count = Evaluator.of(config).pair(config.design), 240
    edges = jnp.linspace(0.0, 1.0, count + 1)
    mesh = Mesh(
        times=jnp.ones(40).at[0].set(0.0),
        which=jnp.full(40, FIXED),
        interval=jnp.zeros(count, int),
        left=edges[:-1],
        right=edges[1:],
        used=jnp.asarray(count),
    )
    still = jnp.asarray([-1e-3 / pair.angle_scale, 0.0])
    elements = Elements(
        mesh, jnp.tile(still, (count, 1)), jnp.zeros((count, POINTS, 2)),
        jnp.zeros((count, POINTS + 1, 2, 2)),
    )  # fmt: skip

    jumping = kinds(pair).jump
    _, jump, _ = sorted(set(jumping))
    _, *hands = sorted(set(kinds(pair).hand))

    @eqx.filter_jit
    def searched(pair, instants):
        def at(tau):
            margins = pair.margins(tau, still)
            return margins.places.normal2[0], margins.values[hands[0]]

        events = found_events(pair, elements, look(pair, elements))
        return events.which, events.times, *jax.lax.map(at, instants)

    instants = np.linspace(0.5, 1.0, 8001)[1:-1]
    which, found, normals, past = map(np.asarray, searched(pair, jnp.asarray(instants)))
    # The normal of a lobe's axis has the angle 0.
    assert past[normals > 0].tolist() == normals[normals > 0].tolist()
    assert [which[np.isin(which, hands)].tolist(), len(hands)] == [hands, 2]
    tip, root = 23.964, 65.95 - 23.964
    turns = np.array([root, tip]) * -1e-3 / (tip - root)
    at = [0.0, 0.5] + np.array([1, -1]) * turns / (2 * np.pi / 3)
    np.testing.assert_allclose(found[np.isin(which, hands)], at, rtol=0, atol=1e-8)
    change = np.abs(np.diff(normals))
    jumps = instants[np.flatnonzero(change > 20 * np.median(change))]
    assert len(jumps) == 2
    np.testing.assert_allclose(found[which == jump], jumps, rtol=0, atol=1e-4)
    crossings = found[np.isin(which, np.flatnonzero(jumping == jump)) & (which != jump)]
    assert len(crossings) == 2
    assert np.max(np.abs(crossings - 0.75)) < 2e-3
    # At a jump, the element before it keeps its own minimum, also if only the other side pushes. At
    # a handover, both flanks keep theirs.
    half, roots = count // 2, jnp.zeros((count, POINTS + 2, 2)).at[:, -2].set(1.0)
    pushes = jnp.zeros(roots.shape, bool).at[:, -1].set(True)
    empty, keep = jnp.zeros((2 * count, 1), bool), eqx.filter_jit(rooted)
    for event, flanks in ((jump, [0]), (hands[0], [0, 1])):
        cut = Mesh(
            mesh.times.at[1].set(0.5),
            mesh.which.at[1].set(event),
            jnp.repeat(jnp.arange(2), half),
            jnp.tile(edges[:-1:2], 2),
            jnp.tile(edges[2::2], 2),
            mesh.used,
        )
        instants = jnp.repeat(cut.ends[1], 2)
        seen = FlagScan(instants, empty, empty, roots, pushes, jnp.asarray(2 * count))
        new = keep(pair, elements._replace(mesh=cut), seen)
        kept = np.argwhere(np.asarray(new.roots[:, -1, :, 0]) == 1.0)
        assert kept.tolist() == [[half - 1, flank] for flank in flanks]


@pytest.mark.parametrize("order", [0.55, 2.0, 8.0])
@pytest.mark.parametrize("more", [1.01, 1.2, 1.4, 2.0])
def test_estimated_error_of_derivatives_is_a_bound_however_little_the_mesh_grows(order, more):
    sizes = np.array([1000, round(1000 * more)])
    error = sizes.astype(float) ** -order
    _, slope = gained(*map(jnp.asarray, sizes))
    assert (error[0] - error[1]) / slope >= error[1]


class _Crowded(Closer):
    """A loop whose meshes have room for 159 elements."""

    def most(self, now):
        return jnp.asarray(159)


@pytest.mark.parametrize(
    ("used", "meshes", "ends"),
    [(113, 1, False), (134, 1, False), (136, 1, True), (158, 1, True), (158, 0, False)],
)
def test_a_mesh_is_refined_only_if_the_finer_one_says_something_new(used, meshes, ends):
    """A mesh of 159 elements has the error of that of 158, and would hide it."""
    zero, start = jnp.zeros(()), _known()

    def forces(slope, elements):
        mesh = start.elements.mesh._replace(used=jnp.asarray(elements))
        slopes = {"response": jnp.ones(3), "sensitivity": jnp.full((3, 1), slope)}
        orbit = Orbit(**dict.fromkeys(Orbit._fields, zero) | slopes)
        return orbit, start.elements._replace(mesh=mesh)

    orbit, coarse = forces(1.0, 100)
    finer, motion = forces(1.1, used)
    now = {
        **dict.fromkeys(Loop._fields, zero),
        **{"orbit": orbit, "known": start._replace(elements=coarse)},
        **{"elements": motion, "meshes": jnp.asarray(meshes)},
    }
    pair = SimpleNamespace(force_scale=jnp.ones(()))
    loop = _Crowded(None, pair, None, start, None, jnp.asarray(1e-7))
    assert bool(loop.keep(Loop(**now), finer, motion).over) is ends


@pytest.mark.long
def test_free_form_from_a_neighbour_is_that_from_rest():
    """Elements end at its knots too, and gradients with respect to its coefficients are exact."""
    evaluator = Evaluator.of(load_config("configs/free.yaml"))
    base = evaluator(series=False)
    design = evaluator.config.design * (1 + 2e-3 * np.cos(3.0 * np.arange(13)))
    near = evaluator(design, start=base.start, series=False)
    assert near.statistics["from_neighbour"] == 1
    _assert_alike(near, evaluator.at_tolerance(1e-10)(design, series=False), 1e-6, 3e-4)
    _assert_shot(evaluator, near, 1e-6)


FORCES = ("mean_force_N", "peak_force_N", "rms_force_N")


def _assert_alike(one, other, forces, slopes):
    """Forces are equal to a relative error, and gradients to one of the greatest entry."""
    for name in FORCES:
        np.testing.assert_allclose(one.response[name], other.response[name], rtol=forces)
    for name, slope in other.gradient.items():  # EE has no parameters
        rows = np.array([list(one.gradient[name].values()), list(slope.values())])
        np.testing.assert_allclose(*rows, rtol=0, atol=slopes * np.max(np.abs(rows)))


def _assert_shot(evaluator, found, within):
    """The forces are those of an orbit closed by integrations."""
    pair = evaluator.pair(np.array(list(found.design.values())))
    truth = shooting(pair, found.state, found.steady_state["period"])
    np.testing.assert_allclose([found.response[n] for n in FORCES], truth.forces, rtol=within)


@pytest.mark.parametrize("name", ["cic_drawn", pytest.param("ee", marks=pytest.mark.long)])
def test_orbit_from_a_neighbour_is_that_from_rest(name):
    """At half the speed, other events occur."""
    config = load_config(f"configs/{name}.yaml")
    evaluator = Evaluator.of(config)
    base = evaluator(series=False)
    assert "from_neighbour" not in base.statistics
    for factor, slack in ((0.5, 1e-2), (1.003, 5e-6)):
        moved = evaluator.at_speed(config.scene.speed_rpm * factor)
        near = moved(start=base.start, series=False)
        usual = moved.at_tolerance(1e-10)(series=False)
        assert "from_neighbour" not in usual.statistics
        assert near.status is usual.status is Status.PERIODIC
        if factor > 1:
            assert near.statistics["from_neighbour"] == 1
            # The first step is along the tangent. The peak of EE takes three more to locate.
            assert near.statistics["newton_steps"] <= 3 + 3 * (name == "ee")
        _assert_alike(near, usual, 2e-6, slack)
        _assert_shot(moved, near, 2e-6)
    # A chain of neighbours.
    moved = evaluator.at_speed(config.scene.speed_rpm * 1.006)
    assert moved(start=near.start, series=False).statistics["from_neighbour"] == 1


def test_maxima_near_a_neighbour_are_those_from_rest():
    """At this speed, some of the local maxima follow events."""
    # An orbit is refined for mean, RMS and peak; at 1e-8, lower maxima err by some 1e-6.
    config = load_config("cic_drawn", ["scene.speed_rpm=1000", "solver.rtol=1e-9"])
    evaluator = Evaluator.of(config).with_maxima()
    base = evaluator(series=False)
    for factor in (0.998, 1.003):
        design = factor * config.design
        near = evaluator(design, start=base.start, series=False)
        usual = evaluator.at_tolerance(1e-10)(design, series=False)
        assert near.statistics["from_neighbour"] == 1
        assert "from_neighbour" not in usual.statistics
        one, other = near.maxima, usual.maxima
        assert len(one.forces) == len(other.forces) == 5
        np.testing.assert_allclose(one.forces, other.forces, rtol=1e-6)
        size = np.max(np.abs(other.slopes), axis=1, keepdims=True)
        np.testing.assert_allclose(one.slopes / size, other.slopes / size, rtol=0, atol=1e-2)


def test_a_coarser_accuracy_saves_work_and_bounds_the_error():
    config, work = load_config("configs/cic_drawn.yaml"), []
    truth = Evaluator.of(config).at_tolerance(1e-11)(series=False)
    for accuracy in (1e-2, 1e-5, 1e-7):
        # With series, the orbit must be confirmed by an integration.
        tool = Evaluator.of(config.replaced({"solver.accuracy": accuracy}))
        found = tool(series=accuracy == 1e-2)
        assert found.status is Status.PERIODIC
        _assert_alike(found, truth, accuracy, accuracy)
        effort = found.statistics
        # Two meshes cannot show the last 2.5e-7 of the error.
        assert effort["gradient_disagreement"] <= max(accuracy, 2.5e-7)
        work.append(effort["solver_steps"] + effort["newton_steps"] * effort["orbit_elements"])
    assert work[0] < 0.7 * work[1] < 0.7 * work[2]
