"""Free form: a flank given by a B-spline for the rate at which its pressure angle falls."""

import functools
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import NDArray

from rootsopt.profiles import base as trig
from rootsopt.profiles.base import Profile, Quadrature, Segment
from rootsopt.runtime.programs import CachedFunction

# Degree of the B-spline.
_DEGREE = 2
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
# Number of safeguarded Newton steps in the search for the normal angle at a given roll angle. A
# step that leaves the bracket is replaced by a bisection.
_STEPS = 8
# Distance (fractions of a span) from the bracket above which a Newton step counts as leaving it.
# Without slack, rounding at the root could send the search back to the middle of a wide bracket.
_SLACK = 1e-9
# Number of plain Newton steps after the safeguarded ones. Derivatives of the result are correct up
# to this order.
_POLISH = 3
# Number of nodes per knot span on which the contact search brackets the minima of the gap.
_NODES_PER_SPAN = 6
# Number of points per knot span in the least-squares fit of a free form.
_SAMPLES = 40
# Factor on the row of the pitch crossing in the least-squares fit of a free form, which makes the
# fit almost exact there. All other rows have the factor 1.
_FIRMLY = 1e3
# Value of dβ/dν below which a Newton step divides by this constant instead of by dβ/dν. The
# derivative is 0 on an arc centred on the pitch circle.
_FLAT = 1e-9


