"""The table of profile families, with the name, parameters, limits, bounds and help of each family.

A family is one `Family` object. `register_family` adds it to the table; the built-in families
(`rootsopt.config.catalogue`) are added in the same way. The table determines config keys, `--help`,
messages, the optimiser's bounds and the checks that a profile is sound. Nothing here needs JAX: a
function that makes profiles may be named as "module:function" and is loaded when first needed.
"""

import dataclasses
import functools
import inspect
import pkgutil
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from rootsopt.config.section import Listed, bare, between, require
from rootsopt.config.units import si_unit

if TYPE_CHECKING:
    from rootsopt.config.rotor import ProfileConfig

MARGINS = (
    *("turning", "convexity", "reach", "fall", "rolling", "order", "undercut", "star", "root"),
)
"""Names of the margins that are ≥ 0 in a sound profile (see `rootsopt.profiles.soundness`)."""
FREE_FORM = "free_form"
"""Name of the family whose members can approximate any profile."""
RESERVED: set[str] = set()
"""Keys that cannot be parameters, because the config uses them otherwise: added where they are
defined."""
EXAMPLE_RADIUS = 33.0
"""Pitch radius (mm) of the rotors in `Family.example`."""

# Usual range of a length (pitch radii), of an angle (°) and of a plain number.
#
# They apply to parameters that specify no usual range.
_ANY_LENGTH, _ANY_ANGLE, _ANY_NUMBER = (0.01, 1.5), (0.0, 90.0), (0.0, 2.0)

# Default bounds of a parameter without a usual range, as multiples of the config's own value.
_AROUND = (0.5, 1.5)
_WORD = re.compile(r"[a-z][a-z0-9_]*")

