"""Checks that every profile family must pass, including families from outside the package.

Each of `CHECKS` takes the name of a registered family and checks its example, a sound design for
three lobes and a pitch radius of 33 mm. Lengths are in m, except those of outlines, which are in
mm."""

import dataclasses
import functools
import pickle
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments._common.polygons import pair_gap
from rootsopt.commands import cli
from rootsopt.config import Config, parse
from rootsopt.config.explain import describe
from rootsopt.config.families import families, family_of
from rootsopt.contact.closest import FlankPair
from rootsopt.profiles import geometry
from rootsopt.profiles.soundness import margins
from rootsopt.scene import Scene
from rootsopt.scene.families import arguments_of, check, profile_of
from rootsopt.scene.space import Space, sobol
from tests.standins import ROOT, refusal

R = 0.033
LOBES = 3
COUNT = 1401
"""Number of points on a flank. It is always the same, so that one program evaluates them."""
measure = jax.jit(geometry)


def text_of(family, lobes=LOBES, **changes):
    """Return the text of a complete config with the family's example."""
    rest = (ROOT / "configs" / "cic_drawn.yaml").read_text("utf-8").split("\nrotor:")[1]
    keys = {"family": family, "lobes": lobes, "pitch_radius_mm": 33.0}
    keys |= {**family_of(family).example} | changes
    lists = {key: [*value] for key, value in keys.items() if isinstance(value, tuple)}
    inside = ", ".join(f"{key}: {value}" for key, value in (keys | lists).items())
    return f"profile: {{{inside}}}\nrotor:{rest}"


def config_of(family, lobes=LOBES, **changes):
    return parse(text_of(family, lobes, **changes)).profile


@functools.cache
def maker(family):
    return jax.jit(lambda design: profile_of(family, LOBES, jnp.asarray(R), design))


@functools.cache
def made(family):
    return maker(family)(arguments_of(config_of(family))[-1])


@jax.jit
def looked_at(profile, nu):
    """Return everything that a profile computes at normal angles, with derivatives."""

    def along(nu):
        point = profile.addendum(nu)
        return profile.position(point), point.s

    (place, _), (speed, s_slope) = jax.jvp(along, (nu,), (jnp.ones_like(nu),))
    return {
        "addendum": place,
        "dedendum": profile.position(profile.dedendum(nu)),
        "speed": speed,
        "s_slope": s_slope,
        "beta": profile.roll_angle(nu),
        "lever": profile.lever(nu),
        "support": profile.support(nu),
        "rate": profile.roll_rate(nu),
        "length": profile.speeds(nu)[1],
        "inverse": profile.normal_at(profile.roll_angle(nu)),
    }


@functools.cache
def sampled(family):
    """Return normal angles, always as many, with all joints, and the profile's values there."""
    ends = np.unique([[float(s.start), float(s.stop)] for s in made(family).segments()])
    counts = np.maximum(60, np.round(1200 * np.diff(ends) / ends[-1])).astype(int)
    counts[-1] += COUNT - 1 - sum(counts)
    inside = np.concatenate([np.arange(n) + 1e-9 for n in counts]) / np.repeat(counts, counts)
    nu = np.append(
        np.repeat(ends[:-1], counts) + np.repeat(np.diff(ends), counts) * inside, ends[-1]
    )
    found = looked_at(made(family), jnp.asarray(nu))
    return nu, {key: np.asarray(value) for key, value in found.items()}


@functools.cache
def outline_of(family):
    """Return the closed outline in mm, with more points where the flank turns."""
    _, found = sampled(family)
    flank = np.concatenate([found["addendum"], found["dedendum"][-2::-1]]) @ [1, 1j] * 1e3
    turn = np.exp(2j * np.pi / LOBES)
    lobe = np.concatenate([flank[:-1], (np.conj(flank) * turn)[:0:-1]])
    whole = np.concatenate([*(lobe * turn**k for k in range(LOBES)), lobe[:1]])
    return np.stack([whole.real, whole.imag], axis=-1)


def curve_is_the_one_its_normals_say(family):
    """Check normals, levers, arc lengths, the inverse of the roll angle, and the law of gearing.

    They are compared with derivatives of the outline; the law of gearing is ds/dβ = -r cos ψ."""
    nu, found = sampled(family)
    place, speed = (found[key] @ [1, 1j] * np.exp(-1j * nu) for key in ("addendum", "speed"))
    np.testing.assert_allclose(speed, 1j * found["length"], atol=1e-9)
    np.testing.assert_allclose(place, found["support"] - 1j * found["lever"], atol=1e-13)
    np.testing.assert_allclose(found["s_slope"], -found["lever"] * found["rate"], atol=1e-9)
    place = found["addendum"] @ [1, 1j]
    assert place[0].imag == pytest.approx(0, abs=1e-11)
    np.testing.assert_allclose(place[-1], R * np.exp(0.5j * np.pi / LOBES), atol=1e-15)
    # The outline has no gap at a joint.
    assert np.max(np.abs(np.diff(place))) < 2e-3 * R
    # A roll angle belongs to one normal only where it rises and does not come back later.
    later = np.minimum.accumulate(found["beta"][::-1])[::-1]
    single = (found["rate"] > 1e-6) & (found["beta"] <= later)
    assert np.mean(single) > 0.5
    np.testing.assert_allclose(found["inverse"][single], nu[single], atol=1e-9)


