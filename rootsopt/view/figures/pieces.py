"""The outline of a rotor as true arcs and cubic splines, from which every drawing is made.

Each smooth segment of the flank becomes an arc or a spline. A circular arc is recognised by its
points and normals. Any other segment becomes a cubic B-spline through exact points with exact end
tangents, refined until it deviates by at most `TOLERANCE`. Adjacent pieces meet exactly or, at the
end of an arc, to within rounding. A corner or cusp is not smoothed: two pieces meet there.

Lengths are in millimetres, angles in radians. Points are complex numbers x + iy in the rotor frame,
with a lobe tip on +x.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex128, Float64
from numpy.typing import NDArray
from scipy.interpolate import BPoly, BSpline, make_interp_spline

from rootsopt.errors import InputError
from rootsopt.profiles import Profile
from rootsopt.runtime.programs import CachedFunction

TOLERANCE = 1e-7
"""Deviation (pitch radii) of a spline from the true flank above which nodes are added to the
spline. The error in area is at most the deviation times the perimeter, which for every rotor is
less than 1e-6 of the area."""
ROUND = 1e-9
"""Deviation (pitch radii) of a segment from a circle above which the segment is drawn as a spline,
not as an arc."""
_MM = 1e3

# Number of points at which a segment is compared with a circle.
_SAMPLES = 65

# Positions between two nodes (fractions of their distance) at which a spline is compared with the
# true flank.
_BETWEEN = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
_MOST_NODES = 4096

# Ratio of a spline's longest to its shortest knot span above which the spline is split in two.
# Spans shrink towards a cusp. At a higher ratio, some programs make relative errors above 1e-6,
# because they integrate over a whole edge with a fixed quadrature rule.
_UNEVEN = 100

# Number of points evaluated at once. It is constant, so that one compiled program serves any
# number of points.
_BLOCK = 512
_GAUSS = np.polynomial.legendre.leggauss(8)


@dataclasses.dataclass(frozen=True)
class Arc:
    """Part of a circle.

    `center`: the circle's centre (mm); `radius`: > 0 (mm); `begin`: angle of the first point (rad);
    `sweep`: angle covered (rad), positive if counter-clockwise.
    """

    center: complex
    radius: float
    begin: float
    sweep: float

    def at(self, share: Float64[np.ndarray, "*n"] | float) -> Complex128[np.ndarray, "*n"]:
        """Return the points (mm) at fractions `share` of the arc, from 0 (start) to 1 (end)."""
        angle = self.begin + np.asarray(share) * self.sweep
        return np.asarray(self.center + self.radius * np.exp(1j * angle))

    def heading(self, share: Float64[np.ndarray, "*n"] | float) -> Complex128[np.ndarray, "*n"]:
        """Return the unit tangents at fractions `share` of the arc."""
        angle = self.begin + np.asarray(share) * self.sweep
        return np.asarray(1j * np.sign(self.sweep) * np.exp(1j * angle))

    @property
    def start(self) -> complex:
        return complex(self.at(0.0))

    @property
    def stop(self) -> complex:
        return complex(self.at(1.0))

    @property
    def length(self) -> float:
        return self.radius * abs(self.sweep)

    def turned(self, angle: float) -> "Arc":
        """Return the arc rotated by `angle` (rad) about the rotor's axis."""
        center = complex(self.center * np.exp(1j * angle))
        return dataclasses.replace(self, center=center, begin=self.begin + angle)

    def mirrored(self) -> "Arc":
        """Return the mirror image of the arc in the x axis, with its direction reversed."""
        begin = -(self.begin + self.sweep)
        return dataclasses.replace(self, center=self.center.conjugate(), begin=begin)