Pair = tuple[float, float]
Hook = Callable[..., Any] | str
"""A function, or the text "module:function" from which it is imported when first needed."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A design parameter in the config, shared by all families that use its key.

    `key`: name in the config; it ends in the unit, `_mm` or `_deg`, if there is one.
    `help`: meaning, in a few words.
    `lowest`, `highest`: least and greatest value in a config.
    `below`: whether values must be less than `highest`, rather than at most `highest`.
    `radii`: least and greatest value in pitch radii, for a length that scales with the rotor.
    `usual`: usual range, in pitch radii if `radii` is given; also the default bounds of an
    optimisation. `None`: the default bounds are 0.5 to 1.5 times the config's own value.
    `default_bounds`: default bounds that replace `usual` and are written out in every config.
    `bounds_limits`: limits of the bounds, if they are narrower than `lowest` and `highest`.
    `bounds_note`: text for `--help` that replaces the generated description of the default bounds.
    `count`: least and greatest number of entries, if the key holds a list. `None`: a single number.
    `floor`: default lower bound of a parameter in `Family.ranges`, as a fraction of the upper end
    of its range. Bounds in the config replace it.

    >>> import rootsopt
    >>> angle = rootsopt.Parameter("crossing_angle_deg", "pressure angle at the crossing", 0, 80)
    >>> angle.argument, round(angle.unit, 5)
    ('crossing_angle', 0.01745)
    """

    key: str
    help: str
    lowest: float
    highest: float
    below: bool = False
    radii: Pair | None = None
    usual: Pair | None = None
    default_bounds: Pair | None = None
    bounds_limits: Pair | None = None
    bounds_note: str = ""
    count: tuple[int, int] | None = None
    floor: float = 0.0

    @property
    def argument(self) -> str:
        """Name of the argument of `Family.maker` for this key: the key without its unit."""
        return self.key.removesuffix("_mm").removesuffix("_deg")

    @property
    def unit(self) -> float:
        """SI value of one unit of the key, for example 1e-3 for a key in mm."""
        return si_unit(self.key)

    def limits(self, pitch_radius_mm: float) -> Pair | None:
        """Return the least and greatest length (mm) allowed at this pitch radius (mm).

        Return `None` if the limits do not depend on the pitch radius."""
        if self.radii is None:
            return None
        return self.radii[0] * pitch_radius_mm, self.radii[1] * pitch_radius_mm

    def usually(self, pitch_radius_mm: float, lobes: int) -> Pair:
        """Return the usual range (low, high), in the key's unit.

        `pitch_radius_mm`, `lobes`: pitch radius (mm) and number of lobes of the rotor."""
        if self.usual is not None and self.radii is None:
            return self.usual
        if self.usual is not None or self.key.endswith("_mm"):
            low, high = self.usual or _ANY_LENGTH
            return low * pitch_radius_mm, high * pitch_radius_mm
        return _ANY_ANGLE if self.key.endswith("_deg") else _ANY_NUMBER

    def bounds(self, profile: "ProfileConfig") -> Pair:
        """Return the default bounds (low, high) for this `profile`, in the key's unit.

        They apply if neither the config nor `default_bounds` gives bounds."""
        if self.usual is not None:
            return self.usually(profile.pitch_radius_mm, profile.lobes)
        value = abs(getattr(profile, self.key))
        return _AROUND[0] * value, _AROUND[1] * value

    def check_bounds(self, bounds: Pair, lobes: int) -> None:
        """Raise `InputError` for bounds that are impossible with this number of lobes.

        `bounds`: (low, high) in the key's unit. This method accepts all bounds; a subclass may
        reject some."""

    def field(self, families: Iterable[str]) -> tuple[Any, Any]:
        """Return (annotation, pydantic field) of the key.

        The field's description names the `families` that use the key."""
        limits = between(self.lowest, self.highest)
        if self.below:
            limits = Field(ge=self.lowest, lt=self.highest)
        kind: Any = Annotated[float, limits]
        if self.count is not None:
            least, most = self.count
            kind = Annotated[tuple[kind, ...], Field(min_length=least, max_length=most), Listed]
        text = f"{', '.join(families)}: {self.help} (bounds: {self._bounds_words()})"
        return kind | None, Field(None, description=text)

    @property
    def bounds_range(self) -> Pair:
        """Least and greatest bound in a config."""
        return self.bounds_limits or (self.lowest, self.highest)

    def _bounds_words(self) -> str:
        pair, most = self.default_bounds or self.usual, self.bounds_limits
        text = "default: 0.5 to 1.5 times the config's own value"
        if pair is not None:
            size = " pitch radii" if self.radii and not self.default_bounds else ""
            text = f"default: {pair[0]:g} to {pair[1]:g}{size}"
        limits = f"; from {most[0]:g} to {most[1]:g}" if most else ""
        return (self.bounds_note or text) + limits


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Family:
    """A profile family: its config keys and how its profiles are made.

    `name`: word in `profile.family`. `help`: one line on the curves of its addendum.

    `maker`: function that returns a `Profile` from `lobes`, `pitch_radius` (m) and the parameters
    in SI units. Each parameter is passed under its key without the unit, as in `maker(lobes,
    pitch_radius, arc_center=0.03)`. `None`: the profile is read from a file.

    `parameters`: design parameters, in the order of their values in a design. A parameter whose
    value is a list comes last.

    `example`: values, by key, of a sound design with three lobes and a pitch radius of 33 mm.

    `remedy`: advice on what to change if a profile is not sound. It completes a sentence, without a
    full stop.

    `inherent`: names of margins from `MARGINS` that may be negative in this family.

    `limits`: function of the `ProfileConfig` that raises `InputError` if the profile violates a
    closed-form limit. `by_limits`: whether these limits keep a search at sound profiles, so that
    the margins need no constraints.

    `ranges`: function of `lobes`, `pitch_radius_mm` and all parameters by key. It returns (low,
    high) by key for parameters whose range depends on the others: all values of sound profiles. The
    optimiser searches such a parameter as a fraction of this range, within its bounds.

    A subclass may override `make`, `check` and `dependent` instead of providing functions.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> from rootsopt.profiles import EE
    >>> family = rootsopt.Family(name="plain", help="epicycloid and hypocycloid", maker=EE)
    >>> family.make(3, 0.033).lobes
    3
    """

    name: str
    help: str
    maker: Hook | None
    parameters: tuple[Parameter, ...] = ()
    example: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    remedy: str = ""
    inherent: frozenset[str] = frozenset()
    limits: Hook | None = None
    by_limits: bool = False
    ranges: Hook | None = None

    @property
    def keys(self) -> tuple[str, ...]:
        """Config keys of the parameters."""
        return tuple(parameter.key for parameter in self.parameters)

    def split(self, design: Any) -> list[Any]:
        """Split a design (d,) into one entry per parameter.

        An entry is a number, or an array if the key holds a list."""
        places = enumerate(self.parameters)
        return [design[k] if one.count is None else design[k:] for k, one in places]

    @property
    def classical(self) -> bool:
        """Whether every parameter is a single number, and the profile is not read from a file."""
        lists = any(parameter.count is not None for parameter in self.parameters)
        return self.maker is not None and not lists

    @property
    def fitted(self) -> bool:
        """Whether members with design parameters can be fitted to an outline.

        They can for classical families, and for the free form."""
        return self.name == FREE_FORM or (self.classical and bool(self.parameters))

    def make(self, lobes: int, pitch_radius: Any, **parameters: Any) -> Any:
        """Return the `Profile` with this number of lobes, `pitch_radius` (m) and `parameters`.

        `parameters`: values in SI units, under their keys without units. Raises `TypeError` for a
        family whose profiles are read from files."""
        return _resolved(self.maker)(lobes, pitch_radius, **parameters)

    def check(self, profile: "ProfileConfig") -> None:
        """Raise `InputError` if a profile violates a closed-form limit."""
        if self.limits is not None:
            _resolved(self.limits)(profile)

    def dependent(self, lobes: int, pitch_radius_mm: Any, **values: Any) -> Mapping[str, Any]:
        """Return {key: (low, high)} for the parameters whose range depends on the others.

        `pitch_radius_mm`: pitch radius (mm); `values`: all parameters by key. Values and ranges are
        in the units of the keys."""
        if self.ranges is None:
            return {}
        return _resolved(self.ranges)(lobes, pitch_radius_mm, **values)