class FreeForm(Profile):
    """A tip land, followed by a free curve with any number of coefficients.

    The rate τ(ν) is a quadratic B-spline with evenly spaced knots from the end of the land to the
    pitch crossing. It determines the roll angle by dβ/dν = 1 - τ, and the pressure angle by
    dψ/dν = -τ. ψ(ν) is therefore a cubic B-spline; it starts at π/2.

    If no coefficient exceeds 1 (the value on an arc centred on the pitch circle), the roll angle
    does not turn back. If no coefficient is below 0 (the value on an involute), ψ never rises.
    Where τ < 0, ψ rises, as in a single arc towards the pitch circle. All coefficients of an EE
    rotor, which has no land, are N / (1 + N). The length of the spline follows from the roll angle
    of the pitch crossing,

        (ν_p - θ1) (1 - mean of τ) = π/2N - θ1,

    where ν_p is the normal angle there. The support function h is the solution of h′ = -lever =
    -r cos ψ with h(ν_p) = r sin ψ(ν_p). It is computed by Gauss-Legendre quadrature inside each
    knot span, exact to rounding. The law of gearing therefore holds for any coefficients. The
    spline is a function of ν, not of β, because ψ(β) jumps on an arc centred on the pitch circle.

    `lobes`: number of lobes N; `pitch_radius`: r (m). `tip_arc_angle`: θ1 (rad), half the angle of
    the land. `coefficients` (n,), n ≥ 3: coefficients of τ, from the land to the pitch crossing.
    `width`: width of a knot span (rad). `turn` (n - 2, 4): coefficients of ψ (rad) in each span, in
    powers of the fraction of the span. `beyond` (n - 2,): support function (m) at the end of each
    span.
    """

    lobes: int = eqx.field(static=True)
    pitch_radius: Float[Array, ""]
    tip_arc_angle: Float[Array, ""]
    coefficients: Float[Array, " n"]
    width: Float[Array, ""]
    turn: Float[Array, "k 4"]
    beyond: Float[Array, " k"]

    wavy = True
    # ψ is a cubic inside a knot span.
    quadrature = Quadrature(24, False, 128)

    def __init__(self, lobes, pitch_radius, tip_arc_angle, coefficients):
        """Build the rotor.

        `lobes`: number of lobes N; `pitch_radius`: r (m); `tip_arc_angle`: θ1 (rad), half the angle
        of the land; `coefficients` (n,): coefficients of τ."""
        self.lobes = lobes
        r = self.pitch_radius = jnp.asarray(pitch_radius)
        self.tip_arc_angle = jnp.asarray(tip_arc_angle)
        self.coefficients = jnp.asarray(coefficients)
        share = jnp.asarray(_powers(self.coefficients.shape[0])) @ self.coefficients
        # Integral of τ over each span (`whole`), and over all spans before it (`before`).
        gone = share / jnp.arange(1, 2 + _DEGREE)
        whole = jnp.sum(gone, axis=1)
        before = jnp.cumsum(whole) - whole
        spans = whole.shape[0]
        room = self.half_pitch - self.tip_arc_angle
        self.width = room / (spans - jnp.sum(whole))
        start = jnp.pi / 2 - self.width * before
        self.turn = jnp.concatenate([start[:, None], -self.width * gone], axis=1)
        self.beyond = jnp.zeros(spans)
        each = self._within(jnp.arange(spans), jnp.zeros(spans))
        last = r * jnp.sin(jnp.sum(self.turn[-1]))
        self.beyond = last + jnp.cumsum(each[::-1])[::-1] - each

    @property
    def _spans(self) -> int:
        return self.turn.shape[0]

    @property
    def search_nodes(self) -> int:
        return max(32, _NODES_PER_SPAN * self._spans)

    def segments(self) -> tuple[Segment, ...]:
        zero, start = jnp.zeros_like(self.tip_arc_angle), self.tip_arc_angle
        return (
            Segment("tip land", zero, start, True),
            Segment("free form", start, start + self._spans * self.width, False),
        )

    def stretches(self) -> tuple[Segment, ...]:
        land, free = self.segments()
        ends = [free.start + k * self.width for k in range(self._spans)] + [free.stop]
        spans = itertools.pairwise(ends)
        return (land, *(Segment(free.name, start, stop, False) for start, stop in spans))

    def _place(self, nu):
        """Return (index of the knot span at `nu`, fraction of this span).

        The first and the last span are extended beyond the ends of the spline."""
        x = (nu - self.tip_arc_angle) / self.width
        span = jnp.clip(jnp.floor(lax.stop_gradient(x)), 0, self._spans - 1).astype(int)
        return span, x - span

    def _psi(self, span, share):
        """Return ψ (rad) in the knot span with index `span`, at the fraction `share` of it."""
        c = jnp.moveaxis(self.turn[span], -1, 0)
        return c[0] + share * (c[1] + share * (c[2] + share * c[3]))

    def _within(self, span, share):
        """Return ∫ r cos ψ dν (m) over a knot span, from the fraction `share` of it to its end.

        `span`: index of the knot span."""
        nodes, weights = (jnp.asarray(x, self.width.dtype) for x in (_NODES, _WEIGHTS))
        rest = (1 - share)[..., None]
        at = share[..., None] + rest * (1 + nodes) / 2
        lever = self.pitch_radius * trig.cos(self._psi(span[..., None], at))
        return self.width / 2 * jnp.sum(lever * rest * weights, axis=-1)

    def _pressure(self, nu):
        free = self._psi(*self._place(nu))
        return jnp.where(nu < self.tip_arc_angle, jnp.pi / 2, free)

    def roll_angle(self, nu):
        return nu + (self._pressure(nu) - jnp.pi / 2)

    def lever(self, nu):
        free = self.pitch_radius * trig.cos(self._psi(*self._place(nu)))
        return jnp.where(nu < self.tip_arc_angle, 0.0, free)

    def support(self, nu):
        span, share = self._place(jnp.maximum(nu, self.tip_arc_angle))
        return self.beyond[span] + self._within(span, share)

    def contact_distance(self, nu):
        return self.support(nu) - self.pitch_radius * trig.sin(self._pressure(nu))

    def normal_at(self, roll_angle):
        width, tip = self.width, self.tip_arc_angle
        starts = tip + width * jnp.arange(self._spans) + self.turn[:, 0] - jnp.pi / 2
        span = jnp.searchsorted(starts, roll_angle, side="right") - 1
        span = lax.stop_gradient(jnp.clip(span, 0, self._spans - 1))
        c = jnp.moveaxis(self.turn[span], -1, 0)
        want = roll_angle - starts[span]

        def short(c, width, want, share):
            """Return (β minus the required β (rad) at a fraction of a span, its derivative).

            `c`: coefficients of ψ in the span; `width`: width of the span (rad); `want`: required β
            minus β at the span's start (rad); `share`: the fraction.
            """
            rise = share * (width + c[1] + share * (c[2] + share * c[3]))
            slope = width + c[1] + share * (2 * c[2] + 3 * share * c[3])
            return rise - want, jnp.maximum(slope, _FLAT * width)

        fixed = lax.stop_gradient((c, width, want))
        low, high = jnp.zeros_like(want), jnp.ones_like(want)
        share = (low + high) / 2
        for _ in range(_STEPS):
            error, slope = short(*fixed, share)
            low, high = jnp.where(error < 0, share, low), jnp.where(error < 0, high, share)
            step = share - error / slope
            inside = (step >= low - _SLACK) & (step <= high + _SLACK)
            share = jnp.where(inside, step, (low + high) / 2)
        share = lax.stop_gradient(share)
        for _ in range(_POLISH):
            error, slope = short(c, width, want, share)
            share = share - error / slope
        return jnp.where(roll_angle < tip, roll_angle, tip + width * (span + share))


