"""Flow of a pump without leakage: displacement, flow over the mesh, ripple and its lines.

Virtual work gives the flow from the torques of the gas load: Δp Q = T1 ω1 + T2 ω2. With the contact
at distance s from the pitch point, ρ1² + ρ2² = 2 (r² + s²), and the flow at speed ω is

    Q = ω L (r_a² - r² - s²).

r is the pitch radius, r_a the outer radius, L the rotor's length. `docs/pump.md` derives this and
what follows from it.

The mesh leaks along the rotor's whole length, with a gap that changes over the rotation. Both tips
leak along the same length, and the four end faces leak across the rotors. A liquid flows by
Reynolds' equation. A gas flows at the lesser of two limits, friction (compressible laminar flow)
and inertia (an ideal nozzle of the gap's height).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rootsopt.contact.wrapped import series_at, wear_series
from rootsopt.profiles import Geometry, Profile, quadrature_nodes
from rootsopt.pump.gap import Allowances, MeshGap, Play, mesh_gap, play, rolls
from rootsopt.scene.build import Scene
from rootsopt.scene.reading import Gas, Medium

CM3 = 1e-6
"""One cubic centimetre (m³)."""
L_MIN = 1e-3 / 60
"""One litre per minute (m³/s)."""
MRAD = 1e-3
"""One milliradian (rad)."""
# Number of panels of the quadrature over the length of twisted rotors.
_PANELS = 64


def displaced_volume(shape: Geometry, length: Float[Array, ""]) -> Float[Array, ""]:
    """Return the volume (m³) that a pair displaces per revolution, 2 L (π r_a² - A).

    Each rotor carries one pocket per lobe and revolution. `shape`: geometry of the rotors;
    `length`: L (m)."""
    return 2 * length * (jnp.pi * shape.outer_radius**2 - shape.area)


def theoretical_flow(
    shape: Geometry, length: Float[Array, ""], speed: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the mean flow (m³/s) without leakage.

    `shape`: geometry of the rotors; `length`: L (m); `speed`: ω (rad/s)."""
    return displaced_volume(shape, length) * speed / (2 * jnp.pi)


