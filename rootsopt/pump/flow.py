"""Flow of a pump without leakage: displacement, flow over the mesh, ripple and its lines.

Virtual work gives the flow from the torques of the gas load: Δp Q = T1 ω1 + T2 ω2. With the contact
at distance s from the pitch point, ρ1² + ρ2² = 2 (r² + s²), and the flow at speed ω is

    Q = ω L (r_a² - r² - s²).

r is the pitch radius, r_a the outer radius, L the rotor's length. `docs/pump.md` derives this and
what follows from it.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rootsopt.profiles import Geometry, Profile, quadrature_nodes

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
    changes it. The formula holds for conjugate profiles whose roll angle never turns back; for a
    measured outline it is as exact as the outline is conjugate."""
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
