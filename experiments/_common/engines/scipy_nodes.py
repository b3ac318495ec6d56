"""SciPy's `solve_ivp` with a node-to-segment contact in NumPy (competitor a).

Contact is the paper's Eq. 9: nodes of rotor 1's flank against segments of the mating flank of
rotor 2. Segments bulge with the flank's curvature, which is as fast as straight ones and far more
accurate. Only one flank pair can touch at a pose. The search covers a window around the last
contact; a coarse search along the whole flank finds a contact elsewhere. Gradients are central
differences. `rootsopt.contact.closest` defines poses and signs. Points are complex numbers.
"""

import cmath
import dataclasses
import itertools
import math
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from experiments._common.engines import (
    Design,
    Engine,
    Motion,
    Result,
    Rotor,
    Scene,
    gear_torque,
    impact,
    motion_of,
    rotor_of,
)

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(24)

# The cheapest settings with a relative error of 1e-3 in mean, peak and RMS force. They were found
# in configs/cic_drawn.yaml on designs around the baseline.
NODES_1E3: dict[str, Any] = {"method": "LSODA", "nodes": 800, "rtol": 3e-5, "settle": 1}
DOP853_1E3: dict[str, Any] = {"method": "DOP853", "nodes": 800, "rtol": 1e-4, "settle": 1}

# Rotor geometry


@dataclasses.dataclass(frozen=True)
class _Addendum:
    """Points of the addendum at given normal angles.

    Fields: roll angle β, r sin ψ, r cos ψ, distance s from the pitch point, arc length per normal
    angle on the addendum, and arc length per normal angle on the mating dedendum.
    """

    beta: NDArray[np.float64]
    height: NDArray[np.float64]
    lever: NDArray[np.float64]
    s: NDArray[np.float64]
    speed: NDArray[np.float64]
    mate_speed: NDArray[np.float64]


def _addendum(rotor: Rotor, normal: NDArray[np.float64]) -> _Addendum:
    r, c = rotor.radius, rotor.arc_center
    turn = np.clip(normal, rotor.land_end, rotor.arc_end) - rotor.land_end
    arc = normal < rotor.arc_end
    lever = np.where(arc, c * np.sin(turn), rotor.base_radius)
    height = np.sqrt(r * r - lever * lever)
    beta = normal - np.arcsin(lever / r)
    slide = c * np.cos(turn) - height
    s = np.where(arc, rotor.arc_radius + slide, rotor.base_radius * (rotor.involute_end - normal))
    rate = np.where(arc, -slide / height, 1.0)
    return _Addendum(beta, height, lever, s, height * rate + s, (height - 2 * s) * rate + s)


def polar_area_moment(rotor: Rotor) -> float:
    """Return ∫ r² dA (m⁴) of a rotor about its axis, by Green's theorem; exact to rounding."""
    r = rotor.radius
    reach = rotor.arc_radius + rotor.arc_center - r
    total = ((r + reach) ** 4 + (r - reach) ** 4) * rotor.land_end / 4
    ends = rotor.land_end, rotor.arc_end, rotor.involute_end
    for start, stop in itertools.pairwise(ends):
        point = _addendum(rotor, start + (stop - start) * (1 + _GAUSS_NODES) / 2)
        for s, speed in ((point.s, point.speed), (-point.s, point.mate_speed)):
            square = r * r + 2 * s * point.height + s * s
            total += np.sum(square * (point.height + s) * speed * _GAUSS_WEIGHTS) * (
                (stop - start) / 8
            )
    return float(2 * rotor.lobes * total)