@dataclasses.dataclass(frozen=True)
class Spline:
    """A cubic B-spline from its first control point to its last.

    `knots` (n + 4,): knots (mm), close to the arc length and with multiplicity 4 at the ends;
    `controls` (n,): control points (mm).
    """

    knots: Float64[np.ndarray, " m"]
    controls: Complex128[np.ndarray, " n"]

    def at(self, share: Float64[np.ndarray, "*n"] | float) -> Complex128[np.ndarray, "*n"]:
        """Return the points (mm) at fractions `share` of the parameter, from 0 (start) to 1 (end).

        The parameter is close to the arc length."""
        curve = BSpline(self.knots, self.controls, 3)
        return np.asarray(curve(self.knots[0] + share * self.length))

    def heading(self, share: Float64[np.ndarray, "*n"] | float) -> Complex128[np.ndarray, "*n"]:
        """Return the unit tangents at fractions `share` of the parameter."""
        slope = BSpline(self.knots, self.controls, 3).derivative()
        tangent = slope(self.knots[0] + share * self.length)
        return np.asarray(tangent / np.abs(tangent))

    @property
    def start(self) -> complex:
        return complex(self.controls[0])

    @property
    def stop(self) -> complex:
        return complex(self.controls[-1])

    @property
    def length(self) -> float:
        return float(self.knots[-1] - self.knots[0])

    def turned(self, angle: float) -> "Spline":
        """Return the spline rotated by `angle` (rad) about the rotor's axis."""
        return dataclasses.replace(self, controls=self.controls * np.exp(1j * angle))

    def mirrored(self) -> "Spline":
        """Return the mirror image of the spline in the x axis, with its direction reversed."""
        knots = self.knots[0] + (self.knots[-1] - self.knots[::-1])
        return Spline(knots, np.conj(self.controls[::-1]))

    def beziers(self) -> Complex128[np.ndarray, "k 4"]:
        """Return the same curve as k cubic Bézier curves, each a row of 4 control points (mm)."""
        curve = BSpline(self.knots, self.controls, 3)
        ends = np.unique(self.knots)
        # The derivative is continuous at every knot.
        both = np.stack([curve(ends), curve.derivative()(ends)], axis=-1)
        return BPoly.from_derivatives(ends, both).c.T


DrawnPiece = Arc | Spline


def outline_pieces(profile: Profile, inset: float = 0.0) -> list[DrawnPiece]:
    """Return the pieces (mm) of the closed counter-clockwise outline of a `profile`.

    `inset`: distance (mm) along the normal by which the outline is smaller than the profile.

    Every piece starts at the end of the previous piece. The outline starts at the root before the
    lobe on +x. If the arcs on both sides of this root are joined, the outline starts at the start
    of the joined arc.

    Raises `InputError` if a segment needs too many nodes to come within `TOLERANCE` of the true
    flank. Also raises it if the segment's radius of curvature is less than the inset.
    """
    flank = _flank(profile, inset)
    lobe = [piece.mirrored() for piece in reversed(flank)] + flank
    pitch = 2 * np.pi / profile.lobes
    around = [piece.turned(pitch * k) for k in range(profile.lobes) for piece in lobe]
    return _closed(_merged(around, ROUND * float(profile.pitch_radius) * _MM))


def polyline(pieces: list[DrawnPiece], chord: float) -> Complex128[np.ndarray, " n"]:
    """Return a closed polygon (n,) in mm whose corners lie on the outline `pieces`.

    Successive corners are about `chord` (mm) apart or closer. The first corner is repeated at the
    end."""
    counts = (max(2, int(np.ceil(piece.length / chord))) for piece in pieces)
    parts = [piece.at(np.arange(n) / n) for piece, n in zip(pieces, counts, strict=True)]
    return np.concatenate([*parts, parts[0][:1]])


def _flank(profile: Profile, inset: float) -> list[DrawnPiece]:
    """Return the pieces of one flank, from the centre of the tip to the centre of the root."""
    size = float(profile.pitch_radius) * _MM
    segments = [(float(s.start), float(s.stop)) for s in profile.segments() if s.start != s.stop]
    stretches = [
        *(_Stretch(profile, start, stop, False, inset) for start, stop in segments),
        *(_Stretch(profile, stop, start, True, inset) for start, stop in reversed(segments)),
    ]
    pieces = [piece for stretch in stretches for piece in stretch.pieces(size)]
    # Leave out pieces without length, such as a tip land of zero width.
    return [piece for piece in pieces if piece.length > 1e-12 * size]