def relative_flow(profile: Profile, shape: Geometry, phi: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the flow at the angles `phi` of rotor 1, as a fraction of the mean flow.

    `phi`: φ1 (rad), 0 with a lobe of rotor 1 on the line of centres. The pair rolls without
    clearance. Where several points of a flank mesh at once, the one nearest to the pitch point
    seals."""
    half = profile.half_pitch
    pitch = 4 * half
    roll = jnp.abs(phi - pitch * jnp.round(phi / pitch))
    s = profile.contact_distance(profile.normal_at(half - jnp.abs(roll - half)))
    return (shape.outer_radius**2 - profile.pitch_radius**2 - s**2) / _mean(shape)


def ripple(profile: Profile, shape: Geometry) -> Float[Array, ""]:
    """Return the peak-to-peak ripple of the flow as a fraction of the mean flow.

    The distance s is 0 at the pitch crossing and r_a - r at the tip. The ripple is therefore (r_a -
    r)² / (η r_a²), with the area efficiency η. At a given r_a / r and η, no shape of the flank
    changes it. The formula holds for conjugate profiles whose roll angle never turns back. For a
    measured outline, its error grows with the deviation from conjugate flanks."""
    return (shape.outer_radius - profile.pitch_radius) ** 2 / _mean(shape)


def flow_lines(profile: Profile, shape: Geometry, count: int = 4) -> Float[Array, " count"]:
    """Return the lines c_k (count,) of the flow, k = 1 … `count`, as fractions of the mean flow.

    Q(φ1) = mean · (1 + Σ c_k cos(2 N k φ1)): the flow has 2N periods per revolution. With the
    profile's own quadrature, c_k is exact to rounding for small k."""
    nu, weights, _ = quadrature_nodes(profile)
    lobes = profile.lobes
    square = profile.contact_distance(nu) ** 2 * profile.roll_rate(nu) * weights
    order = 2 * lobes * jnp.arange(1, count + 1)
    turns = jnp.cos(order[:, None, None] * profile.roll_angle(nu))
    # Twice the mean of s² cos over the quarter of the mesh that the addendum covers.
    return -4 * lobes / jnp.pi * jnp.sum(turns * square, axis=(1, 2)) / _mean(shape)


def twisted_lines(
    lines: Float[Array, " count"], lobes: int, twist: Float[Array, ""]
) -> Float[Array, " count"]:
    """Return the `lines` (count,) of the flow of twisted rotors, from those of straight ones.

    The mean over the phases φ - Φ/2 … φ + Φ/2 multiplies c_k by sin(kNΦ) / (kNΦ). `lobes`: N;
    `twist`: Φ (rad)."""
    order = lobes * jnp.arange(1, lines.shape[0] + 1)
    return lines * jnp.sinc(order * twist / jnp.pi)


def twisted_ripple(profile: Profile, shape: Geometry, twist: Float[Array, ""]) -> Float[Array, ""]:
    """Return the peak-to-peak ripple of the flow of rotors with the `twist` Φ (rad).

    The mean flow over the phases φ - Φ/2 … φ + Φ/2 is symmetric, so its extremes are where those of
    straight rotors are: at the tip, φ = 0, and at the pitch crossing, φ = π/2N. `_PANELS` panels
    with four Gauss points each give the two means."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    places = ((np.arange(_PANELS)[:, None] + (nodes + 1) / 2) / _PANELS - 0.5).ravel()
    shares = jnp.asarray(np.tile(weights / 2, _PANELS) / _PANELS)
    middles = jnp.array([[0.0], [profile.half_pitch]])
    means = relative_flow(profile, shape, middles + twist * places) @ shares
    return jnp.abs(means[1] - means[0])


def ripple_of(scene: Scene, profile: Profile, shape: Geometry) -> Float[Array, ""]:
    """Return the ripple of the flow in a `scene`, with its twist."""
    if scene.helix is None:
        return ripple(profile, shape)
    return twisted_ripple(profile, shape, scene.helix)


def greatest_radius_ratio(lobes: int) -> float:
    """Return the limit of r_a / r for symmetric conjugate profiles, 1 + 2 sin(π/4N).

    Beyond this limit, the dedendum would leave the pitch circle: the flank is undercut, or its roll
    angle turns back. `lobes`: N."""
    return 1 + 2 * math.sin(math.pi / (4 * lobes))


def tip_height_share(profile: Profile, shape: Geometry) -> Float[Array, ""]:
    """Return the tip's height over the pitch circle, r_a - r, as a fraction of its greatest value.

    The greatest value belongs to `greatest_radius_ratio`."""
    most = profile.pitch_radius * (greatest_radius_ratio(profile.lobes) - 1)
    return (shape.outer_radius - profile.pitch_radius) / most


def _mean(shape: Geometry) -> Float[Array, ""]:
    """Return the mean flow (m²), η r_a², per metre of rotor length and radian of rotation."""
    return shape.area_efficiency * shape.outer_radius**2


def play_of(scene: Scene, profile: Profile) -> Play:
    """Return the play in a `scene`, with all its clearances."""
    return play(profile, **clearances_of(scene))


def clearances_of(scene: Scene) -> dict[str, Float[Array, ""]]:
    """Return the arguments of `play` (m) that a `scene` determines, by name."""
    error, medium = scene.center_distance_error, scene.medium
    return {
        "clearance": scene.clearance,
        "center_distance": 2 * scene.pitch_radius + (0.0 if error is None else error),
        "radial": jnp.zeros_like(scene.clearance) if medium is None else medium.radial_allowance,
    }


def critical_ratio(heat_ratio: Float[Array, ""]) -> Float[Array, ""]:
    """Return the pressure ratio below which a nozzle is choked, (2 / (κ + 1))^(κ / (κ - 1)).

    `heat_ratio`: κ."""
    return (2 / (heat_ratio + 1)) ** (heat_ratio / (heat_ratio - 1))


def nozzle_flux(
    upstream: Float[Array, "*n"], downstream: Float[Array, "*n"], gas: Gas
) -> Float[Array, "*n"]:
    """Return the mass flow (kg/(s·m²)) per area of an ideal nozzle (Saint-Venant and Wantzel).

    `upstream`, `downstream`: pressures (Pa), the former greater; `gas`: its temperature is the one
    upstream."""
    k = gas.heat_ratio
    ratio = jnp.maximum(downstream / upstream, critical_ratio(k))
    expansion = jnp.maximum(ratio ** (2 / k) - ratio ** ((k + 1) / k), 0.0)
    # The slope of a root is infinite where there is no pressure difference.
    moving = expansion > 0
    speed = jnp.sqrt(2 * k / (k - 1) * jnp.where(moving, expansion, 1.0))
    density = upstream / jnp.sqrt(gas.gas_constant * gas.temperature)
    return jnp.where(moving, density * speed, 0.0)


def laminar_mass_flow(
    height: Float[Array, "*n"],
    length: Float[Array, "*n"],
    upstream: Float[Array, ""],
    downstream: Float[Array, ""],
    viscosity: Float[Array, ""],
    gas: Gas,
) -> Float[Array, "*n"]:
    """Return the isothermal laminar mass flow (kg/(s·m)) per width of slots.

    h³ (p1² - p2²) / (24 μ R T L): the slot's flow with the density at the mean pressure.
    `height`: h (m); `length`: L (m); `upstream`, `downstream`: p1, p2 (Pa); `viscosity`: μ (Pa·s);
    `gas`: gives R T."""
    driven = (upstream**2 - downstream**2) / (gas.gas_constant * gas.temperature)
    return height**3 * driven / (24 * viscosity * length)


def mean_free_path(
    pressure: Float[Array, ""], viscosity: Float[Array, ""], gas: Gas
) -> Float[Array, ""]:
    """Return the mean free path (m) of the molecules, (μ/p) √(π R T / 2) (Maxwell).

    `pressure`: p (Pa); `viscosity`: μ (Pa·s)."""
    return viscosity / pressure * jnp.sqrt(jnp.pi / 2 * gas.gas_constant * gas.temperature)


# Number of end faces of the two rotors.
_FACES = 4
_NODES, _WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(64))
# Nodes and weights of the Gauss-Legendre rule on [0, 1], for the gap beside a tip.
_SHARES = _NODES + 0.5


class Leakage(NamedTuple):
    """Leakage flows (m³/s) of a pair; of a gas, at suction pressure.

    `mesh`: between the rotors, mean over the rotation; `tips`: between both rotors and the housing;
    `ends`: across the end faces. `gap`: the gap over the mesh. `efficiency`: volumetric efficiency,
    1 minus leakage over theoretical flow. `knudsen`: mean free path at suction pressure divided by
    the least gap that is open; 0 for a liquid, or without an open gap."""

    mesh: Float[Array, ""]
    tips: Float[Array, ""]
    ends: Float[Array, ""]
    gap: MeshGap
    efficiency: Float[Array, ""]
    knudsen: Float[Array, ""]

    @property
    def total(self) -> Float[Array, ""]:
        """Leakage of all gaps (m³/s)."""
        return self.mesh + self.tips + self.ends


def tip_length(profile: Profile, shape: Geometry, height: Float[Array, ""]) -> Float[Array, ""]:
    """Return the length (m) of a slot with the same laminar flow as the gap at a tip of a
    `profile`.

    It is the width of the land, plus h³ ∫ dl / d³ along the addendum on both of its sides. d is the
    distance from the bore of the housing, h its least value, the clearance `height` (m)."""
    bore = shape.outer_radius + height
    sides = [one for one in profile.segments() if not one.land]
    start, stop = (jnp.stack([getattr(s, end) for s in sides]) for end in ("start", "stop"))
    turn = (stop - start)[:, None]
    nu = start[:, None] + turn * _SHARES**2  # denser near the tip, where the gap is narrow
    point, speed, _ = profile.speeds(nu)
    depth = bore - jnp.linalg.norm(profile.position(point), axis=-1)
    film = jnp.sum(2 * turn * _SHARES * _WEIGHTS * speed * (height / depth) ** 3)
    return shape.seal_width + 2 * film


def leakage(scene: Scene, medium: Medium, profile: Profile, shape: Geometry) -> Leakage:
    """Return the leakage of a pair.

    `profile`, `shape`: of the design. Where the rotors overlap (`gap.least` < 0), the flows have no
    meaning."""
    zero = jnp.zeros_like(scene.clearance)
    error = scene.center_distance_error
    center = zero if error is None else error
    normal, strain = scene.clearance, zero if medium.strain is None else medium.strain
    if scene.wear is not None:
        series, lobes = wear_series(profile, scene.wear), jnp.asarray(float(profile.lobes))
        normal = normal + jax.vmap(lambda x: series_at(series, lobes, x)[0])(rolls(profile))
    gap = mesh_gap(profile, Allowances(normal, center, medium.radial_allowance))
    mesh = _per_width(medium, gap.least, gap.length, 1)
    tips, ends = zero, zero
    heights = [jnp.min(gap.least)]
    if medium.tip_clearance is not None:
        height = medium.tip_clearance + medium.radial_allowance + strain * shape.outer_radius
        length = tip_length(profile, shape, jnp.maximum(height, 1e-9))
        tips = 2 * _per_width(medium, height, length, medium.tips)
        heights.append(height)
    if medium.end_clearance is not None:
        height = medium.end_clearance + strain * scene.length / 2
        # A strip represents an end face. It is as wide as the rotor, 2 r_a, and as long as its mean
        # chord, A / 2r_a. By Jensen's inequality, parallel strips of unequal chords leak more.
        width, ratio = 2 * shape.outer_radius, 4 * shape.outer_radius**2 / shape.area
        ends = _FACES * width * _per_width(medium, height, width / ratio, 1)
        heights.append(height)
    mesh, tips = scene.length * mesh, scene.length * tips
    ideal = theoretical_flow(shape, scene.length, scene.speed)
    knudsen = zero
    if medium.gas is not None:
        path = mean_free_path(medium.gas.inlet_pressure, medium.viscosity, medium.gas)
        each = jnp.stack(heights)
        # Nothing flows through a closed gap.
        knudsen = path / jnp.min(jnp.where(each > 0, each, jnp.inf))
    return Leakage(mesh, tips, ends, gap, 1 - (mesh + tips + ends) / ideal, knudsen)


def _per_width(medium: Medium, height, length, series: int):
    """Return the flow (m²/s) per width through `series` equal gaps in series.

    `height`, `length` (m): those of one gap; if they are arrays (n,) over roll angles, the flow is
    the mean over the rotation. The flow of a gas is that at suction pressure."""
    across = medium.pressure_difference
    length = series * jnp.where(height > 0, length, 1.0)
    height = jnp.maximum(height, 0.0)
    if medium.gas is None:
        # A slot of height h and length L lets through h³ Δp / (12 μ L).
        return jnp.mean(height**3 * across / (12 * medium.viscosity * length))
    down = medium.gas.inlet_pressure
    up = down + across
    slow = laminar_mass_flow(height, length, up, down, medium.viscosity, medium.gas)
    # Nozzles in series share the pressure ratio.
    stage = up * (down / up) ** (1 / series)
    fast = height * nozzle_flux(up, stage, medium.gas)
    density = down / (medium.gas.gas_constant * medium.gas.temperature)
    return _lesser(slow, fast) / density


def _lesser(slow, fast):
    """Return the lesser of two flows, or its mean over the rotation of flows (n,) at roll angles.

    Between roll angles, the flows are linear. A mean over the angles alone would have a gradient
    that jumps whenever the flow at one angle passes from one limit to the other."""
    if not slow.ndim:
        return jnp.minimum(slow, fast)
    excess = slow - fast
    low, high = (one(excess[1:], excess[:-1]) for one in (jnp.minimum, jnp.maximum))
    cross = (low < 0) & (high > 0)
    triangle = -(low**2) / (2 * jnp.where(cross, high - low, 1.0))
    between = jnp.where(cross, triangle, jnp.minimum((low + high) / 2, 0.0))
    # The first and the last angle stand for half a step each beyond them, too.
    ends = jnp.minimum(excess[0], 0.0) / 2 + jnp.minimum(excess[-1], 0.0) / 2
    return jnp.mean(fast) + (jnp.sum(between) + ends) / len(excess)
