"""The rotor pair compiled by Numba, with gradients by central differences (competitor b).

All code is scalar: CIC flanks in closed form, Tsitouras 5(4) with a PI controller. No array is
allocated inside the time loop. There are two contacts, as in rootsopt. `map` tabulates the gap over
roll coordinate × ε and interpolates by bicubic B-splines. `search` finds the closest approach at
every right-hand side by Newton's method from the last root. `rootsopt.contact.closest` defines
poses and signs.
"""

import dataclasses
import functools
import math
from typing import Any, Literal, NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from experiments._common.engines import (
    Design,
    Engine,
    Motion,
    Result,
    Rotor,
    Scene,
    balanced_ramp,
    balanced_step,
    gear_torque,
    impact,
    motion_of,
    ramp,
    rotor_of,
    smooth_step,
)

# Omit the check for division by zero. Floating point may be contracted and reordered, but keeps NaN
# and infinity.
_FAST = {"contract", "reassoc", "arcp", "nsz"}
_compiled = njit(error_model="numpy", fastmath=_FAST)
# Compiled code may call these functions, which remain functions of Python.
for law in (ramp, smooth_step, balanced_ramp, balanced_step, impact, gear_torque):
    register_jitable(error_model="numpy", fastmath=_FAST)(law)

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(24)

# The cheapest settings that reach a relative error of 1e-3 in mean, peak and RMS force (the last
# one also in their gradients). They were found in configs/cic_drawn.yaml on designs around the
# baseline.
# A map needs `NumbaPair.fitted` first.
SEARCH_1E3: dict[str, Any] = {"contact": "search", "rtol": 1e-5, "settle": 1}
MAP_1E3: dict[str, Any] = {
    "contact": "map",
    "rtol": 1e-5,
    "settle": 1,
    "rolls": 192,
    "relatives": 12,
}
SEARCH_GRADIENT_1E3: dict[str, Any] = {"contact": "search", "rtol": 1e-8, "settle": 2}

# Rotor geometry


@_compiled
def _half_moment(rotor, start, stop, arc):
    """Return ∫ |P|² h dl / 4 (m⁴) over a segment of the addendum and its mating dedendum."""
    r, c = rotor.radius, rotor.arc_center
    total = 0.0
    for i in range(_GAUSS_NODES.size):
        nu = start + (stop - start) * 0.5 * (1 + _GAUSS_NODES[i])
        if arc:
            turn = nu - rotor.land_end
            root = math.sqrt(r * r - (c * math.sin(turn)) ** 2)
            slide = c * math.cos(turn) - root
            s, rate, sliding = rotor.arc_radius + slide, -slide / root, root
        else:
            s = rotor.base_radius * (rotor.involute_end - nu)
            rate, sliding = 1.0, r * math.sin(rotor.alpha)
        convex = (r * r + 2 * s * sliding + s * s) * (sliding + s) * (sliding * rate + s)
        concave = (r * r - 2 * s * sliding + s * s) * (sliding - s)
        concave *= (sliding - 2 * s) * rate + s
        total += _GAUSS_WEIGHTS[i] * (convex + concave)
    return total * (stop - start) / 8


@_compiled
def polar_area_moment(rotor):
    """Return ∫ r² dA (m⁴) of a rotor about its axis, by Green's theorem; exact to rounding."""
    reach = rotor.arc_radius + rotor.arc_center - rotor.radius
    lands = (rotor.radius + reach) ** 4 + (rotor.radius - reach) ** 4
    total = lands * rotor.land_end / 4
    total += _half_moment(rotor, rotor.land_end, rotor.arc_end, True)
    total += _half_moment(rotor, rotor.arc_end, rotor.involute_end, False)
    return 2 * rotor.lobes * total


# Closest approach

_ARC_NODES = 32
_EDGE_NODES = 12
_INVOLUTE_NODES = 12


@_compiled
def _mate(rotor, normal):
    """Return facing angle (rad) and lever (m) of rotor 2's flank point at the normal angle ν2.

    Each value is followed by its derivative with respect to ν2."""
    if normal > rotor.arc_end:
        return math.pi - 2 * rotor.alpha - normal, -1.0, rotor.base_radius, 0.0
    turn = normal - rotor.land_end
    lever = rotor.arc_center * math.sin(turn)
    rise = rotor.arc_center * math.cos(turn)
    facing = 2 * math.asin(lever / rotor.radius) - normal
    slope = 2 * rise / math.sqrt(rotor.radius**2 - lever * lever) - 1
    return facing, slope, lever, rise


