"""The state of one page of the explorer: values, results for them, and a search.

A session does not depend on the page. It reports changes by messages, from several threads."""

import dataclasses
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from rootsopt.config.plausible import notes
from rootsopt.config.reading import Config
from rootsopt.errors import InputError
from rootsopt.response.result import Evaluation
from rootsopt.view.pages.charts import motion
from rootsopt.view.pages.knobs import Engine, Shape, dotted, same_motion

if TYPE_CHECKING:
    from rootsopt.optimize.outcome import Optimization


class Latest:
    """Runs jobs one at a time in a thread of its own; the newest waiting job replaces all others.

    A slider can request jobs faster than they run. If a newer job arrives, a waiting job is
    dropped. `failed` is called with the exception of a job that raises one."""

    def __init__(self, failed: Callable[[Exception], None]):
        self._failed = failed
        self._job: Callable[[], object] | None = None
        self._due = 0.0
        self._changed = threading.Condition()
        self._closed = False
        self._began: float | None = None
        threading.Thread(target=self._work, daemon=True).start()

    def submit(self, job: Callable[[], object], delay: float = 0.0) -> None:
        """Run `job` as soon as the present one has ended, but not before `delay` (s).

        A newer job within this time replaces it."""
        with self._changed:
            self._job, self._due = job, time.monotonic() + delay
            self._changed.notify()

    def clear(self) -> None:
        """Drop the waiting job."""
        with self._changed:
            self._job = None

    def close(self) -> None:
        """Drop the waiting job, and end the thread after the present one."""
        with self._changed:
            self._job, self._closed = None, True
            self._changed.notify()

    @property
    def seconds(self) -> float:
        """Time (s) that the present job has taken so far; 0 if none is running."""
        began = self._began
        return 0.0 if began is None else time.monotonic() - began

    def _work(self) -> None:
        while (job := self._next()) is not None:
            self._began = time.monotonic()
            try:
                job()
            except Exception as error:
                self._failed(error)
            finally:
                self._began = None

    def _next(self) -> Callable[[], object] | None:
        """Wait for a job that is due and return it; `None` once the thread is to end."""
        with self._changed:
            while not self._closed:
                if self._job is None:
                    self._changed.wait()
                elif (left := self._due - time.monotonic()) > 0:
                    self._changed.wait(left)
                else:
                    job, self._job = self._job, None
                    return job
            return None


@dataclasses.dataclass(frozen=True)
class Message:
    """A change for the values with this `number`; the first values have the number 0."""

    number: int


@dataclasses.dataclass(frozen=True)
class Problem(Message):
    """The values are refused, or nothing can be computed for them. `words`: why, what to do."""

    words: str


@dataclasses.dataclass(frozen=True)
class NewShape(Message):
    """The `shape` of the rotor, and `notes` on values that are not usual."""

    shape: Shape
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class NewMotion(Message):
    """The `evaluation`, and the `frames` of its motion, as in `rootsopt.view.pages.charts`.

    `near`: whether the motion was reached from that of other values, and not from rest; `final`:
    whether the status is final. If not, a computation from rest follows."""

    evaluation: Evaluation
    frames: Mapping[str, Any]
    near: bool
    final: bool = True


@dataclasses.dataclass(frozen=True)
class FromRest(Message):
    """The motion from rest is known. `same`: whether it is the one shown; `evaluation`: its own."""

    same: bool
    evaluation: Evaluation


@dataclasses.dataclass(frozen=True)
class Progress(Message):
    """A search has simulated `done` of about `expected` designs; `best`: best objective so far."""

    done: int
    expected: int
    best: float


@dataclasses.dataclass(frozen=True)
class Searched(Message):
    """A search has ended. `outcome`: that of the search; `None`: an error, which `words` explains.

    `values`: design parameters of the optimum by key; empty if there is none."""

    outcome: "Optimization | None"
    values: Mapping[str, float]
    words: str = ""


@dataclasses.dataclass(frozen=True)
class Saved(Message):
    """The config of the values as YAML `text`."""

    text: str


