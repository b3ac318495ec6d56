"""Tests of first-order contact and of the paper's node-against-segment contact (SI units)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rootsopt.contact.linear import LinearContact
from rootsopt.contact.segments import NodeContact

from rootsopt.contact import FlankPair
from rootsopt.profiles import CIC, EE

R = 0.033
DEG = np.pi / 180
# Poses of every batch: one compilation per contact and family.
COUNT = 600


def cic(lobes, alpha, fraction, tip):
    """Return a CIC profile with u given as a fraction of u_max."""
    longest = R * np.sin(alpha) * (np.pi / (2 * lobes) - tip)
    return CIC(lobes, R, alpha, fraction * longest, tip)


PAPER = CIC(3, R, 36.43 * DEG, 9.0e-3, 4.0 * DEG)
PROFILES = {
    "two lobes": cic(2, 0.75, 0.8, 0.08),
    "three lobes": cic(3, 0.62, 0.7, 0.06),
    "five lobes": cic(5, 0.50, 0.7, 0.03),
    "ee three": EE(3, R),
}
few_profiles = pytest.mark.parametrize("profile", [PROFILES["five lobes"], PROFILES["ee three"]])
every_profile = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES.keys())


def nodes_100(profile):
    return NodeContact.of(profile, 100)


def nodes_200(profile):
    return NodeContact.of(profile, 200)


FIDELITIES = {"linear": LinearContact.of, "nodes": nodes_100}
every_fidelity = pytest.mark.parametrize("build", FIDELITIES.values(), ids=FIDELITIES.keys())


@eqx.filter_jit
def built(build, profile):
    """Return the contact of a profile, made in one compiled program."""
    return build(profile)


@eqx.filter_jit
def evaluate(contact, rolls, relatives):
    """Return gap, lever1, lever2 at many poses."""
    return jax.vmap(contact)(jnp.asarray(rolls), jnp.asarray(relatives))


@eqx.filter_jit
def slopes(contact, rolls, relatives):
    """Return ∂G/∂x and ∂G/∂ε at many poses."""
    gradient = jax.jacfwd(lambda x, e: contact(x, e)[0], (0, 1))
    return jax.vmap(gradient)(jnp.asarray(rolls), jnp.asarray(relatives))


@eqx.filter_jit
def _search(profile, rolls, relatives):
    return jax.vmap(FlankPair.of(profile))(jnp.asarray(rolls), jnp.asarray(relatives))


def search(profile, rolls, relatives):
    """Return the reference: gap, lever1, lever2 of the search."""
    found = _search(profile, rolls, relatives)
    return np.stack([found.gap, found.lever1, found.lever2])


def poses(lobes, seed, deepest=-4e-4):
    """Return random poses over the flank and a little more, with and without penetration."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.1, np.pi / lobes + 0.1, COUNT), deepest * rng.uniform(0, 1, COUNT)


# The inverse of the roll angle


@every_profile
def test_normal_at_inverts_the_roll_angle(profile):
    """ν(β(ν)) = ν from the tip to the pitch point."""
    nu = jnp.linspace(0, float(profile.pitch_normal), 301)
    np.testing.assert_allclose(profile.normal_at(profile.roll_angle(nu)), nu, atol=1e-12)


def test_involute_is_preferred_where_the_roll_angle_turns_back():
    """For u > u_max, ψ = α from the start of the involute, which lies before the end of the arc."""
    start, tip = float(PAPER.involute_start), float(PAPER.tip_arc_angle)
    assert start < tip
    beta = jnp.linspace(start, tip, 21)
    psi = beta + np.pi / 2 - PAPER.normal_at(beta)
    np.testing.assert_allclose(psi, PAPER.pressure_angle, atol=1e-12)
    land = jnp.linspace(0, start - 1e-9, 21)
    np.testing.assert_array_equal(PAPER.normal_at(land), land)


def test_arc_shrinks_to_an_instant_as_its_center_nears_the_pitch_circle():
    """As c → r, the arc's normals mesh within a roll angle that tends to zero."""
    for short in (1e-3, 1e-6, 1e-9):
        profile = cic(3, 0.62, 1 - short, 0.06)
        start, stop = float(profile.tip_arc_angle), float(profile.involute_start)
        beta = start + (stop - start) * jnp.linspace(0, 1, 11)
        normal = profile.normal_at(beta)
        assert np.all(np.diff(normal) > 0)
        # β has an absolute rounding of 1e-17, here shared out over the arc.
        tolerance = 1e-12 + 1e-15 / short
        np.testing.assert_allclose(profile.roll_angle(normal), beta, atol=1e-13)
        np.testing.assert_allclose(normal[-1], profile.arc_end, atol=tolerance)


