"""Traces a front: its ends, the points between them from neighbour to neighbour, and its gaps.

First, each term alone is minimised from several starts. These optima are the ends of the front, and
reference points are spread evenly between them: on the straight line between two ends, or on a
triangular grid between three. The objective of `Scalar` is minimised for each of them.
The reference points are those of the normal-boundary method: Das and Dennis, Normal-boundary
intersection, SIAM Journal on Optimization 8 (1998) 631-657. That method requires the solution to
lie on the normal through the reference point; here, it may lie beside the normal.

The optima are found in order. Each search starts from a prediction: the secant through two
neighbours already found, or the nearest one. A second chain of searches runs beside it in the
opposite order. Several local optima can exist side by side, so the better of the two results
counts. Two kinds of designs evaluated earlier start further searches: one that is better than the
result, and the best one that lies far from it. Finally, neighbours that lie far apart are bisected.

Independent searches run side by side: those of the ends, both chains, the further searches of all
points, and those of one bisection. Each has its own `Course`, so that the result does not depend on
which ends first, or where designs are evaluated (`Runs`)."""

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rootsopt.config.families import families
from rootsopt.config.reading import Config
from rootsopt.errors import InputError
from rootsopt.optimize.infeasible import Infeasible, feasible_points
from rootsopt.optimize.local import FEASIBLE, RESIDUAL, Linearization, certify
from rootsopt.optimize.optimality import judged
from rootsopt.optimize.sqp import Stops, descend
from rootsopt.optimize.tradeoffs.assembly import (
    APART,
    BETTER,
    Bisections,
    Edge,
    Node,
    Spacing,
    better,
    divides,
    front_of,
    predictions,
    selected,
    sharpened,
    spacing_of,
    starts_apart,
    widest,
)
from rootsopt.optimize.tradeoffs.front import (
    Front,
    Key,
    Scalar,
    Scale,
    corners,
    end_scale,
    keys,
    links,
)
from rootsopt.optimize.tradeoffs.study import Course, Sample, Seen, Study
from rootsopt.response.journal import Checkpoint
from rootsopt.response.reducers import HERE, Runs, as_done
from rootsopt.response.result import Seeds
from rootsopt.scene.space import sobol
from rootsopt.status import Standing

# Excess over the best objective (fraction of a term's range) below which a design evaluated
# earlier, far from the best one, starts another search.
_PROMISING = 0.25
# Relative difference of a term between search and verification above which a point is dropped.
_HOLDS_UP = 0.01
# Range of a term over the ends (relative to its scale) below which the terms do not conflict.
_SAME_ENDS = 1e-6

Task, Done = TypeVar("Task"), TypeVar("Done")


