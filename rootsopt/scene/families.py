"""Makes and checks profiles from family names, keys and units as they appear in a config."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rootsopt.config.families import families, family_of, is_shipped
from rootsopt.config.rotor import ProfileConfig
from rootsopt.config.units import DEG, MM, shown
from rootsopt.errors import InputError
from rootsopt.measured.conjugacy import conjugacy
from rootsopt.profiles import Outline, Profile, project
from rootsopt.profiles.geometry import departure
from rootsopt.profiles.soundness import Soundness, soundness
from rootsopt.runtime.environment import say
from rootsopt.runtime.programs import CachedFunction

# Number of operations per point of a flank above which a family gets a note.
_MOST_OPERATIONS = 1500
# Units of margins that are not lengths: name of the unit, and its SI value.
_UNITS = {"turning": ("deg", DEG), "order": ("deg", DEG), "rolling": ("", 1.0), "limits": ("", 1.0)}


def classical() -> tuple[str, ...]:
    """Return the names of the registered families whose parameters are single numbers.

    Families with a list of parameters, or with a file, are left out."""
    return tuple(name for name, family in families().items() if family.classical)


def profile_of(
    family: str, lobes: int, pitch_radius: Float[Array, ""], design: Float[Array, " d"]
) -> Profile:
    """Return the profile of a `family` with a `design` (d,) in config units.

    `lobes`: number of lobes; `pitch_radius`: pitch radius (m)."""
    definition = family_of(family)
    values = {
        parameter.argument: value * parameter.unit
        for parameter, value in zip(definition.parameters, definition.split(design), strict=True)
    }
    return definition.make(lobes, pitch_radius, **values)


def arguments_of(
    config: ProfileConfig,
) -> tuple[str, int, Float[Array, ""], Float[Array, " d"]]:
    """Return the arguments of `profile_of` for the profile of a config."""
    size = jnp.asarray(config.pitch_radius_mm * MM)
    return config.family, config.lobes, size, jnp.asarray(config.design)


def free_form_of(config: ProfileConfig, count: int) -> tuple[ProfileConfig, float]:
    """Return (config of a free form fitted to a profile, greatest distance (m) between the flanks).

    `config`: config of the given profile; `count`: number of coefficients. Raises `InputError` for
    an outline from a file."""
    if config.from_file:
        raise InputError(
            "`profile.family` must not be read from a file for a projection onto a free form, but "
            f"is {config.family}: unlike that of a free form, its dedendum need not be conjugate "
            "to its addendum; set the family by which the rotor was designed"
        )
    profile = profile_of(*arguments_of(config))
    free_form = project(profile, count)
    # These decimals keep the outline within 0.01 µm.
    result = ProfileConfig.model_validate(
        {
            "family": "free_form",
            "lobes": config.lobes,
            "pitch_radius_mm": config.pitch_radius_mm,
            "tip_arc_angle_deg": round(float(free_form.tip_arc_angle) / DEG, 9),
            "coefficients": tuple(round(float(c), 6) for c in free_form.coefficients),
        }
    )
    return result, departure(profile, profile_of(*arguments_of(result)))


def profile_from_file(config: ProfileConfig) -> Outline | None:
    """Return the profile of a config that names an outline file, `None` for any other config.

    Raises `InputError` if the file does not hold a usable outline."""
    if not config.from_file:
        return None
    from rootsopt.measured.source import outline_of  # Imported for outlines only: it takes 0.5 s.

    return outline_of(config)[0]


def check(config: ProfileConfig) -> None:
    """Raise `InputError` unless the profile is sound.

    A profile read from a file is sound if the file holds a usable outline and the flanks face each
    other somewhere in the mesh."""
    if (given := profile_from_file(config)) is not None:
        conjugacy(given)
        return
    family = family_of(config.family)
    family.check(config)
    allowed = dict.fromkeys(family.inherent, jnp.asarray(jnp.inf))
    if fault := fault_of(_soundness(*arguments_of(config))._replace(**allowed)):
        given = ", ".join(
            f"`profile.{key}` = {_written(value)}" for key, value in config.parameters.items()
        )
        raise InputError(
            f"the profile of family {config.family} must be sound, but with {given} {fault}; "
            f"{family.remedy or 'change these parameters'}"
        )


def note_program(config: ProfileConfig) -> None:
    """Print a note on a family from outside whose programs would take long to compile.

    A simulation contains dozens of copies of the code that computes a point of a flank."""
    if is_shipped(config.family) or config.from_file:
        return
    profile = profile_of(*arguments_of(config))
    made = jax.make_jaxpr(
        lambda nu: [f(nu) for f in (profile.roll_angle, profile.lever, profile.support)]
    )
    count = str(made(profile.half_pitch)).count(" = ")
    if count > _MOST_OPERATIONS:
        say(
            f"family {config.family} takes {count} operations for a point of a flank, but those of "
            "this package take at most 500, so that its programs may take minutes and gigabytes to "
            "compile; give it as a `RollPiece`, or write iterations with `jax.lax.fori_loop` "
            "(docs/extending.md)"
        )


def fault_of(checks: Soundness) -> str:
    """Return the first check of a design that fails, with its margin, or "" if it is sound."""
    name = checks.failed
    if not name:
        return ""
    unit, size = _UNITS.get(name, ("mm", MM))
    value = float(getattr(checks, name)) / size
    margin = f"margin {value:.3g} {unit}".rstrip() if np.isfinite(value) else "no such curve"
    return f"{_FAULTS[name]} ({margin})"


def margins_of(config: ProfileConfig) -> dict[str, float]:
    """Return the margins of a config's profile for the result file.

    Each key is the name of a margin followed by its unit, as in `order_deg`. For an outline from a
    file, the result is {}."""
    if config.from_file:
        return {}
    record = {}
    for name, value in _soundness(*arguments_of(config)).of_flank.items():
        unit, size = _UNITS.get(name, ("mm", MM))
        record["_".join(filter(None, (name, unit)))] = float(value) / size
    return record


@CachedFunction
def _soundness(family, lobes, pitch_radius, design):
    return soundness(profile_of(family, lobes, pitch_radius, design), None, frozenset())


def _written(value: float | tuple[float, ...]) -> str:
    if isinstance(value, tuple):
        return shown([float(f"{number:.6g}") for number in value])
    return f"{value:g}"


_FAULTS = {
    "turning": "one of its segments would end before it starts, or miss the pitch crossing",
    "convexity": "the addendum is not convex",
    "reach": "some normals of the addendum miss the pitch circle: it would touch nothing there",
    "fall": "the outline rises again beyond the tip",
    "rolling": "two points of a flank would mesh at once",
    "order": "a flank would touch before the tip of its lobe reaches the line of centres",
    "undercut": "the dedendum is undercut",
    "star": "the outline folds back, seen from the axis",
    "root": "the root lies beyond the axis",
    "limits": "a limit of the family in closed form is exceeded",
    "bore": "the bore is wider than the root circle",
}