class Session:
    """One page of the explorer.

    `engine`: computes everything; sessions share it. `show`: function that takes messages; it is
    called from several threads. `idle`: time (s) without a new value after which the motion is
    computed from rest."""

    def __init__(self, engine: Engine, show: Callable[[Message], None], idle: float = 0.4):
        self.engine = engine
        self.show = show
        self.idle = idle
        self.number = 0
        self.values: dict[str, float] = {}
        self.searching = threading.Event()
        self._lock = threading.Lock()
        self._start: Any = None
        self._shown: NewMotion | None = None
        self._rest: FromRest | None = None
        self._stop = threading.Event()
        self._shapes, self._motions, self._rests = (Latest(self._failed) for _ in range(3))
        self._ask(0)

    def move(self, values: Mapping[str, float]) -> int:
        """Set new `values`, numbers by dotted config key; return their number."""
        with self._lock:
            self.values |= values
            self.number = number = self.number + 1
        self._ask(number)
        return number

    def show_from_rest(self) -> None:
        """Show the motion that starts at rest, even if another one is known."""
        self._submit(self._rests, self.number, lambda number: self._from_rest(number, True))

    def save(self) -> None:
        """Make the YAML of the values, and compute their motion from rest, as `simulate` does."""
        self._submit(self._rests, self.number, self._save)

    def optimize(self) -> None:
        """Search for the optimum from the present values, in a thread of its own."""
        if self.searching.is_set():
            return
        self.searching.set()
        self._stop = threading.Event()
        threading.Thread(target=self._optimize, args=(self.number, self._stop), daemon=True).start()

    def cancel(self) -> None:
        """End the search with the best design found so far."""
        self._stop.set()

    def close(self) -> None:
        """End all threads of the session."""
        self.cancel()
        for lane in (self._shapes, self._motions, self._rests):
            lane.close()

    @property
    def seconds(self) -> float:
        """Time (s) that the present computation of the motion has taken; 0 if none is running."""
        return max(self._shapes.seconds, self._motions.seconds)

    def config(self) -> Config:
        """Return the config with the present values.

        Raises `InputError` if the values do not fit each other."""
        with self._lock:
            values: dict[str, Any] = dict(self.values)
        whole = ("profile.lobes",)
        values |= {key: int(values[key]) for key in whole if key in values}
        return self.engine.base.replaced(values) if values else self.engine.base

    def _ask(self, number: int) -> None:
        """Compute shape and motion of the values with this `number`."""
        self._motions.clear()
        self._rests.clear()
        self._submit(self._shapes, number, self._compute_shape)

    def _compute_shape(self, number: int) -> None:
        config = self.config()
        shape = self.engine.shape(config)
        self.show(NewShape(number, shape, notes(config)))
        self._submit(self._motions, number, lambda _: self._compute_motion(number, config, shape))

    def _compute_motion(self, number: int, config: Config, shape: Shape) -> None:
        self.engine.ready.wait()
        start = self._start
        near = start is not None
        evaluation = self.engine.near(config, start) if near else self.engine.from_rest(config)
        self._present(number, shape, evaluation, near, final=evaluation.usable or not near)
        if near:
            delay = self.idle if evaluation.usable else 0.0
            self._submit(self._rests, number, lambda _: self._from_rest(number, False), delay)

    def _present(
        self, number: int, shape: Shape, evaluation: Evaluation, near: bool, final: bool = True
    ) -> None:
        """Show a motion, from which others start if it is usable; arguments as in `NewMotion`."""
        if evaluation.usable:
            self._start = evaluation.start
        period = evaluation.steady_state.get("period")
        frames = motion(shape.profile, evaluation.series, period)
        self._shown = NewMotion(number, evaluation, frames, near, final)
        self.show(self._shown)

    def _from_rest(self, number: int, forced: bool) -> Evaluation | None:
        """Compute the motion from rest for the values with this `number`, and return it.

        Show it if the page shows no final motion for these values. Otherwise, report whether it is
        the motion that the page shows. `forced`: whether to show it also if they differ. Return
        `None` if newer values have replaced these."""
        if number != self.number:
            return None
        shown, known = self._shown, self._rest
        config = self.config()
        shape = self.engine.shape(config)  # refuses a profile that is not sound
        evaluation = (
            known.evaluation
            if known is not None and known.number == number
            else self.engine.from_rest(config)
        )
        if number != self.number:
            return evaluation
        same = (
            shown is not None
            and shown.number == number
            and same_motion(shown.evaluation, evaluation)
        )
        self._rest = FromRest(number, same, evaluation)
        useless = shown is None or shown.number != number or not shown.final
        if useless or (forced and not same):
            self._present(number, shape, evaluation, near=False)
        else:
            self.show(self._rest)
        return evaluation

    def _save(self, number: int) -> None:
        if self._from_rest(number, True) is not None:
            self.show(Saved(number, self.config().to_yaml()))

    def _submit(
        self, lane: Latest, number: int, work: Callable[[int], object], delay: float = 0.0
    ) -> None:
        """Run `work` for the values with this `number` in a `lane` after a `delay` (s).

        If the values are rejected, show why."""

        def refusing() -> None:
            try:
                work(number)
            except InputError as error:
                self.show(Problem(number, str(error)))

        lane.submit(refusing, delay)

    def _optimize(self, number: int, stop: threading.Event) -> None:
        outcome, values, words = None, {}, ""
        try:
            self.engine.ready.wait()
            config = self.config()
            if config.objective.over == "nominal":  # The page shows nothing of other scenes.
                config = config.replaced({"assumptions.scenes": 0})
            outcome = self.engine.optimize(
                config, lambda *told: self.show(Progress(number, *told)), stop=stop
            )
            if outcome.optimized is not None:
                values = {dotted(key): x for key, x in outcome.optimized.design.items()}
        except InputError as error:
            words = str(error)
        except Exception as error:
            words = _unexpected(error)
        self.searching.clear()
        self.show(Searched(number, outcome, values, words))

    def _failed(self, error: Exception) -> None:
        self.show(Problem(self.number, _unexpected(error)))


def _unexpected(error: Exception) -> str:
    """Return the words for an error that should not occur, and print one line about it."""
    words = f"{type(error).__name__}: {error}".splitlines()[0]
    print(f"rootsopt explore: {words}", file=sys.stderr)
    return f"The computation failed ({words}). Move the slider back, or choose other values."