def what_margins_call_sound_is_one_curve(family):
    """Check all members within the bounds that the margins call sound.

    Support function and lever must be continuous, the law of gearing must hold, h′ = -lever, and
    the normal angle at a roll angle must have this roll angle. At least two members must be
    sound."""
    row, designs = family_of(family), [arguments_of(config_of(family))[-1]]
    if row.classical and row.parameters:
        usual = np.array([one.usually(1e3 * R, LOBES) for one in row.parameters])
        ends = np.array([(one.lowest, one.highest) for one in row.parameters])
        low, high = np.clip(usual, ends[:, :1], ends[:, 1:]).T
        designs.extend(low + (high - low) * sobol(128, 1, len(low)))

    def looked(design):
        profile = profile_of(family, LOBES, jnp.asarray(R), design)
        nu = profile.pitch_normal * jnp.linspace(0.0, 1.0, COUNT)
        found = margins(profile).of_flank
        least = [value for key, value in found.items() if key not in row.inherent]
        roll = profile.half_pitch * jnp.linspace(0.02, 0.98, 49)
        off = jnp.max(jnp.abs(profile.roll_angle(profile.normal_at(roll)) - roll))
        flank = jnp.max(profile.speeds(nu)[1]), nu[1], profile.support(nu), profile.lever(nu)
        return jnp.min(jnp.stack(least)), *flank, off

    found = jax.jit(lambda designs: jax.lax.map(looked, designs))(jnp.asarray(designs))
    least, curved, step, support, lever, off = map(np.asarray, found)
    assert np.max(off[(least >= -1e-9) & np.isfinite(curved)]) < 1e-7
    # Exclude almost straight flanks, where the lever may change at any rate.
    sound = (least >= -1e-9) & (curved < 3 * R)
    assert sound[0] or row.by_limits
    assert np.sum(sound) >= min(2, len(designs))
    step, support, lever = step[sound, None], support[sound], lever[sound]
    # By the distance of a centre of curvature from the axis.
    assert np.max(np.abs(np.diff(lever)) / step) < 4 * R
    fall = (lever[:, 1:] + lever[:, :-1]) / 2 * step
    assert np.max(np.abs(np.diff(support) + fall)) < 2e-6 * R


def area_and_moment_are_those_of_the_outline(family):
    """Compare area and polar moment with the shoelace formula for the outline's polygon."""
    points = outline_of(family) @ [1, 1j]
    shape = measure(made(family))
    product = np.conj(points[:-1]) * points[1:]
    assert float(shape.area) * 1e6 == pytest.approx(np.sum(product.imag) / 2, rel=2e-6)
    squares = abs(points[:-1]) ** 2 + product.real + abs(points[1:]) ** 2
    moment = np.sum(product.imag * squares) / 12
    assert float(shape.polar_area_moment) * 1e12 == pytest.approx(moment, rel=4e-6)


def rolling_pair_touches_and_does_not_overlap(family):
    """Check that |gap| < 1 nm through a mesh period, by node search."""
    for phi in 0.0123 + 2 * np.pi / LOBES * np.arange(0, 9, 2) / 9:
        assert abs(pair_gap(outline_of(family), LOBES, 2e3 * R, phi, phi)) < 1e-6


@jax.jit
def _searched(profile, roll, relative):
    pair = FlankPair.of(profile)

    def one(pose):
        attempts, best = pair._search(*pose)
        return attempts == 1, best, pair._search(*pose, attempt=1)[1]

    together = dataclasses.replace(pair, together=True)
    return (*jax.lax.map(one, (roll, relative)), jax.vmap(together._closest)(roll, relative))


def search_finds_the_closest_approach(family):
    """Compare reliable results of Newton's method with the search on nodes, and with outlines."""
    profile = made(family)
    rng = np.random.default_rng(3)
    half = float(profile.half_pitch)
    roll = rng.uniform(-half, half, 2000)
    relative = -(10 ** rng.uniform(-7, np.log10(5e-3), 2000))
    # Right before the middle of the mesh, and where the flank's contact begins.
    begins = float(profile.roll_angle(profile.segments()[-1].start))
    roll[:6] = [0.999 * half, 0.8 * half, 0.5 * half, begins + 1e-2, begins - 1e-3, begins - 1e-2]
    relative[:6] = -1e-3
    found = _searched(profile, jnp.asarray(roll), jnp.asarray(relative))
    certain, best, nodes, together = jax.tree.map(np.asarray, found)
    # Many poses are searched together, with the same result.
    for one, other in zip(together, best, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-10)
    # On a wavy flank, all minima are always compared.
    assert profile.wavy or np.mean(certain) > 0.5
    both = certain & best.found & nodes.found
    assert np.max(np.abs(best.gap - nodes.gap), where=both, initial=0.0) < 1e-13
    assert not np.any(nodes.found & (nodes.gap < 0) & certain & ~best.found)
    for x, turn, gap in zip(roll[:6], relative[:6], best.gap[:6], strict=True):
        seen = pair_gap(outline_of(family), LOBES, 2e3 * R, -x - turn / 2, -x + turn / 2)
        assert min(gap * 1e3, seen) == pytest.approx(seen, abs=2e-6)