# What both fidelities promise


@every_fidelity
@every_profile
def test_levers_are_the_derivatives_of_the_gap(build, profile):
    """d gap = -lever1 dφ1 + lever2 dφ2, by JAX and, away from joints, by central differences."""
    contact = built(build, profile)
    rolls, relatives = poses(profile.lobes, 1)
    gap, lever1, lever2 = (np.asarray(v) for v in evaluate(contact, rolls, relatives))
    by_roll, by_relative = slopes(contact, rolls, relatives)
    np.testing.assert_allclose(by_roll, lever1 - lever2, rtol=0, atol=1e-12 * R)
    np.testing.assert_allclose(by_relative, (lever1 + lever2) / 2, rtol=0, atol=1e-12 * R)
    step = 1e-7
    for dx, de, exact in ((step, 0, by_roll), (0, step, by_relative)):
        ends = [evaluate(contact, rolls + k * dx, relatives + k * de)[0] for k in (1, -1)]
        difference = np.asarray(ends[0] - ends[1]) / (2 * step)
        # Rounding 1e-17 m / 1e-7; a few poses straddle a joint, a node or the onset.
        wrong = np.abs(difference - exact) > 1e-6 * R
        assert wrong.mean() < 0.01
    assert np.mean(gap < 0) > 0.3


@every_fidelity
@every_profile
def test_flanks_swap_under_exchange_of_the_rotors(build, profile):
    """x → π/N - x exchanges the rotors: same gap, exchanged levers. 2π/N is a period."""
    contact = built(build, profile)
    rolls, relatives = poses(profile.lobes, 2)
    whole = np.pi / profile.lobes
    here = evaluate(contact, rolls, relatives)
    there = evaluate(contact, whole - rolls, relatives)
    later = evaluate(contact, rolls + 6 * whole, relatives)
    # Slopes of the levers are large on the arc; the roll is reduced with rounding 1e-15.
    for other in ((there[0], there[2], there[1]), later):
        np.testing.assert_allclose(here[0], other[0], rtol=0, atol=1e-14)
        assert np.mean(np.abs(np.asarray(here[1]) - other[1]) > 1e-9 * R) < 0.01
        assert np.mean(np.abs(np.asarray(here[2]) - other[2]) > 1e-9 * R) < 0.01


SPECIAL = [
    PAPER,
    cic(3, 0.62, 1.0, 0.06),
    cic(3, 0.62, 1.0, 0.0),
    cic(3, 0.62, 0.7, 0.06),
]


@eqx.filter_jit
def _derivatives(design, rolls, relatives, weights, build):
    """Return the derivatives of the outputs in (α, u, θ1, shift of x, shift of ε) at every pose.

    Also return, by reverse mode, those of their weighted sum."""

    def outputs(inputs):
        contact = build(CIC(3, R, inputs[0], inputs[1], inputs[2]))
        return jnp.stack(jax.vmap(contact)(rolls + inputs[3], relatives + inputs[4]), axis=-1)

    inputs = jnp.concatenate([design, jnp.zeros(2)])
    return jax.jacfwd(outputs)(inputs), jax.vjp(outputs, inputs)[1](weights)[0]


def special_poses(profile, rng):
    """Return design, roll and ε at joints, at the ends of contact, beside them and at random."""
    half = profile.half_pitch
    joints = [0.0, float(profile.tip_arc_angle), float(profile.involute_start), half]
    joints += [2 * half - j for j in joints] + [-half, 3 * half]
    edges = [j + d for j in joints for d in (0.0, 1e-16, -1e-16, 1e-9, -1e-9)]
    rolls = np.concatenate([edges, edges, rng.uniform(-4, 4, 100)])
    depths = [np.zeros(len(edges)), np.full(len(edges), -2e-4), rng.uniform(-0.02, 0.02, 100)]
    design = [profile.pressure_angle, profile.involute_length, profile.tip_arc_angle]
    return jnp.stack(design), jnp.asarray(rolls), jnp.asarray(np.concatenate(depths))


@pytest.mark.parametrize(
    "build", [LinearContact.of, pytest.param(nodes_100, marks=pytest.mark.long)]
)
def test_derivatives_are_finite_and_equal_in_both_modes(build):
    """Derivatives in pose and design are finite inside and outside contact, for c < r, c = r and c
    > r."""
    rng = np.random.default_rng(3)
    for profile in SPECIAL:
        design, rolls, relatives = special_poses(profile, rng)
        # Compared at the random poses only: at the others the deepest pair may be a tie.
        weights = rng.normal(size=(len(rolls), 3))
        weights[:-100] = 0
        forward, reverse = _derivatives(design, rolls, relatives, jnp.asarray(weights), build)
        assert np.all(np.isfinite(forward))
        summed = np.einsum("nk,nkd->d", weights, forward)
        scale = np.einsum("nk,nkd->d", np.abs(weights), np.abs(forward))
        assert np.all(np.abs(reverse - summed) <= 1e-9 * scale)


