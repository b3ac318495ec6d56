"""The complete config, and the functions that read it from YAML."""

import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, SerializeAsAny, ValidationError, model_validator

from rootsopt.config.document import MOST_BYTES, override_in, read_document
from rootsopt.config.explain import explain, tree, without_removed
from rootsopt.config.families import families, family_of, is_list
from rootsopt.config.rotor import DrawingConfig, ProfileConfig, RotorConfig
from rootsopt.config.scene import ContactConfig, PumpConfig, SceneConfig, following_mm
from rootsopt.config.section import Section, bare, put, require, taken
from rootsopt.config.sources import (
    advice,
    find_installed,
    located,
    place_files,
    reason,
    regular_file,
)
from rootsopt.config.study import (
    TWIST,
    AttractorsConfig,
    ConstraintsConfig,
    EnsembleConfig,
    ObjectiveConfig,
    OptimizerConfig,
    ResponseConfig,
    SolverConfig,
)
from rootsopt.config.tolerances import (
    AssumptionsConfig,
    ParetoConfig,
    Scatter,
    Span,
    TolerancesConfig,
    mounted,
    scatterable,
    unknown_key,
)
from rootsopt.config.units import hint, placed, sentence
from rootsopt.errors import InputError

_SPEED = "scene.speed_rpm"


