"""Step size control that ends steps where a flank or the timing gear may begin to touch.

In free flight the motion is a parabola, on which a method of high order sees no error: its steps
grow until one passes over a whole touch between two stages, at any tolerance. Two integrations
whose steps differ by a rounding then differ by the impulse of that touch. So a step ends where the
parabola through the last step reaches an edge of free flight, and the next one begins short; a step
that is found to have passed an edge far is taken again.
"""

import diffrax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rootsopt.dynamics.pair import RotorPair

_BEYOND = 1e-4
"""Time (mesh periods) by which a step is meant to pass an edge: a touch shorter than this may be
missed."""
_LATE = 10.0
"""The same by which it may pass an edge, in units of `_BEYOND`, without being taken again."""
_AFTER = 5.0
"""First step behind an edge, in units of `_BEYOND`."""
_CLOSE = 0.05
"""Distance from an edge (scaled ε) at a turn of the parabola with which a step ends there."""
_INSIDE = 1 / 128
"""Longest step (mesh periods) where the instant at which a flank touches depends on the rotation:
with a clearance taken up, or with displaced axes."""


class LandingControl(diffrax.AbstractAdaptiveStepSizeController):
    """The `base` control, with steps that end where free flight may.

    `edges`: scaled ε at which a flank or the gear may begin to touch; `inside`: |ε| (scaled) beyond
    which a flank may touch at any time; `unit`: mesh periods in a unit of the independent variable.
    """

    base: diffrax.PIDController
    edges: Float[Array, " edges"]
    inside: Float[Array, ""]
    unit: Float[Array, ""]

    @classmethod
    def of(
        cls, base: diffrax.PIDController, pair: RotorPair, unit: Float[Array, ""] | float
    ) -> "LandingControl":
        """The control for a pair; `unit`: mesh periods in a unit of the independent variable."""
        assert pair.timescales is not None
        scale = pair.angle_scale
        play = pair.timescales.free / scale
        edges = [play, -play]
        edges += [edge / scale for part in pair.all_parts for edge in part.edges]
        inside = jnp.where(play > 0, play, jnp.inf)
        if pair.two_sided:
            inside = jnp.zeros_like(play)
        dtype = scale.dtype
        edge, inside = lax.stop_gradient((jnp.stack(edges), inside))
        return cls(  # pyright: ignore[reportCallIssue]
            base, edge.astype(dtype), inside.astype(dtype), jnp.asarray(unit, dtype)
        )

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.base.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.base.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.base.norm

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.base.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, state):
        keep, start, stop, jump, new, result = self.base.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        step = self.unit * (t1 - t0)
        before, after = y0[:2], y1_candidate[:2]
        away, late = self._passed(before, after, step)
        again = keep & (late > _LATE * _BEYOND)
        # To the edge by the secant, and a little beyond.
        shorter = jnp.maximum(step - late, 0.0) + _BEYOND
        most = jnp.where(away, _AFTER * _BEYOND, self._ahead(before, after, step))
        following = jnp.minimum(stop - start, most / self.unit)
        following = jnp.where(again, shorter / self.unit, jnp.where(keep, following, stop - start))
        keep &= ~again
        start = jnp.where(again, t0, start)
        new = tuple(jnp.where(again, old, x) for old, x in zip(state, new, strict=True))
        return keep, start, start + following, jump, new, result

    def _passed(self, before, after, step):
        """Whether a step has passed an edge, and how long ago (mesh periods) that was at its
        end."""
        passed = (before[0] - self.edges) * (after[0] - self.edges) < 0
        rate = jnp.maximum(jnp.abs(after[1]), jnp.abs(after[0] - before[0]) / step)
        ago = jnp.abs(after[0] - self.edges) / rate
        return jnp.any(passed), jnp.max(jnp.where(passed, ago, 0.0))

    def _ahead(self, before, after, step):
        """Longest step (mesh periods) from here that ends by the next edge."""
        place, rate = after
        bend = (rate - before[1]) / step
        away = place - self.edges
        square = rate**2 - 2 * bend * away
        half = -(rate + jnp.where(rate < 0, -1, 1) * jnp.sqrt(jnp.maximum(square, 0.0)))
        roots = jnp.stack([half / _known(bend), 2 * away / _known(half)])
        meets = (roots > 0) & (square >= 0)
        times = jnp.where(meets, roots + _BEYOND, jnp.inf)
        # A turn beside an edge: what is known of the parabola is not enough to tell whether it
        # gets there.
        turn = -rate / _known(bend)
        beside = jnp.min(jnp.abs(away + turn * (rate + bend * turn / 2))) < _CLOSE
        turning = beside & (turn > 2 * _BEYOND)
        longest = jnp.minimum(jnp.min(times), jnp.where(turning, turn, jnp.inf))
        return jnp.where(jnp.abs(place) > self.inside, jnp.minimum(longest, _INSIDE), longest)


def _known(x):
    """x, or infinity in place of 0."""
    return jnp.where(x == 0, jnp.inf, x)