def project(profile: Profile, count: int) -> FreeForm:
    """Return the free form of `count` coefficients nearest to a `profile`, with the same tip land.

    `count`: number of coefficients, at least 3. The coefficients come from a linear least-squares
    fit of the pressure angle as a function of the normal angle. The fit keeps them between -1 and
    1.
    """
    from scipy.optimize import lsq_linear  # Imported here only: it takes 0.2 s.

    first, last = profile.segments()[0], profile.segments()[-1]
    start = float(first.stop) if first.land else 0.0
    length = float(last.stop) - start
    spans = count - _DEGREE
    share = np.arange(1, _SAMPLES * spans + 1) / (_SAMPLES * spans)
    psi = np.asarray(_pressure_angles(profile, start + length * share))
    rows, want = _integrals(count, share), (np.pi / 2 - psi) / length
    # The last row is the pitch crossing, at the end of the spline.
    rows[-1], want[-1] = rows[-1] * _FIRMLY, want[-1] * _FIRMLY
    fit = lsq_linear(rows, want, (-1.0, 1.0), method="bvls")
    # BVLS may exceed a bound by a rounding error.
    shares = jnp.asarray(np.clip(fit.x, -1.0, 1.0))
    return FreeForm(profile.lobes, profile.pitch_radius, jnp.asarray(start), shares)


@CachedFunction
def _pressure_angles(profile: Profile, nu):
    return profile.addendum(nu).psi


def _integrals(count: int, share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the integrals (n, count) of each of `count` B-splines from 0 to the fractions `share`
    (n,) of the whole spline's length, divided by this length."""
    powers = _powers(count) / np.arange(1, 2 + _DEGREE)[:, None]
    spans = len(powers)
    before = np.cumsum(powers.sum(axis=1), axis=0) - powers.sum(axis=1)
    x = share * spans
    span = np.clip(np.floor(x).astype(int), 0, spans - 1)
    inside = (x - span)[:, None] ** np.arange(1, 2 + _DEGREE)
    return (before[span] + np.einsum("np,npc->nc", inside, powers[span])) / spans


@functools.cache
def _powers(count: int) -> NDArray[np.float64]:
    """Return the coefficients (spans, 3, count) of `count` B-splines in each knot span.

    The coefficients multiply powers of the fraction of the span. They follow from the Cox-de Boor
    recursion on polynomials. Knots are the ends of the spans; the first and the last knot are
    repeated."""
    spans = count - _DEGREE
    knots = np.clip(np.arange(-_DEGREE, spans + _DEGREE + 1.0), 0, spans)
    basis = np.zeros((spans, _DEGREE + 1, count + _DEGREE))
    # Exactly one spline of degree 0 is 1 in each span.
    basis[np.arange(spans), 0, np.arange(spans) + _DEGREE] = 1
    for degree in range(1, _DEGREE + 1):
        lower, basis = basis, np.zeros_like(basis)
        for k in range(count + _DEGREE - degree):
            start, stop = knots[k], knots[k + 1]
            rise, fall = knots[k + degree] - start, knots[k + degree + 1] - stop
            for part, sign, width, zero in (
                (lower[..., k], 1.0, rise, start),
                (lower[..., k + 1], -1.0, fall, knots[k + degree + 1]),
            ):
                if width > 0:
                    # Multiply by ±(span + fraction - zero) / width.
                    away = (np.arange(spans) - zero)[:, None]
                    basis[..., k] += sign / width * (away * part)
                    basis[:, 1:, k] += sign / width * part[:, :-1]
    return basis[..., :count]