@_compiled
def _offset(rotor, normal, roll, relative):
    """Return the tangential offset T (m) at ν2 and dT/dν2."""
    facing, turning, lever2, rise2 = _mate(rotor, normal)
    normal1 = facing + 2 * roll
    if normal1 > rotor.arc_end:
        lever1, rise1 = rotor.base_radius, 0.0
    elif normal1 > rotor.land_end:
        lever1 = rotor.arc_center * math.sin(normal1 - rotor.land_end)
        rise1 = rotor.arc_center * math.cos(normal1 - rotor.land_end)
    else:
        lever1, rise1 = 0.0, 0.0
    angle = facing + roll - relative / 2
    reach = 2 * rotor.radius
    offset = reach * math.sin(angle) - lever1 - lever2
    return offset, (reach * math.cos(angle) - rise1) * turning - rise2


@_compiled
def _contact_at(rotor, normal, roll, relative):
    """Return the gap (m) and both levers (m) at rotor 2's flank point with the normal angle ν2."""
    facing, _, lever2, _ = _mate(rotor, normal)
    reach = rotor.radius * math.sin(rotor.alpha)
    if normal > rotor.arc_end:
        support = reach - rotor.base_radius * (rotor.involute_end - normal)
    else:
        # r sin ψ + s₂ with s₂ = -s: twice r sin ψ minus the addendum's own support.
        height = math.sqrt(rotor.radius**2 - lever2 * lever2)
        own = rotor.arc_center * math.cos(normal - rotor.land_end) + rotor.arc_radius
        support = 2 * height - own
    normal1 = facing + 2 * roll
    if normal1 > rotor.arc_end:
        lever1 = rotor.base_radius
        support += reach + rotor.base_radius * (rotor.involute_end - normal1)
    else:
        turn = max(normal1 - rotor.land_end, 0.0)
        lever1 = rotor.arc_center * math.sin(turn)
        support += rotor.arc_center * math.cos(turn) + rotor.arc_radius
    gap = 2 * rotor.radius * math.cos(facing + roll - relative / 2) - support
    return gap, lever1, lever2


@_compiled
def _newton(rotor, roll, relative, low, high, guess):
    """Return the root in (low, high) at which the tangential offset T falls through zero.

    Newton's method runs inside a shrinking bracket. The result is NaN if T does not fall there.
    """
    normal = guess
    for _ in range(60):
        offset, slope = _offset(rotor, normal, roll, relative)
        if offset >= 0:
            low = normal
        else:
            high = normal
        step = -offset / slope if slope < 0 else math.inf
        new = normal + step
        if not low <= new <= high:
            new = 0.5 * (low + high)
            step = new - normal
        normal = new
        if abs(step) < 1e-7:
            return normal if slope < 0 else math.nan
    return math.nan


class Search(NamedTuple):
    """Data of the search for the closest approach.

    `nodes` (n, 5) on rotor 2's flank: ν2, facing angle, its sine and cosine, lever (m); `root`
    (1,): the last root ν2, at which the next search starts.
    """

    nodes: NDArray[np.float64]
    root: NDArray[np.float64]


@_compiled
def search_of(rotor):
    """Return the search data of a rotor, with the middle of the flank as start."""
    involute = rotor.involute_end - rotor.arc_end
    nodes = np.empty((_EDGE_NODES + _ARC_NODES + _INVOLUTE_NODES + 1, 5))
    for place in range(nodes.shape[0]):
        # Next to the land, where the contact starts, the distance of nodes halves each time.
        near = 0 < place <= _EDGE_NODES
        i = 0.5 ** (_EDGE_NODES + 1 - place) if near else 1.0 * max(place - _EDGE_NODES, 0)
        if i < _ARC_NODES:
            normal = rotor.land_end + (rotor.arc_end - rotor.land_end) * i / _ARC_NODES
        else:
            # Extend the involute by half: rotor 2 may touch a little beyond its pitch point.
            normal = rotor.arc_end + 1.5 * involute * (i - _ARC_NODES) / _INVOLUTE_NODES
        facing, _, lever, _ = _mate(rotor, normal)
        nodes[place] = normal, facing, math.sin(facing), math.cos(facing), lever
    return nodes, np.array([rotor.arc_end])


