"""Settings of the solver, and integration of the equation of motion: method, tolerance and steps.

In free flight the motion is a parabola, for which a high-order method estimates an error of zero.
Steps grow until one of them skips a whole contact between two stages, at any tolerance. Two
integrations whose steps differ only by rounding then differ by the impulse of that contact.

Therefore a step ends where the parabola through the last step reaches an edge of free flight: a
value of ε at which contact may begin. The next step starts short. A step that has passed an edge by
too much is repeated."""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.dynamics.orbit import Measures
from rootsopt.dynamics.pair import RotorPair

METHODS: dict[str, Callable[..., diffrax.AbstractERK]] = {
    "tsit5": diffrax.Tsit5,
    "dopri8": diffrax.Dopri8,
}
# Upper limits on the step length: an absolute length (mesh periods), and a multiple of
# `Timescales.fall`. The smaller limit applies. In free flight, the error control alone would let a
# step skip a short contact of the gear. The third number, divided by `max_steps`, is the least
# value (mesh periods) of the second limit. Steps of this length use at most a quarter of
# `max_steps` per mesh period.
_LONGEST = 1 / 32, 1 / 8, 4.0


class Integrator(eqx.Module):
    """Settings for integrating the equation of motion.

    `method`: a key of `METHODS`; `rtol`: relative tolerance, also used as absolute tolerance, since
    states are scaled; `max_steps`: maximum number of steps in one integration.
    """

    method: str = eqx.field(static=True)
    rtol: Float[Array, ""]
    max_steps: int = eqx.field(static=True)

    @property
    def tolerance(self) -> Float[Array, ""]:
        """`rtol` or, if greater, 20 rounding errors."""
        return jnp.maximum(self.rtol, 20 * float(jnp.finfo(float).eps))

    def solver(self) -> diffrax.AbstractERK:
        """Return the diffrax solver."""
        return METHODS[self.method](scan_kind="lax")

    def controller(self, pair: RotorPair) -> "diffrax.PIDController | LandingControl":
        """Return the step size control for `pair`, whose `timescales` limit the steps.

        The result is a `LandingControl` if they are known. Otherwise it is a plain
        `diffrax.PIDController`."""
        rtol, longest = self.tolerance, jnp.asarray(_LONGEST[0])
        if pair.timescales is not None:
            fall = pair.timescales.fall / pair.mesh_period
            flying = jnp.maximum(_LONGEST[1] * fall, _LONGEST[2] / self.max_steps)
            longest = jnp.minimum(longest, flying)
        base = diffrax.PIDController(rtol=rtol, atol=rtol, dtmax=longest)
        return base if pair.timescales is None else LandingControl.of(base, pair)


class Solver(eqx.Module):
    """Settings for finding a steady motion.

    `transient`, `orbit`: integrators of the transient, and of the check of an orbit, whose
    tolerance sets the accuracy of the orbit; `measures`: averages of the force to compute;
    `max_periods`: maximum length of the transient (mesh periods); `probe_chaos`: 1 to integrate a
    window of a motion that does not settle (see `closed.examined`), 0 to skip it; `max_orbit`:
    longest period of an orbit to find (mesh periods), at most 8; `variation`: whether an orbit has
    its `Orbit.variation`. `max_periods` and `probe_chaos` are floats, as are all leaves.
    """

    transient: Integrator
    orbit: Integrator
    measures: Measures
    max_periods: Float[Array, ""]
    probe_chaos: Float[Array, ""]
    max_orbit: int = eqx.field(static=True)
    variation: bool = eqx.field(static=True, default=False)


# Time (mesh periods) after reaching an edge at which a step should end. A contact shorter than this
# may be missed.
_BEYOND = 1e-4
# Time since passing an edge, in units of `_BEYOND`, above which a step is repeated with a shorter
# length.
_LATE = 10.0
# Maximum length of the first step after an edge, in units of `_BEYOND`.
_AFTER = 5.0
# Distance (scaled ε) of the parabola's vertex from an edge below which the next step ends at the
# vertex at the latest.
_CLOSE = 0.05
# Maximum step (mesh periods) where ε alone does not determine whether the flanks touch: beyond the
# clearance, or with displaced axes.
_INSIDE = 1 / 128
# Two lengths for the first step: an absolute length (mesh periods), and a multiple of
# `Timescales.swing`. The smaller one is used. The error control rejects a first step that is too
# long.
_FIRST = 1e-3, 0.05