def slopes_of_geometry_are_those_of_differences(family):
    """Compare derivatives with respect to each design parameter with central differences."""

    @jax.jit
    def look(design, way):
        def shape(design):
            found = geometry(profile_of(family, LOBES, jnp.asarray(R), design))
            return jnp.stack([found.area, found.outer_radius, found.polar_area_moment])

        return jax.jvp(shape, (design,), (way,))

    design = arguments_of(config_of(family))[-1]
    for way in jnp.diag(design):
        value, slope = look(design, way)
        up, down = (look(design + step * way, way)[0] for step in (1e-5, -1e-5))
        np.testing.assert_allclose(slope / value, (up - down) / 2e-5 / value, rtol=0, atol=1e-8)


def designs_are_points_of_the_unit_box_and_back(family):
    """Check the unit box. Its ends are the bounds, or the ends of a range that depends on the
    others."""
    row = family_of(family)
    if not row.parameters:
        return
    config = parse(text_of(family))
    space = Space.of(config, Scene.from_config(config))
    size = len(space.lower)
    points = np.vstack([np.zeros(size), np.ones(size), sobol(16, 2, size)])
    designs = jax.jit(jax.vmap(space.design))(jnp.asarray(points))
    np.testing.assert_allclose(jax.jit(jax.vmap(space.point))(designs), points, atol=1e-12)
    assert np.all(designs >= space.lower - 1e-9)
    assert np.all(designs <= space.upper * (1 + 1e-12))
    for design, end in zip(np.asarray(designs)[:2], (0, 1), strict=True):
        wanted = np.array([space.lower, space.upper])
        values = dict(zip(row.keys, row.split(jnp.asarray(design)), strict=True))
        for key, pair in row.dependent(LOBES, jnp.asarray(1e3 * R), **values).items():
            place = row.keys.index(key)
            ends = max(pair[0], space.floors[place] * pair[1]), pair[1]
            wanted[:, place] = np.clip(ends, *wanted[:, place])
        np.testing.assert_allclose(design, wanted[end], rtol=1e-12)


def config_is_read_and_written(family):
    """Check that the example is accepted, is the same after writing and in another process, and can
    take another design."""
    config = parse(text_of(family))
    assert pickle.loads(pickle.dumps(config)) == config
    check(config.profile)
    assert parse(config.to_yaml()) == config
    assert config.profile.parameters == {**family_of(family).example}
    assert config.profile.with_design(config.profile.design.tolist()) == config.profile
    for parameter in family_of(family).parameters:
        for value in (parameter.lowest - 1e6, parameter.highest + 1e6):
            given = [value] * 3 if parameter.count is not None else value
            message = refusal(config_of, family, **{parameter.key: given})
            assert f"profile.{parameter.key}" in message


def config_wants_the_keys_of_the_family(family):
    """Check the messages: a missing key is named, a foreign one rejected, a misspelt one
    corrected."""
    own = family_of(family).keys
    for key in own:
        missing = refusal(config_of, family, **{key: "null"})
        assert f"`profile.{key}` is required for family {family}" in missing
        assert f"did you mean `profile.{key}`" in refusal(config_of, family, **{f"{key}x": 1.0})
    examples = {key: value for one in families().values() for key, value in one.example.items()}
    foreign = next(k for k in examples if k not in own and not isinstance(examples[k], tuple))
    message = refusal(config_of, family, **{foreign: examples[foreign]})
    assert f"{foreign}` does not belong to family {family}" in message


def help_mentions_it(family):
    """Check that the help lists the family, its curves, its keys with their families, and their
    bounds."""
    lines = {line.split()[0]: line for line in describe(Config).splitlines()}
    assert family in re.findall(r"\w+", lines["profile.family"])
    about = {line.split()[0]: line for line in cli._all_keys().split("\n\n")[0].splitlines()}
    assert family_of(family).help in about[family]
    for parameter in family_of(family).parameters:
        line = lines[f"profile.{parameter.key}"]
        assert parameter.help in line
        assert family in line.split(": ")[0].replace(",", " ").split()
        assert "(bounds: default" in line
        assert parameter.key in lines["optimizer.bounds"]


CHECKS = (
    curve_is_the_one_its_normals_say,
    what_margins_call_sound_is_one_curve,
    area_and_moment_are_those_of_the_outline,
    rolling_pair_touches_and_does_not_overlap,
    search_finds_the_closest_approach,
    slopes_of_geometry_are_those_of_differences,
    designs_are_points_of_the_unit_box_and_back,
    config_is_read_and_written,
    config_wants_the_keys_of_the_family,
    help_mentions_it,
)