class Config(Section):
    """All settings of a run: the sections of a config.

    >>> import rootsopt
    >>> config = rootsopt.load_config("cic")
    >>> dict(zip(config.design_keys, config.design.tolist()))
    {'pressure_angle_deg': 36.43, 'involute_length_mm': 9.0, 'tip_arc_angle_deg': 4.0}
    """

    profile: SerializeAsAny[ProfileConfig]
    rotor: RotorConfig
    contact: ContactConfig
    scene: SceneConfig
    solver: SolverConfig = Field(default_factory=lambda: SolverConfig.model_validate({}))
    objective: ObjectiveConfig = Field(default_factory=lambda: ObjectiveConfig.model_validate({}))
    constraints: ConstraintsConfig = Field(
        default_factory=lambda: ConstraintsConfig.model_validate({})
    )
    response: ResponseConfig = Field(default_factory=lambda: ResponseConfig.model_validate({}))
    attractors: AttractorsConfig = Field(
        default_factory=lambda: AttractorsConfig.model_validate({})
    )
    ensemble: EnsembleConfig = Field(default_factory=lambda: EnsembleConfig.model_validate({}))
    pareto: ParetoConfig = Field(default_factory=lambda: ParetoConfig.model_validate({}))
    optimizer: OptimizerConfig = Field(default_factory=lambda: OptimizerConfig.model_validate({}))
    pump: PumpConfig | None = Field(None, description="absent: no leakage is reported")
    assumptions: AssumptionsConfig = Field(
        default_factory=lambda: AssumptionsConfig.model_validate({})
    )
    tolerances: TolerancesConfig | None = Field(None, description="absent: nothing scatters")
    drawing: DrawingConfig | None = Field(
        None, description="absent: the title block states only what follows from the other sections"
    )

    @model_validator(mode="before")
    @classmethod
    def _mounted(cls, data):
        return mounted(without_removed(data))

    @property
    def design(self) -> NDArray[np.float64]:
        """Design parameters as an array (d,), in the units of `design_keys`.

        They are those of the profile, and the twist if it is free."""
        twist = [self.rotor.helix_deg] if self.twist_free else []
        return np.append(self.profile.design, twist)

    @property
    def design_keys(self) -> tuple[str, ...]:
        """Names of the entries of `design`; the entries of a list are numbered from 1."""
        return self.profile.design_keys + ((TWIST,) if self.twist_free else ())

    @property
    def twist_free(self) -> bool:
        """Whether the twist of the rotors is the last design parameter.

        A rotor from a file has no design parameters; the profile fitted to it has the twist."""
        return TWIST in self.optimizer.bounds and not self.profile.from_file

    def with_design(self, design: Sequence[float] | NDArray[np.float64]) -> "Config":
        """Return a copy of the config with another `design` (d,), without checking it."""
        values, config = [float(value) for value in design], self
        if self.twist_free:
            *values, twist = values
            config = _with(config, f"rotor.{TWIST}", twist)
        return config.model_copy(update={"profile": config.profile.with_design(values)})

    def replaced(self, values: Mapping[str, Any]) -> "Config":
        """Return a copy of the config in which some `values` are replaced.

        `values`: new values by dotted key; `None`: as if the key were absent. They are checked in
        the same way as a file. Defaults that follow other keys, such as the smoothing length,
        follow the new values. Raises `InputError` for an unknown key or a value that is not
        allowed."""
        return _checked(self.plain(values))

    def check_values(self, values: Mapping[str, Any]) -> None:
        """Raise `InputError` for an unknown key, or a value that its key cannot have by itself.

        `values`: new values by dotted key. A value that merely does not fit the other values is
        accepted: `replaced` rejects it."""
        given = self._joined(values)
        data = self.plain(given)
        for key, value in given.items():
            section, _, name = key.partition(".")
            if section == "profile" and "." not in name:
                data[section] = self.profile.alone(name, value)
        try:
            Config.model_validate(data)
        except ValidationError as error:
            if message := explain(error, Config, [key.split(".") for key in given]):
                raise InputError(sentence(message)) from None

    def plain(self, values: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Return the config as plain values, from which `Config.model_validate` makes it again.

        `values`: new values by dotted key; `profile.coefficients_3` is the third entry of a list of
        design parameters. Defaults that follow other keys are left out. Raises `InputError` if a
        dotted key leads into a plain value."""
        data = self.model_dump(mode="json", exclude_none=True)
        for name, key in _FOLLOWING:
            section = getattr(self, name)
            if section is not None and key not in section.model_fields_set:
                data[name].pop(key, None)
        for key, value in self._joined(values or {}).items():
            put(data, key, value)
        return data

    def _joined(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return `values` by dotted key, with single entries of lists joined to whole lists.

        `profile.coefficients_3` names the third entry of `profile.coefficients`."""
        joined: dict[str, Any] = {}
        for key, value in values.items():
            name, _, number = key.rpartition("_")
            entry = key.removeprefix("profile.")
            if not is_list(name.removeprefix("profile.")) or entry not in self.profile.design_keys:
                joined[key] = value
                continue
            entries = [*joined.get(name, self.value(name))]
            entries[int(number) - 1] = value
            joined[name] = tuple(entries)
        return joined

    def value(self, key: str) -> Any:
        """Return the value at a dotted `key`, `None` if the config has no such key or section."""
        return functools.reduce(lambda at, part: getattr(at, part, None), key.split("."), self)

    @property
    def scatters(self) -> tuple[Scatter, ...]:
        """Distributions of the keys that scatter; empty without `tolerances`."""
        return () if self.tolerances is None else self.tolerances.scatters(scatterable(self))

    @property
    def spans(self) -> tuple[Span, ...]:
        """Ranges of assumed scene values; usual ranges that exceed a key's limits are left out.

        Empty if `assumptions.scenes` is 0."""
        if not self.assumptions.scenes:
            return ()
        own, listed = self.assumptions.over, bool(self.objective.speeds_rpm)
        return tuple(
            one
            for one in self.assumptions.spans(scatterable(self, design=False))
            if one.key in own
            or not ((listed and one.key == _SPEED) or any(self._faults(one.key, one.ends)))
        )

    def _faults(self, key: str, values: Sequence[float]) -> Iterator[str]:
        """Yield the reason for each of the `values` of a key that makes the config invalid."""
        return filter(None, (self._fault({key: value}) for value in values))

    def _fault(self, values: Mapping[str, Any]) -> str:
        """Return why other `values`, by dotted key, make the config invalid; "" if they do not."""
        alone = {"tolerances": None, "assumptions": AssumptionsConfig.model_validate({})}
        moved = self.model_copy(update=alone).moved(values)
        try:
            Config.model_validate(moved.model_dump(mode="json", exclude_none=True))
        except ValidationError as error:
            return explain(error, Config)
        return ""

    def moved(self, values: Mapping[str, Any]) -> "Config":
        """Return a copy in which some values are replaced, without checking them.

        `values`: new values by dotted key, as for `plain`. The keys exist."""
        return functools.reduce(lambda at, one: _with(at, *one), self._joined(values).items(), self)

    @property
    def load_torque(self) -> float:
        """Load torque on rotor 2 (N·m); for a gas load, an estimate of its mean."""
        load = self.scene.load
        if load.torque_N_m is not None:
            return load.torque_N_m
        assert load.pressure_difference_Pa is not None
        return self.gas_torque(load.pressure_difference_Pa)

    def gas_torque(self, pressure: float) -> float:
        """Return an estimate of the mean torque (N·m) on rotor 2 under a gas `pressure` (Pa).

        It is only used to choose scales. It assumes an outer radius of 1.4 pitch radii and an area
        efficiency of 0.45."""
        across = pressure * self.rotor.length_mm * 1e-3
        return across * (1.4 * self.profile.pitch_radius_mm * 1e-3) ** 2 * 0.45 / 2

    @model_validator(mode="after")
    def _smoothed(self):
        contact, radius = self.contact, self.profile.pitch_radius_mm
        if contact.smoothing_mm is not None:
            return self
        length = following_mm(contact, self.scene.timing_gear, self.load_torque, radius)
        return self.model_copy(update={"contact": _followed(contact, "smoothing_mm", length)})

    @model_validator(mode="after")
    def _pressed(self):
        pump, load = self.pump, self.scene.load
        if pump is None or pump.pressure_difference_Pa is not None:
            return self
        require(
            load.pressure_difference_Pa is not None,
            "`pump.pressure_difference_Pa` must be given if `scene.load` has no "
            "`pressure_difference_Pa`; add it, or remove the section `pump`",
        )
        filled = _followed(pump, "pressure_difference_Pa", load.pressure_difference_Pa)
        return self.model_copy(update={"pump": filled})

    @model_validator(mode="after")
    def _fitting(self):
        scene, profile = self.scene, self.profile
        gas = scene.load.pressure_difference_Pa is not None
        require(
            None in (scene.supports, scene.bearings) or not (self.twist_free and gas),
            "`optimizer.bounds.helix_deg` must be absent with elastic `scene.supports`, "
            "`scene.bearings` and a load `pressure_difference_Pa`: the twist moves the instant "
            "at which a pocket opens and the axes are pushed, which gradients leave out; "
            "remove one of the four",
        )
        for parameter in family_of(profile.family).parameters:
            key, sized = parameter.key, parameter.limits(profile.pitch_radius_mm)
            low, high = sized or parameter.bounds_range
            pair = self.optimizer.bounds.get(key, (low, high))
            require(
                low <= pair[0] and pair[1] <= high,
                f"`optimizer.bounds.{key}` must lie in [{low:.4g}, {high:.4g}] at "
                f"`profile.pitch_radius_mm` = {profile.pitch_radius_mm:g}, but is {[*pair]}"
                + hint(key, pair[1], low, high),
            )
        return self

    @model_validator(mode="after")
    def _scattering(self):
        tolerances = self.tolerances
        if tolerances is None:
            return self
        valid, known = scatterable(self), tree(Config)
        for key in tolerances.keys:
            require(key in valid, unknown_key(key, valid, known))
        require(
            self.objective.motion != "ensemble",
            "`tolerances` must be absent for `objective.motion` ensemble, whose averages have "
            "noise; remove `tolerances`, or set `objective.motion` to reached, worst or weighted",
        )
        self._check_speed("tolerances", tolerances.over)
        for what, values, remedy in tolerances.extremes(valid):
            fault = self._fault(values)
            require(not fault, f"{what}, but {fault}; {remedy}")
        return self

    def _check_speed(self, section: str, over: Mapping[str, Any]) -> None:
        require(
            not self.objective.speeds_rpm or _SPEED not in over,
            f"`{section}.over` must not name `{_SPEED}` if `objective.speeds_rpm` lists the "
            "speeds; remove one of them",
        )

    @model_validator(mode="after")
    def _assuming(self):
        assumptions, valid = self.assumptions, scatterable(self, design=False)
        for key in assumptions.over:
            require(key in valid, unknown_key(key, valid, tree(Config), "assumptions.over"))
        self._check_speed("assumptions", assumptions.over)
        for one in assumptions.spans(valid, every=False):
            for fault in self._faults(one.key, one.ends):
                low, high = (f"{end:.6g}" for end in one.ends)
                raise ValueError(
                    f"`assumptions.over.{one.key}` leads from {low} to {high}, but {fault}; "
                    "narrow the range"
                )
        wanted = self.objective.over == "assumptions"
        conflicts = {
            "`assumptions.scenes` must be above 0": not assumptions.scenes,
            "`tolerances` must be absent": self.tolerances is not None,
            "`objective.motion` must not be ensemble": self.objective.motion == "ensemble",
            "`profile.family` must not be outline": self.profile.from_file,
        }
        for words, met in conflicts.items():
            require(
                not (wanted and met),
                f"{words} for `objective.over` assumptions; change it, or set `objective.over` to "
                "nominal",
            )
        return self

    def to_yaml(self) -> str:
        """Return the resolved config as YAML, with every default written out."""
        data = self.model_dump(mode="json", exclude_none=True)
        return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


# Keys whose default follows other keys, each as (section, key).
_FOLLOWING = (("contact", "smoothing_mm"), ("pump", "pressure_difference_Pa"))


def _followed(section: Any, key: str, value: Any) -> Any:
    """Return a copy of a section with the default `value` of a key that follows other keys.

    The key is not in `model_fields_set`, which therefore holds only keys that the user gave."""
    copy = section.model_copy(update={key: value})
    copy.model_fields_set.discard(key)
    return copy


def _with(config: Any, key: str, value: Any) -> Any:
    """Return a copy of a config section in which the entry at a dotted key is `value`."""
    name, _, rest = key.partition(".")
    inner = _with(getattr(config, name), rest, value) if rest else value
    return config.model_copy(update={name: inner})


def load(path: str | Path, overrides: list[str] | tuple[str, ...] = ()) -> Config:
    """Read a config file from `path`, apply `overrides`, and return the config.

    `path`: a YAML file, or the name of a shipped config, such as "cic"; `overrides`: texts of the
    form `dotted.key=value`, as for `--set`. Raises `InputError` if the file, a key or a value is
    wrong.

    >>> import rootsopt
    >>> rootsopt.load_config("cic", ["scene.speed_rpm=2500"]).scene.speed_rpm
    2500.0
    """
    path = located(Path(path))
    return parse(_read(path), overrides, source=str(path), folder=path.parent)


def parse(
    text: str,
    overrides: list[str] | tuple[str, ...] = (),
    source: str = "config",
    folder: str | Path = ".",
) -> Config:
    """Read a config from YAML `text`, apply `overrides`, and return the config.

    `overrides`: texts of the form `dotted.key=value`. `source`: name of the text in messages. Paths
    in the text are relative to `folder`; paths in `overrides` are relative to the current folder.
    The returned config has absolute paths.

    Raises `InputError` if the text, a key or a value is wrong."""
    name = placed(source)
    data = read_document(text, name)
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise InputError(
            f"{name}: must hold sections such as `profile:` and `scene:`, but is a "
            f"{type(data).__name__}"
        )
    place_files(data, Path(folder))
    for override in overrides:
        override_in(data, override)
    place_files(data, Path())
    _find_family(data)
    return _checked(data, f"{name}: ")


def _checked(data: dict, prefix: str = "") -> Config:
    """Return the config of plain values. `prefix`: start of the message of an error."""
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        message = explain(error, Config, speed_rpm=taken(data, _SPEED))
        raise InputError(sentence(f"{prefix}{message}")) from None


def _find_family(data: dict) -> None:
    """Load the installed package that offers the config's family.

    `data`: the config as plain values. Do nothing if the family is already registered."""
    name = taken(data, "profile.family")
    if isinstance(name, str) and bare(name) not in map(bare, families()):
        find_installed(name)


def _read(path: Path) -> str:
    name = placed(path)
    regular_file(path, "a config")
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except FileNotFoundError:
        raise InputError(f"{name}: there is no such file; {advice(path)}") from None
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {reason(error)}") from None
    except ValueError:  # A path with a null character.
        raise InputError(f"{name}: is not a path; give that of a config file") from None
    try:
        # Text that is too long may be cut inside a character; `read_document` rejects its length.
        return data.decode("utf-8", "strict" if len(data) <= MOST_BYTES else "replace")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{name}: is not UTF-8 text (byte {error.start}); save it as UTF-8"
        ) from None
