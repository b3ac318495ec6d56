"""Computes what the explorer shows: the geometry of a config, and its motion near a known one."""

import dataclasses
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rootsopt.config import Config
from rootsopt.config.units import MM
from rootsopt.profiles import Geometry, Profile, geometry, outline
from rootsopt.response.evaluation import Evaluation, Evaluator
from rootsopt.response.records import Series, geometry_record
from rootsopt.response.reducers import alone
from rootsopt.response.starts import Seeds
from rootsopt.runtime.programs import CachedFunction
from rootsopt.scene import Scene, check_geometry, design_vector
from rootsopt.view.pages.charts import motion, rotor

if TYPE_CHECKING:
    from rootsopt.optimize.outcome import Optimization

# Number of points of a drawn outline, as in the CSV files of the other commands.
_POINTS = 240

# Greatest number of revolutions shown of a motion.
_TURNS = 4

# Relative difference of mean, peak and RMS force below which two motions count as the same.
_AGREES = 1e-3


class Shape(NamedTuple):
    """Geometry of a config.

    `outline` (n, 2): closed outline (mm); `record`: the entry `geometry` of the result file;
    `pair`: the rotor, and its frames in perfect rolling, as in `rootsopt.view.pages.charts`;
    `profile`: the profile itself."""

    outline: NDArray[np.float64]
    record: dict[str, float]
    pair: dict[str, Any]
    profile: Profile


class Engine:
    """Evaluates configs that differ little from a first one, `given`.

    `optimize`: the main job, `rootsopt.optimize_design`; handed in, as what is shown of a run does
    not depend on how designs are searched.

    Several sessions in several threads can share an engine. `ready` is set once the first config
    has been evaluated, so that its programs are compiled."""

    def __init__(self, given: Config, optimize: Callable[..., "Optimization"]):
        self.given, self.optimize = given, optimize
        self.ready = threading.Event()
        self._base: Config | None = None
        self._lock = threading.Lock()

    @property
    def base(self) -> Config:
        """The config that the sliders change: `given` at the scene's own speed only."""
        with self._lock:
            if self._base is None:
                check_geometry(self.given)
                self._base = alone(self.given)
            return self._base

    def shape(self, config: Config) -> Shape:
        """Return the geometry of a `config`.

        Raises `InputError` if its profile is not sound."""
        check_geometry(config)
        scene = Scene.from_config(config)
        profile, record = _shape(scene, design_vector(config))
        shown = np.asarray(outline(profile, points=_POINTS)) / MM
        pair = {"rotor": rotor(config, shown[::4]), "motion": motion(profile)}
        return Shape(shown, geometry_record(scene, record), pair, profile)

    def near(self, config: Config, start: Seeds) -> Evaluation:
        """Return the evaluation of a `config` from the `start` of a similar one.

        It is quick: the motion is not confirmed by an integration, and a motion that does not
        settle is given up after a quarter of the allowed transient."""
        return Evaluator.of(config).surveying().unconfirmed()(start=start)

    def from_rest(self, config: Config) -> Evaluation:
        """Return the evaluation of a `config` from rest, as `rootsopt simulate` computes it."""
        return Evaluator.of(config)()

    def prepare(self) -> None:
        """Compile the programs in this thread, and set `ready`."""
        config = self.base
        evaluator = Evaluator.of(config).unconfirmed()
        evaluator.prepare()
        self.shape(config)
        found = evaluator()
        if found.usable:
            self.near(config, found.start)
        self.ready.set()


@CachedFunction
def _shape(scene: Scene, design) -> tuple[Profile, Geometry]:
    """Return profile and geometry of a design (d,) in config units."""
    profile = scene.profile(design)
    return profile, geometry(profile)


def frames(profile: Profile, evaluation: Evaluation) -> dict[str, Any]:
    """Return the frames of the motion of an `evaluation`; those of rolling if it has no series."""
    return motion(profile, evaluation.series, evaluation.steady_state.get("period"))


def cut(series: Series) -> Series:
    """Return the first revolutions of a long motion."""
    kept = series.rotation - series.rotation[0] < 2 * np.pi * _TURNS
    given = ((one.name, getattr(series, one.name)) for one in dataclasses.fields(series))
    values: dict[str, Any] = {name: None if x is None else x[kept] for name, x in given}
    return Series(**values)


def same_motion(one: Evaluation, other: Evaluation) -> bool:
    """Return whether two evaluations of a config describe the same motion, by their forces."""
    if one.status is not other.status or one.response.keys() != other.response.keys():
        return False
    pairs = ((value, other.response[name]) for name, value in one.response.items())
    return all(abs(a - b) <= _AGREES * max(abs(a), abs(b), 1e-12) for a, b in pairs)