_families: dict[str, Family] = {}
_origins: dict[str, str] = {}


def register_family(family: Family) -> Family:
    """Add a family to the table of profile families, and return it.

    Configs, commands and the optimiser use this table. Raises `ValueError` if the family is
    incomplete, its name is taken, or one of its keys has another meaning in another family.

    >>> import jax
    >>> import rootsopt
    >>> jax.config.update("jax_enable_x64", True)
    >>> from rootsopt.profiles import EE
    >>> family = rootsopt.Family(name="plain_ee", help="epicycloid and hypocycloid", maker=EE)
    >>> _ = rootsopt.register_family(family)
    >>> rootsopt.load_config("ee", ["profile.family=plain_ee"]).profile.family
    'plain_ee'
    """
    _check(family)
    _families[family.name] = family
    _origins[family.name] = sys._getframe(1).f_globals.get("__name__", "")
    return family


def families() -> dict[str, Family]:
    """Return all registered families by name."""
    return dict(_families)


def family_of(name: str) -> Family:
    """Return the registered family of this name; raises `KeyError` if there is none."""
    return _families[name]


def parameters() -> dict[str, Parameter]:
    """Return the parameters of all registered families by key."""
    return {one.key: one for family in _families.values() for one in family.parameters}


def is_list(key: str) -> bool:
    """Return whether a key holds a list of design parameters rather than a single number."""
    parameter = parameters().get(key)
    return parameter is not None and parameter.count is not None


def users_of(key: str) -> list[str]:
    """Return the names of the families that have a parameter with this key."""
    return [family.name for family in _families.values() if key in family.keys]


def is_shipped(name: str) -> bool:
    """Return whether the family of this name is one of the package's own."""
    return _origins[name].partition(".")[0] == __name__.partition(".")[0]


def outside_modules() -> set[str]:
    """Return the names of modules outside this package on which profiles may depend.

    These are the modules that register families or define their functions, and all modules imported
    from the folders of these modules."""
    names = set(_origins.values())
    for family in _families.values():
        for hook in (family.maker, family.limits, family.ranges, type(family)):
            while isinstance(hook, functools.partial):
                hook = hook.func
            named = hook.partition(":")[0] if isinstance(hook, str) else None
            names.add(named or getattr(hook, "__module__", None) or "")
    own = __name__.partition(".")[0]
    names = {name for name in names - {""} if name.partition(".")[0] != own}
    folders = {path.parent for name in names if (path := _file(name)) and not _installed(path)}
    if not folders:
        return names
    loaded = ((name, _file(name)) for name in list(sys.modules))
    return names | {
        name
        for name, path in loaded
        if path and not _installed(path) and not folders.isdisjoint(path.parents)
    }