class LandingControl(diffrax.AbstractAdaptiveStepSizeController):
    """The step size control `base`, extended so that steps end where free flight may end.

    `edges`: scaled ε at which a flank or the gear may begin to touch; `inside`: scaled |ε| above
    which a flank may touch at any time; `first`: length of the first step (mesh periods);
    `moving`: pair whose parts have `edges`, which then are 0, relative to those of the parts; None:
    the edges do not move.
    """

    base: "diffrax.PIDController | LandingControl"
    edges: Float[Array, " edges"]
    inside: Float[Array, ""]
    first: Float[Array, ""]
    moving: RotorPair | None = None

    @classmethod
    def of(cls, base: diffrax.PIDController, pair: RotorPair) -> "LandingControl":
        """Return the control based on `base` for a `pair` whose `timescales` are known."""
        assert pair.timescales is not None
        scale = pair.angle_scale
        play = pair.timescales.free / scale
        edges, own = [play, -play], [edge for part in pair.all_parts for edge in part.edges]
        if pair.repeats == 1:
            edges += [edge / scale for edge in own]
        inside = jnp.where(play > 0, play, jnp.inf)
        if pair.two_sided:
            inside = jnp.zeros_like(play)
        dtype = scale.dtype
        first = jnp.minimum(_FIRST[0], _FIRST[1] * pair.timescales.swing / pair.mesh_period)
        numbers = lax.stop_gradient((jnp.stack(edges), inside, first))
        fixed = cls(base, *(x.astype(dtype) for x in numbers))  # pyright: ignore
        if pair.repeats == 1 or not own:
            return fixed
        zeros, frozen = jnp.zeros(len(own), dtype), lax.stop_gradient(pair)
        return cls(fixed, zeros, jnp.full_like(play, jnp.inf), fixed.first, frozen)  # pyright: ignore

    rtol = property(lambda self: self.base.rtol)  # pyright: ignore
    atol = property(lambda self: self.base.atol)  # pyright: ignore
    norm = property(lambda self: self.base.norm)  # pyright: ignore

    def wrap(self, direction):
        return self

    # diffrax prescribes the parameters of `init` and `adapt_step_size`.
    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        # Without `dt0`, diffrax adds no check of it. The check would be a callback to Python, and
        # programs with callbacks cannot be cached.
        first = self.first if dt0 is None else dt0
        return self.base.init(terms, t0, t1, y0, first, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        keep, start, stop, jump, new, result = self.base.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        step = t1 - t0
        before, after = y0[:2], y1_candidate[:2]
        if self.moving is not None:
            before, after = self._relative(t0, before), self._relative(t1, after)
        away, late = self._passed(before, after, step)
        again = keep & (late > _LATE * _BEYOND)
        # Step to the edge, estimated by the secant, and a little beyond.
        shorter = jnp.maximum(step - late, 0.0) + _BEYOND
        ahead = self._ahead(before, after, step)
        ahead = ahead if self.moving is None else jnp.min(ahead)
        most = jnp.where(away, _AFTER * _BEYOND, ahead)
        following = jnp.minimum(stop - start, most)
        following = jnp.where(again, shorter, jnp.where(keep, following, stop - start))
        keep &= ~again
        start = jnp.where(again, t0, start)
        new = tuple(jnp.where(again, old, x) for old, x in zip(state, new, strict=True))
        return keep, start, start + following, jump, new, result

    def _relative(self, tau, state):
        """Return ε and dε/dτ (2, edges) of a scaled `state` relative to each moving edge at `tau`
        (mesh periods)."""
        pair = self.moving
        assert pair is not None

        def edges(tau):
            phi = pair.angle(tau)
            own = [edge for part in pair.all_parts for edge in part.edges_at(phi)]
            return jnp.stack(own) / pair.angle_scale

        return state[:, None] - jnp.stack(jax.jvp(edges, (tau,), (jnp.ones_like(tau),)))

    def _passed(self, before, after, step):
        """Return whether a step has passed an edge, and the time since then (mesh periods).

        `before`, `after`: scaled ε and dε/dτ at both ends of the step; `step`: its length (mesh
        periods). The time is 0 if no edge was passed."""
        passed = (before[0] - self.edges) * (after[0] - self.edges) < 0
        rate = jnp.maximum(jnp.abs(after[1]), jnp.abs(after[0] - before[0]) / step)
        ago = jnp.abs(after[0] - self.edges) / rate
        return jnp.any(passed), jnp.max(jnp.where(passed, ago, 0.0))

    def _ahead(self, before, after, step):
        """Return the maximum length (mesh periods) of the next step.

        A step of this length ends where ε next reaches an edge. `before`, `after`: scaled ε and
        dε/dτ at both ends of the last step; `step`: its length (mesh periods)."""
        place, rate = after
        bend = (rate - before[1]) / step
        away = place - self.edges
        square = rate**2 - 2 * bend * away
        half = -(rate + jnp.where(rate < 0, -1, 1) * jnp.sqrt(jnp.maximum(square, 0.0)))
        roots = jnp.stack([half / _known(bend), 2 * away / _known(half)])
        meets = (roots > 0) & (square >= 0)
        times = jnp.where(meets, roots + _BEYOND, jnp.inf)
        # With its vertex this close to an edge, the parabola is not known well enough to tell
        # whether the motion reaches the edge.
        turn = -rate / _known(bend)
        beside = jnp.min(jnp.abs(away + turn * (rate + bend * turn / 2))) < _CLOSE
        turning = beside & (turn > 2 * _BEYOND)
        longest = jnp.minimum(jnp.min(times), jnp.where(turning, turn, jnp.inf))
        return jnp.where(jnp.abs(place) > self.inside, jnp.minimum(longest, _INSIDE), longest)


def _known(x):
    """Return x with zeros replaced by infinity, for use as a divisor."""
    return jnp.where(x == 0, jnp.inf, x)