@_compiled
def _scan(rotor, nodes, roll, relative):
    """Return the falling root of T with the least gap, bracketed by nodes; NaN without a root."""
    best, depth = math.nan, math.inf
    # Use sines of sums, so that a node needs no trigonometry.
    sin, cos = math.sin(roll - relative / 2), math.cos(roll - relative / 2)
    arc_sin = rotor.arc_center * math.sin(2 * roll - rotor.land_end)
    arc_cos = rotor.arc_center * math.cos(2 * roll - rotor.land_end)
    reach = 2 * rotor.radius
    before = -1.0
    for i in range(nodes.shape[0]):
        normal1 = nodes[i, 1] + 2 * roll
        lever1 = nodes[i, 2] * arc_cos + nodes[i, 3] * arc_sin
        if normal1 > rotor.arc_end:
            lever1 = rotor.base_radius
        elif normal1 < rotor.land_end:
            lever1 = 0.0
        value = reach * (nodes[i, 2] * cos + nodes[i, 3] * sin) - lever1 - nodes[i, 4]
        if before >= 0 and value < 0:
            low, high = nodes[i - 1, 0], nodes[i, 0]
            guess = low + (high - low) * before / (before - value)
            root = _newton(rotor, roll, relative, low, high, guess)
            gap = _contact_at(rotor, root, roll, relative)[0]
            if gap < depth:
                best, depth = root, gap
        before = value
    return best


@_compiled
def closest(rotor, search, roll, relative):
    """Return the gap (m), both levers (m) and whether the flanks have a common normal.

    `roll`: roll coordinate (rad); `relative`: ε (rad), at most 0.
    """
    half = rotor.half_pitch
    centered = roll - half
    centered -= 4 * half * math.floor(centered / (4 * half) + 0.5)
    folded = half - abs(centered)
    far = rotor.radius
    # Contact starts before the tip passes the line of centres, by about √|ε|.
    if folded < -2 * math.sqrt(-min(relative, 0.0)) - 0.02:
        return far, 0.0, 0.0, False
    last = search.nodes[-1, 0]
    root = math.nan
    # There is one root, with two exceptions: at the hand-over, and while a whole arc meshes at one
    # instant, there can be two roots or none.
    if folded > rotor.land_end + 0.01 - relative:
        root = _newton(rotor, folded, relative, rotor.land_end, last, search.root[0])
    if not rotor.land_end < root < last:
        root = _scan(rotor, search.nodes, folded, relative)
    if math.isnan(root):
        return far, 0.0, 0.0, False
    search.root[0] = root
    gap, lever1, lever2 = _contact_at(rotor, root, folded, relative)
    if centered > 0:
        return gap, lever2, lever1, True
    return gap, lever1, lever2, True


# Map of the gap


class Table(NamedTuple):
    """Contact map: B-spline coefficients of the gap (m) over roll coordinate × ε (rad)."""

    coefficients: NDArray[np.float64]
    first_roll: float
    roll_step: float
    deepest: float
    relative_step: float


MARGIN = 3
NO_TABLE = Table(np.zeros((4, 4)), 0.0, 1.0, 0.0, 1.0)


@functools.cache
def _through(n: int) -> NDArray[np.float64]:
    """Return the matrix (n + 2, n) from values at n uniform knots to cubic B-spline coefficients.

    The ends are not-a-knot: the fourth difference of five coefficients is 0 there."""
    rows = np.zeros((n + 2, n + 2))
    rows[0, :5] = rows[-1, -5:] = 1, -4, 6, -4, 1
    for k, weight in enumerate((1 / 6, 2 / 3, 1 / 6)):
        rows[1:-1, k : n + k] += weight * np.eye(n)
    return np.asarray(np.linalg.inv(rows)[:, 1:-1], np.float64, order="C")


def table_of(rotor: Rotor, deepest: float, rolls: int, relatives: int) -> Table:
    """Return the contact map down to ε = `deepest` < 0 from `rolls` × `relatives` points."""
    values, *places = tabulate(rotor, deepest, rolls, relatives)
    return Table(_through(rolls) @ values @ _through(relatives).T, *places)