@CachedFunction
def _points(profile, nu):
    """Return the values on the addendum and on the dedendum at normal angles `nu` (rad).

    The values are (points (m), directions of the outward normal (rad), arc length per `nu`
    (m/rad), turn of the normal per `nu`)."""
    _, addendum, dedendum = profile.speeds(nu)

    def turned(nu):
        below = profile.dedendum(nu)
        return below.beta + jnp.pi / 2 - below.psi, below

    direction, turn, below = jax.jvp(turned, (nu,), (jnp.ones_like(nu),), has_aux=True)
    above = profile.position(profile.addendum(nu)), nu, addendum, jnp.ones_like(nu)
    return above, (profile.position(below), direction, dedendum, turn)


@dataclasses.dataclass(frozen=True)
class _Stretch:
    """One segment of the addendum or `dedendum`, from normal angle `start` to `stop` (rad).

    `inset`: as in `outline_pieces`."""

    profile: Profile
    start: float
    stop: float
    dedendum: bool
    inset: float

    def look(self, share: NDArray[np.float64]):
        """Return (points (mm), unit normals, arc length per unit of share (mm)) at `share` (n,).

        A share is a fraction (0 to 1) of the range of normal angles. At 0 and 1, the segment is
        evaluated just inside its ends, so that neighbouring segments have no influence.
        """
        inside = np.clip(share, 1e-12, 1 - 1e-12)
        inside = np.pad(inside, (0, -len(share) % _BLOCK), mode="edge")
        nu = self.start + (self.stop - self.start) * inside.reshape(-1, _BLOCK)
        blocks = [_points(self.profile, jnp.asarray(block))[int(self.dedendum)] for block in nu]
        points, normal, speed, turn = (
            np.concatenate(part)[: len(share)] for part in zip(*blocks, strict=True)
        )
        way, outward = -1 if self.dedendum else 1, np.exp(1j * normal)
        length = speed * _MM - way * self.inset * turn
        if self.inset and np.any(length * np.sign(speed) < 0):
            raise InputError(
                f"`drawing.inset_mm` must be less than the radius of curvature of the flank, but "
                f"is {self.inset:g}, which cuts off a part of it; lower it"
            )
        return (
            points @ np.array([1, 1j]) * _MM - self.inset * outward,
            outward,
            np.abs(length * (self.stop - self.start)),
        )

    def pieces(self, size: float) -> list[DrawnPiece]:
        """Return the segment as one arc, one spline or two splines.

        `size`: pitch radius (mm). Raises `InputError` if a spline needs too many nodes."""
        if arc := self._arc(ROUND * size):
            return [arc]
        spline = self._spline(TOLERANCE * size)
        spans = np.diff(np.unique(spline.knots))
        if np.max(spans) <= _UNEVEN * np.min(spans):
            return [spline]
        middle = (self.start + self.stop) / 2
        parts = (
            dataclasses.replace(self, stop=middle),
            dataclasses.replace(self, start=middle),
        )
        return [part._spline(TOLERANCE * size) for part in parts]

    def _arc(self, tolerance: float) -> Arc | None:
        """Return the segment as an arc, or `None` if it is not one.

        The circle P = C + ρ n is fitted to sampled points P and normals n by least squares. If a
        point deviates from the circle by more than `tolerance` (mm), the segment is not an arc."""
        points, normals, _ = self.look(np.linspace(0, 1, _SAMPLES))
        spread = normals - normals.mean()
        turning = np.sum(np.abs(spread) ** 2)
        if turning < 1e-20:
            return None
        radius = np.sum(np.real((points - points.mean()) * np.conj(spread))) / turning
        center = points.mean() - radius * normals.mean()
        if np.max(np.abs(points - center - radius * normals)) > tolerance:
            return None
        ends = (points[[0, -1]] - center) / radius
        sweep = float(np.sum(np.angle(normals[1:] / normals[:-1])))
        side = 0.0 if radius > 0 else np.pi
        return Arc(complex(center), float(abs(radius)), float(np.angle(ends[0])) + side, sweep)

    def _spline(self, tolerance: float) -> Spline:
        """Return a cubic spline over arc length, within `tolerance` (mm) of the segment.

        Nodes are added until the spline is within `tolerance`. Raises `InputError` if it needs too
        many nodes."""
        nodes = np.linspace(0, 1, 5)
        while len(nodes) <= _MOST_NODES:
            spline, error = self._fitted(nodes)
            coarse = error > tolerance
            if not np.any(coarse):
                return spline
            middle = (nodes[1:] + nodes[:-1])[coarse] / 2
            nodes = np.sort(np.concatenate([nodes, middle]))
        raise InputError(
            f"the flank between normal angles {self.start:.6g} and {self.stop:.6g} rad needs more "
            f"than {_MOST_NODES} nodes to be drawn within {tolerance:.2g} mm; change the design "
            "slightly"
        )

    def _fitted(self, nodes: NDArray[np.float64]) -> tuple[Spline, NDArray[np.float64]]:
        """Return (spline through the points at `nodes`, its largest deviation (mm) per interval).

        `nodes` (n,): shares as in `look`."""
        width = np.diff(nodes)
        gauss, weights = _GAUSS
        at = nodes[:-1, None] + width[:, None] * (1 + gauss) / 2
        speed = self.look(at.ravel())[2].reshape(at.shape)
        length = np.concatenate([[0.0], np.cumsum(speed @ weights / 2 * width)])
        points, normals, _ = self.look(nodes)
        ends = 1j * normals[[0, -1]]
        curve = make_interp_spline(length, points, k=3, bc_type=([(1, ends[0])], [(1, ends[1])]))
        between = (nodes[:-1, None] + width[:, None] * _BETWEEN).ravel()
        true = self.look(between)[0]
        foot = np.interp(between, nodes, length)
        # Newton's method finds the parameter of the foot point; the distance is the deviation.
        slope = curve.derivative()
        for _ in range(4):
            tangent = slope(foot)
            foot = foot + np.real((true - curve(foot)) * np.conj(tangent)) / np.abs(tangent) ** 2
            foot = np.clip(foot, 0, length[-1])
        error = np.abs(true - curve(foot)).reshape(at.shape[0], -1).max(axis=1)
        return Spline(np.asarray(curve.t), np.asarray(curve.c, dtype=complex)), error