class Tracer:
    """Traces the front of one config.

    `progress`: function called after each local search with (searches done, searches expected);
    `stop`: event that another thread can set to end the tracing early; `runs`: where designs are
    evaluated; `checkpoint`: file that stores every evaluation and supplies those of an interrupted
    search.

    The baseline is evaluated at once. Raises `InputError` if there is no design parameter, for
    unknown terms, or for a scene that cannot be simulated."""

    def __init__(
        self,
        config: Config,
        progress: Callable[[int, int], None] | None = None,
        stop: threading.Event | None = None,
        runs: Runs = HERE,
        checkpoint: Checkpoint | None = None,
    ):
        if not config.design_keys:
            valid = ", ".join(name for name, family in families().items() if family.keys)
            raise InputError(
                f"`profile.family` must be one of {valid} for a trade-off, but is "
                f"{config.profile.family}: it has no design parameter; use `simulate` for it, "
                "or make the twist one with `optimizer.bounds.helix_deg`"
            )
        self.config, self.runs = config, runs
        self.progress = progress or (lambda done, expected: None)
        self.stop = threading.Event() if stop is None else stop
        self.study = Study.of(config, runs, checkpoint)
        # Nodes of the grid, then those found by bisection, whose keys have one number.
        self._nodes: dict[Key, Node] = {}
        self._gaps = Bisections([])
        self._spacing = Spacing(np.inf, np.inf)
        count = len(self.study.aims)
        self.scale = Scale(np.zeros(count), np.ones(count))  # Until designs are screened.
        self._course = Course()
        self._lock = threading.Lock()
        self._searches = self._evaluations = self._expected = 0

    def run(self) -> Front:
        """Find the ends, trace the front, and verify its points.

        Return the front. If `stop` is set, the front has the points found so far."""
        study = self.study
        if not study.problem.baseline.usable or self.stop.is_set():
            return front_of(self, [])
        points, reason = self._feasible()
        if reason is not None:
            return front_of(self, [], infeasible=reason)
        self._screen(points)
        if self._course.seen and self._ends(points[0]):
            self._trace()
            self._bisect()
        return front_of(self, self._verified(self._all()))

    def so_far(self) -> Front:
        """Return the points found so far, without verification.

        Another thread can call this method during the search."""
        return front_of(self, self._all())

    # The ends of the front.

    def _feasible(self) -> tuple[list[NDArray[np.float64]], Infeasible | None]:
        """Return the baseline's point and a Sobol sample, moved onto the feasible set.

        The second result says why no design is feasible; it is `None` if one is."""
        settings, problem = self.config.optimizer, self.study.problem
        start = problem.project(problem.point([*problem.baseline.design.values()]))
        sample = sobol(settings.screening, settings.seed, len(start))
        return feasible_points(problem, [start, *(problem.toward(x, start) for x in sample)])

    def _screen(self, points: Sequence[NDArray[np.float64]]) -> None:
        evaluations = self._side_by_side(
            lambda point: None if self.stop.is_set() else self.study.screened(point), points
        )
        signs = np.array([aim.sign for aim in self.study.aims])
        names = [aim.name for aim in self.study.aims]
        # Designs beyond a limit of a force serve as starts only if there are no others.
        inside: list[Seen] = []
        beyond: list[Seen] = []
        for point, evaluation in zip(points, evaluations, strict=True):
            if evaluation is not None:
                values = signs * [evaluation.response[name] for name in names]
                seen = Seen(point, values, evaluation.start)
                kept = self.study.problem.excess(evaluation) <= FEASIBLE
                (inside if kept else beyond).append(seen)
        self._course = Course(inside or beyond)
        self._evaluations += len(points)
        baseline = signs * [self.study.problem.baseline.response[name] for name in names]
        every = np.array([one.values for one in self._course.seen]).reshape(-1, len(names))
        self.scale = end_scale(baseline, every)

    def _side_by_side(self, work: Callable[[Task], Done], tasks: Iterable[Task]) -> list[Done]:
        """Return `work(task)` for all tasks, in their order; they run side by side."""
        return [done for _, done in sorted(as_done(work, tasks, self.runs.slots))]

    def _ends(self, first: NDArray[np.float64]) -> bool:
        """Find the end of each term, and set the final scale.

        `first` (d,): the baseline's point. Return whether there is a front to trace between them:
        all ends exist and are in conflict."""
        count = len(self.study.aims)
        starts = self.config.optimizer.starts
        self._expected = count * starts + 3 * (len(keys(count, self._divisions)) - count)
        scalars = [Scalar(self.scale, np.zeros(count), (number,)) for number in range(count)]
        begins = [starts_apart(self._course, scalar, starts, first) for scalar in scalars]
        nodes = self._solved_from(
            [(number, one) for number in range(count) for one in begins[number]], scalars
        )
        for number, key in enumerate(corners(count, self._divisions)):
            best = self._again(scalars[number], nodes[number], self._course)
            if best is None:
                return False
            with self._lock:
                self._nodes[key] = best._replace(end=number)
        ends = np.array([node.sample.values for node in self._nodes.values()])
        width = np.ptp(ends, axis=0)
        conflict = bool(np.all(width > _SAME_ENDS * self.scale.width))
        if conflict:
            self.scale = Scale(np.min(ends, axis=0), width)
        return conflict and not self.stop.is_set()

    def _solved_from(
        self, starts: Sequence[tuple[int, Seen]], scalars: Sequence[Scalar]
    ) -> list[Node | None]:
        """Search from several `starts` side by side; return the best node for each of `scalars`.

        `starts`: (index of the objective, design to begin from)."""

        def solve(task: tuple[int, Seen]) -> tuple[Course, Node | None]:
            course, (number, one) = self._course.branch(), task
            return course, self._solved(scalars[number], one.point, one.orbit, None, course)

        done = self._side_by_side(solve, starts)
        self._course.join([course for course, _ in done])
        best: list[Node | None] = [None] * len(scalars)
        for (number, _), (_, node) in zip(starts, done, strict=True):
            best[number] = better(best[number], node)
        return best

    # The points between the ends.

    @property
    def _divisions(self) -> int:
        """Number of steps between two ends of the front."""
        wanted = self.config.pareto
        return wanted.points - 1 if len(wanted.terms) == 2 else wanted.divisions

    def _trace(self) -> None:
        inner = [k for k in keys(len(self.study.aims), self._divisions) if k not in self._nodes]
        ends = dict(self._nodes)
        chains = self._side_by_side(lambda ahead: self._chain(inner, ends, ahead), (True, False))
        self._course.join([course for course, _ in chains])
        # In a fixed order: of two that are equally good, the first counts.
        best = {key: better(*(nodes.get(key) for _, nodes in chains)) for key in inner}
        with self._lock:
            self._nodes = ends | {key: node for key, node in best.items() if node is not None}

        def finish(key: Key) -> Course:
            course, scalar = self._course.branch(), self._scalar(key)
            if not self.stop.is_set():
                best = self._again(scalar, self._nodes.get(key), course)
                self._keep(key, self._elsewhere(scalar, best, course))
            return course

        self._course.join(self._side_by_side(finish, inner))

    def _scalar(self, key: Key) -> Scalar:
        ends = [self._nodes[one].sample.values for one in corners(len(key), self._divisions)]
        reference = np.array(key) / self._divisions @ self.scale.of(np.array(ends))
        return Scalar(self.scale, reference, tuple(range(len(key))))

    def _chain(
        self, inner: Sequence[Key], ends: Mapping[Key, Node], ahead: bool
    ) -> tuple[Course, dict[Key, Node]]:
        """Solve the points `inner` from neighbour to neighbour; return the course and all nodes.

        `ends`: nodes to begin from; `ahead`: whether in the order given, or in the opposite one."""
        course, nodes = self._course.branch(), {**ends}
        for key in inner if ahead else inner[::-1]:
            if self.stop.is_set():
                break
            scalar, best = self._scalar(key), None
            for start, orbit in predictions(key, ahead, nodes, course):
                best = self._solved(scalar, start, orbit, best, course)
            best = self._again(scalar, best, course)
            if best is not None:
                nodes[key] = best
                self._keep(key, best)
        return course, nodes

    def _keep(self, key: Key, node: Node | None) -> None:
        with self._lock:
            best = better(self._nodes.get(key), node)
            if best is not None:
                self._nodes[key] = best

    def _again(self, scalar: Scalar, best: Node | None, course: Course) -> Node | None:
        """Search from the best design seen in the `course`, if it beats `best`.

        Return the better one of the outcome and `best`."""
        seen = min(course.seen, key=lambda one: scalar.value(one.values), default=None)
        if seen is None or self.stop.is_set():
            return best
        if best is None or scalar.value(seen.values) < best.objective - BETTER:
            return self._solved(scalar, seen.point, seen.orbit, best, course)
        return best

    def _elsewhere(self, scalar: Scalar, best: Node | None, course: Course) -> Node | None:
        """Search from the best design seen in the `course` that is distant from `best`.

        Return the better one of the outcome and `best`. With a single start (`optimizer.starts`),
        or if that design is much worse than `best` (`_PROMISING`), return `best`."""
        if best is None or self.config.optimizer.starts < 2:
            return best
        limit = best.objective + _PROMISING
        others = [
            one
            for one in course.seen
            if np.linalg.norm(one.point - best.sample.point) > APART
            and scalar.value(one.values) < limit
        ]
        seen = min(others, key=lambda one: scalar.value(one.values), default=None)
        if seen is None:
            return best
        return self._solved(scalar, seen.point, seen.orbit, best, course)

    def _solved(
        self,
        scalar: Scalar,
        start: NDArray[np.float64],
        orbit: Seeds,
        best: Node | None,
        course: Course,
    ) -> Node | None:
        """Search from `start` (d,) for the optimum of a `scalar` objective.

        `orbit`: first guess of the orbit; `course`: receives the designs of the search. Return the
        better one of the outcome and `best`."""
        if self.stop.is_set():
            return best
        samples: dict[bytes, Sample] = {}
        last: list[Seeds] = [orbit]

        def look(point: NDArray[np.float64]) -> Linearization | None:
            sample = self.study.sample(point, last[0])
            course.evaluations += 1
            self._count(evaluations=1)
            if sample is None:
                return None
            last[0] = sample.evaluation.start
            samples[point.tobytes()] = sample
            local = scalar.local(sample)
            if local.violation <= FEASIBLE:
                course.seen.append(Seen(sample.point, sample.values, sample.evaluation.start))
            return local

        stops = Stops(evaluations=self.config.optimizer.iterations + 1, asked=self.stop.is_set)
        outcome = descend(look, start, stops, self.study.problem.limits_at)
        self._count(searches=1)
        local, certificate = outcome.local, outcome.certificate
        if local is None or certificate is None or local.violation > FEASIBLE:
            return best
        sample = samples[outcome.point.tobytes()]
        return better(best, Node(scalar, sample, certificate, outcome.reason))

    def _count(self, evaluations: int = 0, searches: int = 0) -> None:
        """Count designs and searches, of all courses together, and report progress."""
        with self._lock:
            self._evaluations += evaluations
            self._searches += searches
            if searches:
                self.progress(self._searches, max(self._expected, self._searches))

    # Gaps.

    def _all(self) -> list[Node]:
        with self._lock:
            return [*self._nodes.values()]

    def _bisect(self) -> None:
        """Search between neighbours that lie far apart, as long as refinements are left."""
        self._gaps = Bisections(links([*self._nodes]))
        first = selected(self._all(), self.scale)
        self._spacing = spacing_of(first, self._gaps.pairs, len(self.study.aims), self._divisions)
        for _ in range(self.config.pareto.refinements):
            nodes = self._all()
            selection = selected(nodes, self.scale)
            wide = widest(selection.edges(self._gaps.pairs), self._spacing, self._gaps)
            if wide is None or self.stop.is_set():
                return
            self._divide(wide, nodes)

    def _divide(self, edge: Edge, nodes: Sequence[Node]) -> None:
        ends = [nodes[k] for k in edge.pair]
        values = [self.scale.of(node.sample.values) for node in ends]
        middle = np.mean(values, axis=0)
        scalar = Scalar(self.scale, middle, tuple(range(len(middle))))
        starts = [(node.sample.point, node.sample.evaluation.start) for node in ends]
        starts.append((np.mean([point for point, _ in starts], axis=0), starts[0][1]))
        begins = [(0, Seen(point, np.zeros(0), orbit)) for point, orbit in starts]
        best = self._again(scalar, self._solved_from(begins, [scalar])[0], self._course)
        if self.stop.is_set():
            return
        gaps = self._gaps
        gaps.tried[edge.pair] = gaps.tried.get(edge.pair, 0) + 1
        if best is None or not divides(edge, self.scale.of(best.sample.values), *values):
            kind = self._spacing.kind(edge)
            pair = sharpened(self, edge.pair) if kind == "terms" and len(middle) == 2 else edge.pair
            gaps.closed[pair], gaps.tried[pair] = kind, gaps.tried[edge.pair]
            return
        with self._lock:
            self._nodes[(len(self._nodes),)] = best
        gaps.divided(edge.pair, len(nodes))

    def _scaled(self, number: int) -> NDArray[np.float64]:
        return self.scale.of(self._all()[number].sample.values)

    # The result.

    def _verified(self, nodes: list[Node]) -> list[Node]:
        """Return the nodes after those on the front have been simulated again from rest.

        Their first-order conditions are checked with that simulation. If `stop` is set, the
        remaining nodes keep their standing."""
        if not nodes:
            return nodes
        kept = sorted({*selected(nodes, self.scale).kept})
        checked = self._side_by_side(lambda k: self._checked(nodes[k]), kept)
        known = dict(zip(kept, checked, strict=True))
        return [known.get(k, node) for k, node in enumerate(nodes)]

    def _checked(self, node: Node) -> Node:
        if self.stop.is_set():
            return node
        sample = self.study.verified(node.sample.point)
        self._count(evaluations=1)
        if sample is None:
            return node._replace(standing=Standing.NOT_HELD_UP)
        before = node.sample.values
        if np.any(np.abs(sample.values - before) > _HOLDS_UP * np.abs(before)):
            return node._replace(standing=Standing.NOT_HELD_UP)
        scalar = node.scalar._replace(scale=self.scale)
        certificate = certify(scalar.local(sample), sample.point)
        reason = judged(node.reason, certificate.holds(RESIDUAL, FEASIBLE))
        certified = reason == "converged"
        standing = Standing.CERTIFIED if certified else Standing.NOT_CERTIFIED
        return Node(scalar, sample, certificate, reason, node.end, standing)