@_compiled
def tabulate(rotor, deepest, rolls, relatives):
    """Tabulate the gap down to ε = `deepest` < 0 on `rolls` × `relatives` points."""
    half = rotor.half_pitch
    first = -min(0.9 * half, 2 * math.sqrt(-deepest) + 0.02)
    roll_step = (half - first) / (rolls - 1 - MARGIN)
    relative_step = -deepest / (relatives - 1 - MARGIN)
    values = np.empty((rolls, relatives))
    search = Search(*search_of(rotor))
    for i in range(rolls):
        roll = first + roll_step * i
        for j in range(relatives):
            relative = deepest + relative_step * j
            gap, _, _, found = closest(rotor, search, roll, relative)
            if not found:
                # The land is passing: extend the gap at its end by a parabola.
                gap = rotor.radius * (roll - rotor.land_end - relative / 2) ** 2
            values[i, j] = gap
    return values, first, roll_step, deepest, relative_step


@_compiled
def _weights(t):
    """Return the weights of the four coefficients around a cell, and the derivatives of the
    weights.

    `t`: position inside the cell, 0 to 1."""
    u = 1 - t
    early, late = (3 * t - 6) * t * t / 6 + 2 / 3, (3 * u - 6) * u * u / 6 + 2 / 3
    value = u * u * u / 6, early, late, t * t * t / 6
    return value, (-u * u / 2, (1.5 * t - 2) * t, (2 - 1.5 * u) * u, t * t / 2)


@_compiled
def mapped(half, table, roll, relative):
    """Return gap (m) and both levers (m) from the table; `half` is half the lobe pitch angle."""
    centered = roll - half
    centered -= 4 * half * math.floor(centered / (4 * half) + 0.5)
    x = (half - abs(centered) - table.first_roll) / table.roll_step
    if x <= 0:
        return 1.0, 0.0, 0.0
    rows, columns = table.coefficients.shape
    i = min(int(x), rows - 4)
    e = (relative - table.deepest) / table.relative_step
    held = min(max(e, 0.0), columns - 3 - 1e-9)
    j = int(held)
    (w0, w1, w2, w3), (d0, d1, d2, d3) = _weights(x - i)
    (v0, v1, v2, v3), (s0, s1, s2, s3) = _weights(held - j)
    gap = by_x = by_e = 0.0
    for k, v, s in ((0, v0, s0), (1, v1, s1), (2, v2, s2), (3, v3, s3)):
        a, b = table.coefficients[i, j + k], table.coefficients[i + 1, j + k]
        c, d = table.coefficients[i + 2, j + k], table.coefficients[i + 3, j + k]
        column = w0 * a + w1 * b + w2 * c + w3 * d
        gap += v * column
        by_e += s * column
        by_x += v * (d0 * a + d1 * b + d2 * c + d3 * d)
    by_e /= table.relative_step
    # Beyond the table, extend the gap linearly in ε.
    gap += by_e * (e - held) * table.relative_step
    by_x /= 2 * table.roll_step
    if centered > 0:
        by_x = -by_x
    return gap, by_e + by_x, by_e - by_x


# Equation of motion


@_compiled
def _slope(rotor, motion, table, search, tau, angle, rate):
    """Return scaled acceleration and contact force (N) at the time τ in a scaled state."""
    relative = motion.angle_scale * angle
    speed2 = motion.angle_scale * rate / motion.period
    side = 1.0 if relative < 0 else -1.0
    roll = -side * (motion.turn * tau + relative / 2)
    if table.coefficients.shape[0] > 4:
        gap, lever1, lever2 = mapped(rotor.half_pitch, table, roll, side * relative)
    else:
        gap, lever1, lever2, _ = closest(rotor, search, roll, side * relative)
    scene = motion.scene
    closing = side * (lever1 * scene.speed - lever2 * (scene.speed + speed2))
    force = impact(scene, -gap - scene.clearance, closing)
    torque = side * lever2 * force - scene.load_torque - gear_torque(motion, relative, speed2)
    return torque * motion.agility, force


# Tsitouras 5(4), first same as last