def _merged(pieces: list[DrawnPiece], tolerance: float) -> list[DrawnPiece]:
    """Return the pieces with adjacent arcs of the same circle joined, also across the start.

    `tolerance`: difference between two circles (mm) above which their arcs are not joined."""
    merged: list[DrawnPiece] = []
    for piece in pieces:
        if merged and (joined := _joined(merged[-1], piece, tolerance)):
            merged[-1] = joined
        else:
            merged.append(piece)
    if len(merged) > 2 and (joined := _joined(merged[-1], merged[0], tolerance)):
        merged = [joined, *merged[1:-1]]
    return merged


def _joined(one: DrawnPiece, other: DrawnPiece, tolerance: float) -> Arc | None:
    if not (isinstance(one, Arc) and isinstance(other, Arc)):
        return None
    same = abs(one.center - other.center) + abs(one.radius - other.radius) <= tolerance
    if not same or one.sweep * other.sweep < 0:
        return None
    return dataclasses.replace(one, sweep=one.sweep + other.sweep)


def _closed(pieces: list[DrawnPiece]) -> list[DrawnPiece]:
    """Return the pieces with the ends of every spline moved onto the ends of the adjacent pieces.

    Before this step, the ends differ by rounding errors."""
    closed = list(pieces)
    for i, piece in enumerate(closed):
        if isinstance(piece, Spline):
            after = closed[(i + 1) % len(closed)]
            controls = piece.controls.copy()
            controls[0], controls[-1] = closed[i - 1].stop, after.start
            closed[i] = dataclasses.replace(piece, controls=controls)
    return closed
