"""The whole config, read from YAML."""

import difflib
import re
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, Field, ValidationError, model_validator

from rootsopt.config.scene import ContactConfig, ProfileConfig, RotorConfig, SceneConfig
from rootsopt.config.section import Section
from rootsopt.config.smoothing import following_mm
from rootsopt.config.study import (
    AttractorsConfig,
    ConstraintsConfig,
    EnsembleConfig,
    ObjectiveConfig,
    OptimizerConfig,
    ResponseConfig,
    SolverConfig,
    SweepConfig,
)
from rootsopt.errors import InputError


class Config(Section):
    """Everything a run needs."""

    profile: ProfileConfig
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
    sweep: SweepConfig = Field(default_factory=lambda: SweepConfig.model_validate({}))
    optimizer: OptimizerConfig = Field(default_factory=lambda: OptimizerConfig.model_validate({}))

    @property
    def needs_search(self) -> tuple[str, ...]:
        """Keys that need what only a search has: the place of contact, any pair of flanks."""
        parts = {
            "contact.friction": self.contact.friction,
            "scene.supports": self.scene.supports,
            "scene.center_distance_error_mm": self.scene.center_distance_error_mm,
            "profile.outline_file": self.profile.outline_file,
        }
        return tuple(key for key, part in parts.items() if part is not None)

    @property
    def load_torque(self) -> float:
        """Torque against rotor 2 (N·m); of a gas load about the mean, for units alone: with an
        outer radius of 1.4 pitch radii and an area efficiency of 0.45."""
        load = self.scene.load
        if load.torque_N_m is not None:
            return load.torque_N_m
        assert load.pressure_difference_Pa is not None
        across = load.pressure_difference_Pa * self.rotor.length_mm * 1e-3
        return across * (1.4 * self.profile.pitch_radius_mm * 1e-3) ** 2 * 0.45 / 2

    @model_validator(mode="after")
    def _smoothed(self):
        contact, gear = self.contact, self.scene.timing_gear
        if contact.smoothing_mm is not None:
            return self
        law = contact.stiffness_N_per_mm_e, contact.exponent, contact.full_damping_depth_mm
        length = following_mm(
            self.load_torque,
            self.profile.pitch_radius_mm,
            None if gear is None else gear.stiffness_N_m_per_rad,
            law,
            self.solver.precision,
        )
        return self.model_copy(
            update={"contact": contact.model_copy(update={"smoothing_mm": length})}
        )

    @model_validator(mode="after")
    def _searched(self):
        fidelity = self.solver.fidelity
        if self.needs_search and fidelity not in ("search", "auto"):
            raise ValueError(
                f"`solver.fidelity` must be search (or auto) with `{self.needs_search[0]}`, which "
                f"needs what only a search has, but is {fidelity}"
            )
        return self

    def to_yaml(self) -> str:
        """The resolved config, every default written out."""
        data = self.model_dump(mode="json", exclude_none=True)
        return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)