_C = np.array([0.0, 0.161, 0.327, 0.9, 0.9800255409045097, 1.0, 1.0])
_A = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.161, 0.0, 0.0, 0.0, 0.0, 0.0],
        [-0.008480655492356989, 0.335480655492357, 0.0, 0.0, 0.0, 0.0],
        [2.8971530571054935, -6.359448489975075, 4.3622954328695815, 0.0, 0.0, 0.0],
        [5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525, 0, 0],
        [
            5.86145544294642,
            -12.92096931784711,
            8.159367898576159,
            -0.071584973281401,
            -0.028269050394068383,
            0.0,
        ],
        [
            0.09646076681806523,
            0.01,
            0.4798896504144996,
            1.379008574103742,
            -3.290069515436081,
            2.324710524099774,
        ],
    ]
)
_ERROR = np.array(
    [
        0.0017800110522257773,
        0.0008164344596567463,
        -0.007880878010261995,
        0.1447110071732629,
        -0.5823571654525552,
        0.45808210592918686,
        -1 / 66,
    ]
)
_STEPS_PER_PERIOD = 100_000


@_compiled
def _between(t, value, k, h):
    """Return the solution at the fraction `t` of a step, by Tsitouras' interpolant.

    The step has the length `h`, starts at `value` and has the stage slopes `k`.
    """
    q = t * t
    u = t * (t - 1.3299890189751412) * (q - 1.4364028541716351 * t + 0.7139816917074209)
    total = -1.0530884977290216 * u * k[0]
    total += 0.1017 * q * (q - 2.1966568338249754 * t + 1.2949852507374631) * k[1]
    total += 2.490627285651253 * q * (q - 2.3853564547206166 * t + 1.578034682080925) * k[2]
    total -= 16.548102889244902 * (t - 1.2171292729553325) * (t - 0.6162040603780009) * q * k[3]
    total += 47.37952196281928 * (t - 1.2030712083723627) * (t - 0.6580472926535474) * q * k[4]
    total -= 34.87065786149661 * (t - 1.2) * (t - 0.6666666666666666) * q * k[5]
    total += 2.5 * (t - 1) * (t - 0.6) * q * k[6]
    return value + h * total


# Nine or more parameters: compiled code passes the scalars of a state one by one, not in a tuple.
@_compiled
def _peak_in_step(rotor, motion, table, search, tau, h, angle, rate, ks):
    """Return the largest contact force (N) within a step: eight samples, then golden section."""

    def force(t):
        a, b = _between(t, angle, ks[0], h), _between(t, rate, ks[1], h)
        return _slope(rotor, motion, table, search, tau + t * h, a, b)[1]

    best, place = -1.0, 0.0
    for i in range(9):
        value = force(i / 8)
        if value > best:
            best, place = value, i / 8
    low, high = max(place - 1 / 8, 0.0), min(place + 1 / 8, 1.0)
    share = (math.sqrt(5.0) - 1) / 2
    left, right = high - share * (high - low), low + share * (high - low)
    f_left, f_right = force(left), force(right)
    for _ in range(24):
        if f_left > f_right:
            high, right, f_right = right, left, f_left
            left = high - share * (high - low)
            f_left = force(left)
        else:
            low, left, f_left = left, right, f_right
            right = low + share * (high - low)
            f_right = force(right)
    return max(best, f_left, f_right)