def _flank(rotor: Rotor, nodes: int) -> NDArray[np.complex128]:
    """Return points of the flank (m), from the end of the tip land to the end of the root land.

    There are about `nodes` points, an odd number. The k-th point from one end meshes with the k-th
    point from the other end of the mating flank.
    """
    start, stop = rotor.land_end, rotor.involute_end
    fine = np.linspace(start, stop, 513)
    point = _addendum(rotor, (fine[1:] + fine[:-1]) / 2)
    # Make it as dense as the longer of the two mating elements needs.
    speed = np.maximum(np.abs(point.speed), np.abs(point.mate_speed))
    length = np.concatenate([[0.0], np.cumsum(speed)])
    even = np.linspace(0, length[-1], nodes // 2 + 1)
    normal = np.interp(even, length, fine)
    point = _addendum(rotor, normal)
    r = rotor.radius
    unit = (point.height + 1j * point.lever) / r
    tip = np.exp(1j * point.beta) * (r + point.s * unit)
    root = np.exp(1j * (math.pi / rotor.lobes - point.beta)) * (r - point.s * unit)
    return np.concatenate([tip, root[-2::-1]])


# Contact

# Number of nodes in the window on either side of the last contact.
_WINDOW = 8

# Number of nodes of the coarse search along the whole flank.
_COARSE = 64

# Number of segments by which the window of segments exceeds the window of nodes on either side.
# The contact may slide by this distance between two calls.
_PAD = 4


class _Segments(NamedTuple):
    """Segments of the flank.

    Fields: first corner, conjugate of the unit direction, length (m), and the flank's curvature
    there (1/m, positive to the left; 0 for straight segments).
    """

    corners: NDArray[np.complex128]
    towards: NDArray[np.complex128]
    lengths: NDArray[np.float64]
    bends: NDArray[np.float64]

    def part(self, first: int, stop: int) -> "_Segments":
        corners, towards, lengths, bends = self
        part = slice(first, stop)
        return _Segments(corners[part], towards[part], lengths[part], bends[part])


def _segments(corners: NDArray[np.complex128], curved: bool) -> _Segments:
    chords = np.diff(corners)
    lengths = np.abs(chords)
    bends = np.zeros(len(chords))
    if curved:
        # A segment that leads from one arc into another takes the mean curvature of both.
        turns = np.angle(chords[1:] * np.conj(chords[:-1])) * 2 / (lengths[1:] + lengths[:-1])
        bends = (np.append(turns, turns[-1]) + np.append(turns[0], turns)) / 2
    towards = np.asarray(np.conj(chords) / lengths, dtype=np.complex128)
    return _Segments(corners[:-1], towards, lengths, bends)


class NodeContact:
    """Gap between a flank of rotor 1 and the mating flank of rotor 2, each of about `nodes` nodes.

    Eq. 9 has straight segments and takes the gap of the deepest node. Here segments bulge by the
    flank's curvature, and the deepest point is the vertex of the parabola through three nodes: the
    gap is more accurate and smoother.
    """

    def __init__(self, rotor: Rotor, nodes: int):
        self.rotor = rotor
        flank = _flank(rotor, nodes)
        # Rotor 1 or rotor 2 may touch with the end of its tip land, never with its root land.
        self.land = round(nodes * rotor.land_end)
        turns = np.linspace(0, rotor.land_end, self.land, endpoint=False)
        self.points = np.concatenate([abs(flank[0]) * np.exp(1j * turns), flank])
        self.segments = _segments(self.points[::-1], True)
        self.stride = max(len(self.points) // _COARSE, 1)
        self.coarse = _segments(self.points[:: -self.stride], False)
        self.mates = len(self.points) - self.land
        self.last: tuple[int, int] | None = None

    def __call__(self, roll: float, relative: float) -> tuple[float, float, float]:
        """Return gap (m, negative: penetration) and levers (m) about rotor 1 and rotor 2."""
        half = self.rotor.half_pitch
        centered = (roll + half) % (4 * half) - 2 * half
        # Contact starts before the tip passes the line of centres, by about √|ε|.
        if abs(centered) > half + 2 * math.sqrt(max(-relative, 0.0)) + 0.02:
            return 1.0, 0.0, 0.0
        roll = centered + half
        phi1, phi2 = -roll - relative / 2, -roll + relative / 2
        # Rotor 1's nodes in rotor 2's frame, mirrored so that both flanks have one direction.
        onto = cmath.exp(1j * (phi2 + 2 * half))
        return self._search(2 * self.rotor.radius * onto, onto * cmath.exp(1j * phi1))

    def _search(self, shift: complex, turn: complex) -> tuple[float, float, float]:
        """Return gap (m) and both levers (m).

        Search near the last contact. If the contact is not there, search the whole flank, with
        windows that become narrower.
        """
        if self.last is not None:
            window = self._window(shift, turn, *self.last, 1)
            # On a land, or at an end of the window, the flank may be deeper elsewhere.
            on_flank = window.node >= self.land and window.segment(window.i) < self.mates
            if on_flank and window.gap < 0 and window.enclosed:
                return self._contact(window, shift)
        stride = self.stride
        gaps, nearest, _ = _signed_distances(shift - turn * self.points[::stride], self.coarse)
        i = int(gaps.argmin())
        node, segment = i * stride, int(nearest[i]) * stride
        while True:
            stride = max(stride // (_WINDOW // 2), 1)
            window = self._window(shift, turn, node, segment, stride)
            node, segment = window.node, window.segment(window.i)
            if stride == 1:
                return self._contact(window, shift)

    def _window(
        self, shift: complex, turn: complex, node: int, segment: int, stride: int
    ) -> "_Window":
        """Return every `stride`-th node around `node` and the segments around `segment`."""
        reach = _WINDOW * stride
        low = max(node - reach, 0)
        first = max(segment - reach - _PAD * stride, 0)
        nodes = shift - turn * self.points[low : node + reach + 1 : stride]
        segments = self.segments.part(first, segment + reach + _PAD * stride + 1)
        gaps, nearest, feet = _signed_distances(nodes, segments)
        i = int(gaps.argmin())
        return _Window(low + i * stride, i, first, nodes, gaps, nearest, feet)

    def _contact(self, window: "_Window", shift: complex) -> tuple[float, float, float]:
        """Return gap (m) and both levers (m) at the deepest point of a window, and store the point
        for the next search."""
        i, gap = window.i, window.gap
        if not gap < 1.0:
            self.last = None
            return 1.0, 0.0, 0.0
        self.last = window.node, window.segment(i)
        lever1, lever2 = self._levers(window, i, shift)
        if window.enclosed:
            left, right = window.gaps[i - 1 : i + 2 : 2].tolist()
            bend = left - 2 * gap + right
            if bend > 0:
                aside = (left - right) / (2 * bend)
                gap -= bend * aside * aside / 2
                other1, other2 = self._levers(window, i + (1 if aside > 0 else -1), shift)
                lever1 += abs(aside) * (other1 - lever1)
                lever2 += abs(aside) * (other2 - lever2)
        return gap, lever1, lever2

    def _levers(self, window: "_Window", i: int, shift: complex) -> tuple[float, float]:
        """Return both levers (m): the distances from the axes to the normal at the foot of node
        i."""
        segment, point = window.segment(i), complex(window.nodes[i])
        towards = complex(self.segments.towards[segment])
        middle = float(self.segments.lengths[segment]) / 2
        lean = float(self.segments.bends[segment]) * (float(window.feet[i]) - middle)
        towards *= complex(math.cos(lean), -math.sin(lean))
        return ((shift - point) * towards).real, (point * towards).real


class _Window(NamedTuple):
    """Nodes of a window, seen from rotor 2.

    Fields: gaps of the nodes (m), the segment nearest to each node (counted from `first`), the foot
    of each node on its segment (m), the index i of the deepest node in the window, and its number
    `node` on the flank.
    """

    node: int
    i: int
    first: int
    nodes: NDArray[np.complex128]
    gaps: NDArray[np.float64]
    nearest: NDArray[np.intp]
    feet: NDArray[np.float64]

    @property
    def gap(self) -> float:
        return float(self.gaps[self.i])

    @property
    def enclosed(self) -> bool:
        """Return whether the deepest node has neighbours that are less deep."""
        around = self.gaps[max(self.i - 1, 0) : self.i + 2]
        return len(around) == 3 and bool(around.max() < 1.0)

    def segment(self, i: int) -> int:
        return self.first + int(self.nearest[i])


def _signed_distances(nodes, segments):
    """Return, for each node, the signed distance to the nearest segment, the segment, and the foot.

    The distance is inf for a node whose foot would lie beyond either end of the segments.
    """
    local = (nodes[:, None] - segments.corners) * segments.towards
    along, height = local.real, local.imag
    feet = np.minimum(np.maximum(along, 0.0), segments.lengths)
    squares = (along - feet) ** 2 + height * height
    nearest = squares.argmin(axis=1)
    at = np.arange(len(nearest)), nearest
    foot = feet[at]
    gaps = np.copysign(np.sqrt(squares[at]), height[at])
    gaps += 0.5 * segments.bends[nearest] * foot * (segments.lengths[nearest] - foot)
    off = along[at] - foot
    outside = ((nearest == 0) & (off < 0)) | ((nearest == squares.shape[1] - 1) & (off > 0))
    gaps[outside] = np.inf
    return gaps, nearest, foot


# Equation of motion


class _Equation:
    """Right-hand side of the equation of motion in scaled states.

    The state may be followed by the integrals of force and force² (scaled)."""

    def __init__(self, motion: Motion, contact: NodeContact):
        self.motion, self.contact = motion, contact

    def __call__(self, tau: float, y: NDArray[np.float64]) -> list[float]:
        angle, rate = y[:2].tolist()
        acceleration, force = self.slope(tau, angle, rate)
        if len(y) == 2:
            return [rate, acceleration]
        share = force / self.motion.force_scale
        return [rate, acceleration, share, share * share]

    def slope(self, tau: float, angle: float, rate: float) -> tuple[float, float]:
        """Return scaled acceleration and contact force (N)."""
        motion, scene = self.motion, self.motion.scene
        relative = motion.angle_scale * angle
        speed2 = motion.angle_scale * rate / motion.period
        if abs(relative) >= motion.angle_limit:
            return 0.0, 0.0
        side = 1.0 if relative < 0 else -1.0
        roll = -side * (motion.turn * tau + relative / 2)
        gap, lever1, lever2 = self.contact(roll, side * relative)
        closing = side * (lever1 * scene.speed - lever2 * (scene.speed + speed2))
        force = impact(scene, -gap - scene.clearance, closing)
        torque = side * lever2 * force - scene.load_torque - gear_torque(motion, relative, speed2)
        return torque * motion.agility, force


@dataclasses.dataclass(frozen=True)
class ScipyNodes(Engine):
    """Simulator of a scene with SciPy.

    `nodes` (per flank): see `NodeContact`; `method` of `solve_ivp`; `rtol`: relative
    tolerance, also absolute tolerance of the scaled state; `settle`, `window`: mesh periods before
    and in the window; `max_step`: longest step (mesh periods).
    """

    scene: Scene
    nodes: int = 800
    method: Literal["LSODA", "DOP853", "RK45"] = "LSODA"
    rtol: float = 1e-5
    settle: int = 2
    window: int = 1
    max_step: float = 0.1

    def simulate(self, design: Design) -> Result:
        rotor = rotor_of(self.scene, design)
        motion = motion_of(self.scene, polar_area_moment(rotor))
        equation = _Equation(motion, NodeContact(rotor, self.nodes))
        before = self._solve(equation, self.settle, np.zeros(2), False)
        start = np.append(before.y[:, -1], [0.0, 0.0])
        # Rotor and flanks repeat with the mesh period.
        run = self._solve(equation, self.window, start, True)
        total, square = run.y[2:, -1] / self.window
        return Result(
            mean=float(total) * motion.force_scale,
            peak=_peak(equation, run),
            rms=math.sqrt(square) * motion.force_scale,
            reached=float(np.abs(run.y[0]).max()) * motion.angle_scale,
        )

    def _solve(self, equation, periods, start, dense):
        run = solve_ivp(
            equation,
            (0.0, float(periods)),
            start,
            method=self.method,
            rtol=self.rtol,
            atol=self.rtol,
            first_step=1e-3,
            max_step=self.max_step,
            dense_output=dense,
        )
        if not run.success:
            raise RuntimeError(f"solve_ivp failed: {run.message}")
        return run


def _peak(equation: _Equation, run) -> float:
    """Return the largest force (N) of the solution: found at the ends of steps, then refined
    between them."""

    def forces(times):
        states = run.sol(times).T[:, :2].tolist()
        return [equation.slope(t, *y)[1] for t, y in zip(times.tolist(), states, strict=True)]

    times = run.t
    for points in (9, 9, 9):
        values = forces(times)
        k = int(np.argmax(values))
        low, high = times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)]
        times = np.linspace(low, high, points)
    return max(values[k], *forces(times))