@every_fidelity
@given(
    index=st.integers(0, len(SPECIAL) - 1),
    roll=st.floats(-1e3, 1e3),
    relative=st.floats(-0.3, 0.3),
)
def test_any_pose_gives_finite_numbers(build, index, roll, relative):
    """Gap, levers and slopes are finite. Without contact, levers are 0 and the gap is the pitch
    radius."""
    contact = built(build, SPECIAL[index])
    gap, lever1, lever2 = evaluate(contact, np.full(1, roll), np.full(1, relative))
    assert np.all(np.isfinite(slopes(contact, np.full(1, roll), np.full(1, relative))))
    assert np.all(np.isfinite([gap, lever1, lever2]))
    if float(lever1[0]) == float(lever2[0]) == 0:
        assert float(gap[0]) in (0, R)


# First order in ε


@every_profile
def test_linear_error_is_of_second_order_in_relative_rotation(profile):
    """Against the search, the gap has order 2 in ε and the levers order 1, away from joints."""
    contact = LinearContact.of(profile)
    half = profile.half_pitch
    start, stop = 0.0, half
    if isinstance(profile, CIC):
        start, stop = float(profile.tip_arc_angle), float(profile.involute_start)
    width = stop - start
    rolls = np.resize(np.linspace(start + 0.4 * width, stop - 0.2 * width, 60), COUNT)
    sizes = np.array([1e-5, 3e-5, 1e-4, 3e-4])
    errors = []
    for size in sizes:
        relatives = np.full(COUNT, -size)
        error = np.asarray(evaluate(contact, rolls, relatives)) - search(profile, rolls, relatives)
        errors.append(np.sqrt(np.mean(error**2, axis=1)))
    order = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    np.testing.assert_allclose(order, [2, 1, 1], atol=0.1)
    # On the arc, ψ turns fast: 0.5 µm at the largest ε, whose depth is 8 µm.
    assert errors[-1][0] < 5e-7


def test_linear_is_exact_on_the_involute():
    """Where involute meets involute, the gap is r cos α · ε and both levers are the base radius."""
    profile = PAPER
    start, half = float(profile.involute_start), float(profile.half_pitch)
    rolls = np.resize(np.linspace(start + 0.02, 2 * half - start - 0.02, 31), COUNT)
    relatives = np.full(COUNT, -3e-4)
    found = np.asarray(evaluate(LinearContact.of(profile), rolls, relatives))
    np.testing.assert_allclose(found, search(profile, rolls, relatives), rtol=1e-9)
    np.testing.assert_allclose(found[1:], R * np.cos(36.43 * DEG), rtol=1e-12)


def test_linear_contact_begins_at_the_end_of_the_land():
    """Before the land's end nothing touches; the depth starts from zero unless c ≥ r."""
    profile = PROFILES["three lobes"]
    tip = float(profile.tip_arc_angle)
    rolls = np.resize([tip - 1e-3, tip, tip + 1e-7, -0.1], COUNT)
    gap, lever1, lever2 = evaluate(LinearContact.of(profile), rolls, np.full(COUNT, -3e-4))
    np.testing.assert_array_equal(np.asarray(gap)[[0, 1, 3]], R)
    np.testing.assert_array_equal(np.asarray([lever1, lever2])[:, [0, 1, 3]], 0)
    assert -2e-11 < float(gap[2]) < 0


# Node against segment


@eqx.filter_jit
def _by_nodes(profile, count, rolls, relatives):
    return jax.vmap(NodeContact.of(profile, count))(rolls, relatives)


@few_profiles
def test_node_error_is_of_second_order_in_spacing(profile):
    """Against the search, the gap has order 2 in the node spacing and the levers order 1."""
    rolls, relatives = poses(profile.lobes, 4)
    exact = search(profile, rolls, relatives)
    deep = exact[0] < -1e-6
    assert deep.mean() > 0.3
    counts = (60, 150, 380)
    errors = []
    for count in counts:
        found = np.asarray(_by_nodes(profile, count, jnp.asarray(rolls), jnp.asarray(relatives)))
        errors.append(np.sqrt(np.mean((found - exact)[:, deep] ** 2, axis=1)))
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    # The error of EE falls a little slower, because its cusp at the pitch point dominates.
    assert 1.6 < order[0] < 2.2
    assert np.all((order[1:] > 0.8) & (order[1:] < 1.5))
    assert errors[-1][0] < 2e-7