# Nine or more parameters: compiled code passes the scalars of a state one by one, not in a tuple.
@_compiled
def integrate(rotor, motion, table, search, start, stop, angle, rate, rtol, statistics):
    """Integrate the scaled state from τ = `start` to `stop`.

    Returns the state with the integrals of force and force² (scaled; error-controlled with the
    state if `statistics`), the peak force (N), and the largest |ε| (scaled).
    """
    ks = np.empty((2, 7))
    fs = np.empty(7)
    tau, h, previous = start, 1e-3, 1.0
    total = square = peak = reached = 0.0
    steps = 0
    limit = motion.angle_limit / motion.angle_scale
    ks[0, 0] = rate
    ks[1, 0], fs[0] = _slope(rotor, motion, table, search, tau, angle, rate)
    while tau < stop and steps < _STEPS_PER_PERIOD * (stop - start) and abs(angle) < limit:
        steps += 1
        h = min(h, stop - tau)
        a, b = angle, rate
        for i in range(1, 7):
            a, b = 0.0, 0.0
            for j in range(i):
                a += _A[i, j] * ks[0, j]
                b += _A[i, j] * ks[1, j]
            a, b = angle + h * a, rate + h * b
            ks[0, i] = b
            ks[1, i], fs[i] = _slope(rotor, motion, table, search, tau + _C[i] * h, a, b)
        e_angle = e_rate = e_total = e_square = d_total = d_square = 0.0
        for i in range(7):
            e_angle += _ERROR[i] * ks[0, i]
            e_rate += _ERROR[i] * ks[1, i]
            force = fs[i] / motion.force_scale
            e_total += _ERROR[i] * force
            e_square += _ERROR[i] * force * force
            if i < 6:
                d_total += _A[6, i] * force
                d_square += _A[6, i] * force * force
        d_total, d_square = total + h * d_total, square + h * d_square
        error = (e_angle / (1 + max(abs(angle), abs(a)))) ** 2
        error += (e_rate / (1 + max(abs(rate), abs(b)))) ** 2
        parts = 2
        if statistics:
            error += (e_total / (1 + max(total, d_total))) ** 2
            error += (e_square / (1 + max(square, d_square))) ** 2
            parts = 4
        error = max(h / rtol * math.sqrt(error / parts), 1e-10)
        # PI controller of Hairer & Wanner, with exponents for order 5.
        factor = 0.9 * error**-0.17
        if not error <= 1:
            h *= max(0.2, factor) if error > 1 else 0.1
            continue
        factor = min(max(factor * previous**0.04, 0.2), 10.0)
        if statistics:
            if fs.max() > 0.8 * peak:
                found = _peak_in_step(rotor, motion, table, search, tau, h, angle, rate, ks)
                peak = max(peak, found)
            reached = max(reached, abs(a))
        last = tau + h >= stop
        tau = stop if last else tau + h
        angle, rate, total, square = a, b, d_total, d_square
        ks[0, 0], ks[1, 0], fs[0] = ks[0, 6], ks[1, 6], fs[6]
        previous = max(error, 1e-4)
        h *= factor
    if tau < stop:
        total = square = peak = math.nan
        reached = math.inf
    return angle, rate, total, square, peak, reached


@_compiled
def _run(rotor, motion, table, settle, window, rtol):
    """Integrate the transient, then return statistics over the window."""
    search = Search(*search_of(rotor))
    angle, rate, _, _, _, _ = integrate(
        rotor, motion, table, search, 0.0, float(settle), 0.0, 0.0, rtol, False
    )
    # Rotor and flanks repeat with the mesh period.
    _, _, total, square, peak, reached = integrate(
        rotor, motion, table, search, 0.0, float(window), angle, rate, rtol, True
    )
    mean = total / window * motion.force_scale
    rms = math.sqrt(square / window) * motion.force_scale
    return mean, peak, rms, reached * motion.angle_scale


@dataclasses.dataclass(frozen=True)
class NumbaPair(Engine):
    """Compiled simulator of a scene.

    `contact`: map or search; `rtol`: relative tolerance, also absolute tolerance of the scaled
    state; `settle`, `window`: mesh periods before and in the window; `rolls`, `relatives`: points
    of the map along both axes (at least 8); `deepest`: lowest ε of the map (rad, < 0), by default
    for ten times the static contact force. A map that the motion leaves is built again, deeper.
    `fitted` builds a map that is deep enough from the start.
    """

    scene: Scene
    contact: Literal["map", "search"] = "map"
    rtol: float = 1e-8
    settle: int = 4
    window: int = 1
    rolls: int = 384
    relatives: int = 16
    deepest: float | None = None

    def simulate(self, design: Design) -> Result:
        rotor = rotor_of(self.scene, design)
        motion = motion_of(self.scene, polar_area_moment(rotor))
        if self.contact == "search":
            return self._run(rotor, motion, NO_TABLE)
        deepest = self.deepest or self._expected(motion)
        for _ in range(5):
            table = table_of(rotor, deepest, self.rolls, self.relatives)
            result = self._run(rotor, motion, table)
            if not result.reached > -deepest:
                break
            deepest = max(-1.3 * result.reached, 2 * deepest)
        return result

    def fitted(self, design: Design) -> "NumbaPair":
        """Return another simulator with a map just deep enough for the motion of `design`."""
        reached = self.simulate(design).reached
        return dataclasses.replace(self, deepest=-1.3 * reached)

    def _run(self, rotor: Rotor, motion: Motion, table: Table) -> Result:
        return Result(*_run(rotor, motion, table, self.settle, self.window, self.rtol))

    def _expected(self, motion: Motion) -> float:
        scene = self.scene
        depth = (20 * motion.force_scale / scene.stiffness) ** (1 / scene.exponent)
        play = scene.clearance / scene.pitch_radius + scene.half_backlash
        return -min(1.3 * play + 1.5 * depth / scene.pitch_radius, motion.angle_limit)