class _Loader(yaml.SafeLoader):
    """YAML with `1e5` as a number and without silently overwritten keys."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            try:
                repeated = key in seen
            except TypeError:
                raise yaml.constructor.ConstructorError(
                    None, None, f"a key must be a plain name, but is {key!r}", key_node.start_mark
                ) from None
            if repeated:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} stands twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^[-+]?(?:[0-9][0-9_]*\.?[0-9_]*(?:[eE][-+]?[0-9]+)|[0-9][0-9_]*\.[0-9_]*"
        r"|\.[0-9_]+(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
    list("-+0123456789."),
)


def load(path: str | Path, overrides: list[str] | tuple[str, ...] = ()) -> Config:
    """Read a config file and apply `dotted.key=value` overrides.

    Raises `InputError` for anything wrong with file, keys or values.
    """
    return parse(_read(Path(path)), overrides, source=str(path), folder=Path(path).parent)


def parse(
    text: str,
    overrides: list[str] | tuple[str, ...] = (),
    source: str = "config",
    folder: str | Path = ".",
) -> Config:
    """Like `load`, from YAML text. Files that it names are relative to `folder`, those that
    `overrides` name to the current folder; the config has absolute paths."""
    data = _yaml(text, source)
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise InputError(
            f"{source}: must hold sections such as `profile:` and `scene:`, but is a "
            f"{type(data).__name__}"
        )
    _place_files(data, Path(folder))
    for override in overrides:
        _override(data, override)
    _place_files(data, Path())
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{source}: {_explain(error)}") from None


def _place_files(data: dict, folder: Path) -> None:
    """Make paths of files absolute that are relative to `folder`."""
    profile = data.get("profile")
    if isinstance(profile, dict) and isinstance(profile.get("outline_file"), str):
        profile["outline_file"] = str((folder / profile["outline_file"]).absolute())


def _read(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; give the path of a config") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; give the path of a config file") from None
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None


def _yaml(text: str, source: str) -> Any:
    try:
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f" (line {mark.line + 1})" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise InputError(f"{source}: is not valid YAML{place}: {problem}") from None


def _override(data: dict, override: str) -> None:
    key, equals, value = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise InputError(
            f"--set {override!r}: must be dotted.key=value, as in scene.speed_rpm=1500"
        )
    target = data
    for i, part in enumerate(parts[:-1]):
        inner = target.get(part)
        if inner is None:
            inner = target[part] = {}
        if not isinstance(inner, dict):
            raise InputError(f"--set {override!r}: `{'.'.join(parts[: i + 1])}` holds no keys")
        target = inner
    target[parts[-1]] = _yaml(value, f"--set {override!r}")


def _explain(error: ValidationError) -> str:
    """One sentence for the first, most telling problem."""
    problems = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    first = problems[0]
    place = [str(p) for p in first["loc"] if not _is_branch(p)]
    key = ".".join(place)
    kind, value, context = first["type"], first.get("input"), first.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown(place)
    if kind == "missing":
        field = _field(place)
        note = f" ({field.description})" if field is not None and field.description else ""
        return f"`{key}` is missing{note}; add it"
    if kind == "value_error":
        return str(context["error"])
    return f"`{key}` must be {_allowed(kind, context, first['msg'])}, but is {value!r}"


def _is_branch(part) -> bool:
    """Whether a part of a pydantic location names a union branch rather than a key."""
    text = str(part)
    return "[" in text or text in ("float", "int", "tuple")


def _allowed(kind: str, context: dict, message: str) -> str:
    words = {
        "float_type": "a number",
        "float_parsing": "a number",
        "int_type": "a whole number",
        "int_from_float": "a whole number",
        "finite_number": "a finite number",
        "model_type": "a section with keys of its own",
        "string_type": "a word",
        "dict_type": "keys with values, as {a: 1, b: 2}",
        "tuple_type": "a list of numbers, as [1, 2]",
    }
    if kind in words:
        return words[kind]
    signs = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
    for name, word in signs.items():
        if name in context:
            return f"{word} {context[name]:g}"
    if kind == "literal_error":
        return f"one of {context['expected']}"
    return message[0].lower() + message[1:]


def _section(place: list[str]) -> type[BaseModel] | None:
    model: type[BaseModel] | None = Config
    for part in place:
        field = model.model_fields.get(part) if model is not None else None
        if field is None:
            return None
        model = _model_of(field.annotation)
    return model


def _model_of(annotation: Any) -> type[BaseModel] | None:
    candidates = [annotation, *getattr(annotation, "__args__", ())]
    for candidate in candidates:
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def _field(place: list[str]):
    model = _section(place[:-1])
    return model.model_fields.get(place[-1]) if model is not None else None


def _unknown(place: list[str]) -> str:
    key = ".".join(place)
    model = _section(place[:-1])
    names = list(model.model_fields) if model is not None else []
    near = difflib.get_close_matches(place[-1], names, n=1, cutoff=0.5)
    elsewhere = [k for k in _all_keys(Config) if k.split(".")[-1] == place[-1]]
    if elsewhere:
        return f"`{key}` is not a known key; did you mean `{elsewhere[0]}`?"
    if near:
        return f"`{key}` is not a known key; did you mean `{'.'.join([*place[:-1], near[0]])}`?"
    return f"`{key}` is not a known key; valid here: {', '.join(names)}"


def _all_keys(model: type[BaseModel], prefix: str = ""):
    for name, field in model.model_fields.items():
        inner = _model_of(field.annotation)
        yield f"{prefix}{name}"
        if inner is not None:
            yield from _all_keys(inner, f"{prefix}{name}.")


def describe_keys() -> str:
    """One line per key with unit and meaning, for `--help`."""
    lines = []
    for key in _all_keys(Config):
        place = key.split(".")
        field = _field(place)
        if field is None or _model_of(field.annotation) is not None:
            continue
        lines.append(f"  {key:<42} {field.description or ''}".rstrip())
    return "\n".join(lines)