def _file(module: str) -> Path | None:
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file) if file else None


def _installed(path: Path) -> bool:
    return not {"site-packages", "dist-packages"}.isdisjoint(path.parts)


def _resolved(hook: Hook | None) -> Callable[..., Any]:
    if isinstance(hook, str):
        return pkgutil.resolve_name(hook)
    if hook is None:
        raise TypeError("a family that reads its profiles from files cannot make one")
    return hook


def _check(family: Family) -> None:
    """Raise `ValueError` if a family is incomplete, or has a name or a key that is taken."""
    name, keys, made = family.name, family.keys, family.maker is not None
    for parameter in family.parameters:
        _check_parameter(parameter)
    if taken := next((one for one in _families if bare(one) == bare(name)), None):
        raise ValueError(
            f"Argument `family` must have a new name, but {taken} is taken; choose another one, or "
            "restart Python to change a family: compiled programs are kept under its name"
        )
    listed = ", ".join(keys)
    unknown = ", ".join(sorted(family.inherent - {*MARGINS}))
    beyond, value = next(_beyond(family), ("", None))
    lists = [parameter.count is not None for parameter in family.parameters]
    silent = made and bool(keys) and not family.by_limits and not family.remedy
    foreign = made and {*family.example} != {*keys}
    wanted = ", ".join(("lobes", "pitch_radius", *(one.argument for one in family.parameters)))
    unfit = _unfit(family)
    for wrong, argument, must, actual in (
        (not _WORD.fullmatch(name), "name", "be lower-case letters, digits and _", name),
        (len(set(keys)) < len(keys), "parameters", "have every key once", listed),
        (any(lists[:-1]), "parameters", "have a list of numbers last", listed),
        (unknown, "inherent", f"be among {', '.join(MARGINS)}", unknown),
        (silent, "remedy", "say what to change if a profile is not sound", "empty"),
        (foreign, "example", f"have the keys {listed}", ", ".join(family.example)),
        (beyond, "example", f"respect the limits of {beyond}", value),
        (unfit, "maker", f"take the arguments {wanted}", f"a function with {unfit}"),
    ):
        if wrong:
            raise ValueError(f"Argument `{argument}` of a family must {must}, but is {actual}")


def _beyond(family: Family) -> Iterator[tuple[str, Any]]:
    """Yield (key, value) of each number in a family's example that its key does not allow."""
    for parameter in family.parameters:
        given = family.example.get(parameter.key, ())
        for value in given if isinstance(given, tuple | list) else (given,):
            if not parameter.lowest <= value <= parameter.highest:
                yield parameter.key, value


def _unfit(family: Family) -> str:
    """Return why a family's maker cannot be called with its parameters, or "" if it can."""
    if not callable(family.maker):
        return ""
    try:
        inspect.signature(family.maker).bind(0, 0, **{one.argument: 0 for one in family.parameters})
    except TypeError as error:
        return str(error)
    return ""


def _check_parameter(parameter: Parameter) -> None:
    key = parameter.key
    require(
        _WORD.fullmatch(key) is not None,
        f"Argument `key` of a parameter must be lower-case letters, digits and _, but is {key!r}",
    )
    require(
        key not in RESERVED,
        f"Argument `key` of a parameter must be a new one, but {key} is reserved",
    )
    require(
        parameter.lowest < parameter.highest,
        f"Arguments `lowest` and `highest` of {key} must be increasing, but are "
        f"{parameter.lowest:g} and {parameter.highest:g}",
    )
    require(
        parameters().get(key, parameter) == parameter,
        f"Argument `key` of a parameter must have one meaning, but {key} of "
        f"{', '.join(users_of(key))} has another one; take that (`parameters()[{key!r}]`), or "
        "choose another key",
    )
