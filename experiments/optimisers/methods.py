"""Methods for few smooth variables under constraints, all on the epigraph of the same problem.

Every method gets the objective and constraints of `Epigraph` with exact gradients, starts at the
same point and ends when its evaluations run out.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import BFGS, NonlinearConstraint, minimize

from rootsopt.optimize.local import Local, Look
from rootsopt.optimize.sqp import SCALE, EndError, Epigraph, Stops, descend

Method = Callable[[Look, NDArray[np.float64], Stops], None]
_OUTER, _INNER = 30, 25
"""Rounds of the augmented Lagrangian, and iterations of L-BFGS in each."""
_PENALTY, _GROWTH, _MOST = 10.0, 4.0, 1e6
"""First weight of the penalty, its growth where the violation does not fall by half, its limit."""


def slsqp(look: Look, start: NDArray[np.float64], stops: Stops) -> None:
    """Run the package's own local search: sequential quadratic programming."""
    descend(look, start, stops)


def _problem(look: Look, start: NDArray[np.float64], stops: Stops) -> Epigraph | None:
    first = look(start)
    return None if first is None else Epigraph(look, start, first, stops)


def _bounds(problem: Epigraph, count: int) -> list[tuple[float | None, float | None]]:
    free: list[tuple[float | None, float | None]] = [(None, None)]
    return [(0.0, 1.0 / SCALE)] * problem.size + free * (count - problem.size)


def augmented_lagrangian(look: Look, start: NDArray[np.float64], stops: Stops) -> None:
    """Run an augmented Lagrangian with SciPy's L-BFGS-B (Nocedal and Wright, algorithm 17.4)."""
    problem = _problem(look, start, stops)
    if problem is None:
        return
    z = problem.start()
    weights = np.zeros(len(problem.constraints(z)[0]))
    penalty, before = _PENALTY, np.inf

    def merit(z):
        value, slope = problem.value(z)
        slack, normals = problem.constraints(z)
        short = np.maximum(weights / penalty - slack, 0.0)
        return value + penalty / 2 * short @ short, slope - penalty * short @ normals

    try:
        for _ in range(_OUTER):
            options = {"maxiter": _INNER}
            bounds = _bounds(problem, len(z))
            z = minimize(merit, z, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
            slack = problem.constraints(z)[0]
            violation = np.max(np.maximum(-slack, 0.0))
            weights = np.maximum(weights - penalty * slack, 0.0)
            if violation > before / 2:
                penalty = min(_GROWTH * penalty, _MOST)
            before = violation
    except EndError:
        return


def interior_point(look: Look, start: NDArray[np.float64], stops: Stops) -> None:
    """Run SciPy's trust-constr: an interior point method within a trust region."""
    problem = _problem(look, start, stops)
    if problem is None:
        return
    z = problem.start()
    limits = NonlinearConstraint(
        lambda z: problem.constraints(z)[0],
        0.0,
        np.inf,
        jac=lambda z: problem.constraints(z)[1],
        hess=BFGS(),
    )
    options = {"maxiter": 10_000, "gtol": 1e-12, "xtol": 1e-12, "barrier_tol": 1e-10}
    try:
        minimize(
            problem.value,
            z,
            jac=True,
            hess=BFGS(),
            method="trust-constr",
            bounds=_bounds(problem, len(z)),
            constraints=limits,
            options=options,
        )
    except EndError:
        return


def moving_asymptotes(look: Look, start: NDArray[np.float64], stops: Stops) -> None:
    """Run NLopt's method of moving asymptotes (Svanberg 2002, globally convergent).

    Raises ImportError without the package `nlopt`."""
    import nlopt  # type: ignore[import-not-found]

    problem = _problem(look, start, stops)
    if problem is None:
        return
    z = problem.start()
    count = len(problem.constraints(z)[0])
    search = nlopt.opt(nlopt.LD_MMA, len(z))
    low, high = zip(*_bounds(problem, len(z)), strict=True)
    search.set_lower_bounds([-1e3 if b is None else b for b in low])
    search.set_upper_bounds([1e3 if b is None else b for b in high])

    def value(z, slope):
        found, gradient = problem.value(z)
        if slope.size:
            slope[:] = gradient
        return found

    def limits(result, z, slope):
        slack, normals = problem.constraints(z)
        result[:] = -slack
        if slope.size:
            slope[:] = -normals

    search.set_min_objective(value)
    search.add_inequality_mconstraint(limits, np.full(count, 1e-9))
    search.set_maxeval(stops.evaluations)
    try:
        search.optimize(z)
    except (EndError, nlopt.RoundoffLimited, RuntimeError):
        return


METHODS: dict[str, Method] = {
    "slsqp": slsqp,
    "augmented_lagrangian": augmented_lagrangian,
    "interior_point": interior_point,
    "mma": moving_asymptotes,
}

__all__ = ["METHODS", "Local", "Method"]