@pytest.mark.parametrize("profile", [PAPER, PROFILES["ee three"]])
def test_node_gap_is_continuous(profile):
    """Steps of the depth shrink with those of the roll, also at the ends of contact.

    The levers are derivatives of the gap, which is therefore a potential."""
    contact = built(nodes_100, profile)
    steps = 24001
    rolls = np.linspace(-0.06, np.pi / profile.lobes + 0.06, steps)
    gap = np.asarray(evaluate(contact, rolls, np.full(steps, -3e-4))[0])
    depth = np.maximum(-gap, 0)
    fine, coarse = (np.abs(np.diff(d)).max() for d in (depth, depth[::4]))
    assert 0 < fine < 0.3 * coarse


@every_profile
def test_levers_of_nodes_belong_to_one_line(profile):
    """Both levers belong to one normal: their sum is at most the centre distance."""
    rolls, relatives = poses(profile.lobes, 5, deepest=-0.01)
    contact = built(nodes_100, profile)
    gap, lever1, lever2 = (np.asarray(v) for v in evaluate(contact, rolls, relatives))
    # At depths below a node's protrusion, flanks may touch that do not mesh yet.
    touch = gap < -1e-6
    assert np.all(lever1[touch] + lever2[touch] <= 2 * R)
    assert np.all(lever1[touch] + lever2[touch] > 0)


@pytest.mark.parametrize("profile", [*PROFILES.values(), EE(2, R)])
def test_nodes_ahead_are_ahead(profile):
    """The assumption of the bisection holds.

    Seen from any node along the bisector at any other node, the nodes nearer to the tip lie behind
    and those nearer to the root ahead."""
    contact = built(nodes_200, profile)
    for nodes, tangent in zip(contact.nodes, contact.tangent, strict=True):
        ahead = np.einsum("ijk,jk->ij", nodes[:, None] - nodes[None], tangent)
        i, j = np.indices(ahead.shape)
        assert np.all(ahead[i > j] > 0)
        assert np.all(ahead[i < j] < 0)


def test_too_few_nodes_are_refused():
    with pytest.raises(ValueError, match="at least 16"):
        NodeContact.of(PAPER, 10)


@every_fidelity
def test_single_precision_is_kept(build):
    """The results have the dtype of the inputs."""
    values = (jnp.asarray(v, jnp.float32) for v in (R, 0.62, 7e-3, 0.06))
    contact = built(build, CIC(3, *values))
    pose = (jnp.asarray(v, jnp.float32) for v in (0.4, -1e-4))
    assert all(v.dtype == jnp.float32 for v in eqx.filter_jit(contact)(*pose))


# Linear contact's jumps


@few_profiles
def test_edges_of_linear_contact(profile):
    """The distance from the edges is continuous with the stated slope, with a kink at each jump of
    the gap."""
    contact = built(LinearContact.of, profile)
    rolls = np.linspace(-0.1, np.pi / profile.lobes + 0.1, 4001)

    @eqx.filter_jit
    def look(rolls):
        return jax.vmap(lambda roll: contact.approach(roll, jnp.asarray(-1e-4)))(rolls)

    found = look(rolls)
    distance, slope, gap = map(np.asarray, (*found.edges, found.gap))
    step = rolls[1] - rolls[0]
    most = 2.0 * np.abs(slope).max() * step
    assert np.max(np.abs(np.diff(distance))) < most
    straight = slope[1:] == slope[:-1]
    np.testing.assert_allclose(np.diff(distance)[straight], slope[1:][straight] * step, atol=1e-12)
    jumps = np.flatnonzero(np.abs(np.diff(gap)) > 1e-3 * R)
    assert len(jumps) == 2
    assert not np.any(straight[jumps])


@few_profiles
def test_switches_of_linear_contact(profile):
    """A flag changes between any two poses between which the gap jumps."""
    contact = built(LinearContact.of, profile)
    rolls = np.linspace(-0.1, np.pi / profile.lobes + 0.1, 4001)

    @eqx.filter_jit
    def look(roll):
        found = contact.approach(roll, jnp.asarray(-1e-4))
        return found.gap, found.lever1, contact.switches(roll, found)

    gap, lever, flags = (np.asarray(x) for x in jax.vmap(look)(rolls))
    changes = np.any(flags[1:] != flags[:-1], axis=1)
    assert 2 <= changes.sum() < 10
    assert np.all(changes[np.abs(np.diff(gap)) > 1e-3 * R])
    assert np.all(changes[np.abs(np.diff(lever)) > 1e-2 * R])
