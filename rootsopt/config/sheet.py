"""A catalogue sheet of a pump, and the commented config that follows from it.

Tables of materials, media and usual gears serve a rotor that is known only from its sheet."""

import math
import shlex
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any

import yaml
from pydantic import Field

from rootsopt.config.document import override_in
from rootsopt.config.families import EXAMPLE_RADIUS, Family, families, family_of
from rootsopt.config.rotor import ProfileConfig
from rootsopt.config.section import Among, Section, Speed, between, put
from rootsopt.config.units import RPM

MATERIALS = {
    # density (kg/m³), Young's modulus (GPa), Poisson's ratio, usual densities and moduli, source
    "cast-iron": (7200, 110, 0.26, "7100 to 7300", "103 to 118", "EN-GJL-250, EN 1561"),
    "ductile-iron": (7100, 169, 0.275, "7000 to 7200", "165 to 176", "EN-GJS-400, EN 1563"),
    "steel": (7850, 210, 0.30, "7800 to 7870", "200 to 212", "EN 1993-1-1"),
    "stainless-steel": (7900, 200, 0.30, "7700 to 8000", "193 to 200", "EN 10088-1"),
    "aluminium": (2700, 70, 0.30, "2650 to 2800", "68 to 73", "EN 1999-1-1"),
    "pom": (1410, 2.8, 0.35, "1390 to 1430", "2.6 to 3.1", "unfilled, data sheets of makers"),
    "peek": (1310, 3.7, 0.38, "1290 to 1320", "3.5 to 4.1", "unfilled, data sheets of makers"),
}
_GASES = "-10 to 150 °C: 0.9 to 1.4 times this"
MEDIA = {
    # viscosity (mPa·s), gas constant (J/(kg·K)), ratio of specific heats, range of the viscosity.
    # Gases: NIST Chemistry WebBook at 1 bar, R / M; water: IAPWS; oil: ISO 3448, with 870 kg/m³.
    "air": (0.0182, 287.05, 1.40, _GASES),
    "nitrogen": (0.0176, 296.80, 1.40, _GASES),
    "oxygen": (0.0203, 259.84, 1.40, _GASES),
    "argon": (0.0223, 208.13, 1.667, _GASES),
    "helium": (0.0196, 2077.3, 1.667, _GASES),
    "hydrogen": (0.0088, 4124.5, 1.41, _GASES),
    "carbon-dioxide": (0.0147, 188.92, 1.29, _GASES),
    "methane": (0.0110, 518.28, 1.31, _GASES),
    "water": (1.00, None, None, "5 to 80 °C: 1.52 to 0.35"),
    "oil": (40.0, None, None, "ISO VG 46 at 40 °C; VG 22 to VG 220: 19 to 190"),
}

# A usual timing gear: teeth per gear, face width (pitch diameters), pressure angle (°), mesh
# stiffness (N/(mm·µm)). The stiffness is that of steel spur gears by ISO 6336-1, which gives 14 to
# 25 for usual gears.
_TEETH, _FACE, _TOOTH_ANGLE, _MESH = 50, 0.3, 20.0, 20.0

# Exponent of the force between two cylinders that touch along a line.
_LINE = 10 / 9


def gear_stiffness(center_distance: float) -> float:
    """Return the torsional stiffness (N·m/rad) of the mesh of a usual timing gear.

    `center_distance` in mm, equal to the pitch diameter of both gears. With the face width b and
    the base radius r_b, a torque turns one gear against the other by torque / (c b r_b²)."""
    base = center_distance / 2 * math.cos(math.radians(_TOOTH_ANGLE))
    return _MESH * _FACE * center_distance * base**2


def gear_backlash(center_distance: float) -> float:
    """Return the least backlash (mm) along the pitch circle that is recommended for usual gears.

    ISO/TR 10064-2: 2/3 (0.06 + 0.0005 a + 0.03 m) along the normal, in mm, with the centre distance
    a, here `center_distance`, and the module m."""
    normal = 2 / 3 * (0.06 + (0.0005 + 0.03 / _TEETH) * center_distance)
    return normal / math.cos(math.radians(_TOOTH_ANGLE))


def line_stiffness(modulus: float, poisson: float, length: float) -> float:
    """Return K (N/mm^e) of the force K δ^e of two flanks of a `length` (mm), e = `_LINE`.

    `modulus` (GPa), `poisson`: Young's modulus E and Poisson's ratio ν. Lundberg (1939), as in
    Palmgren's bearing formulas: δ = 1.36 (η F)^0.9 / L^0.8, with η = 2 (1 - ν²) / E. For steel it
    is δ = 3.84e-5 F^0.9 / L^0.8."""
    return (length**0.8 / 1.36) ** _LINE * modulus * 1e3 / (2 * (1 - poisson**2))


# One bar (Pa); penetration (mm) at which the damping of the flanks is full; damping ratio of
# flanks and timing gear; column in which comments start.
_BAR, _DEPTH, _RATIO, _COLUMN = 1e5, 1e-3, 0.1, 40

# Values by dotted key, each with a comment on where it is from.
_Entries = dict[str, tuple[Any, str]]
_Length = Annotated[float, between(1, 2e4)]
_Pressure = Annotated[float, between(1e-5, 1e3)]
_Optional = Annotated[float, between(1e-6, 1e6)] | None


def made() -> list[str]:
    """Return the names of the families whose profiles are not read from a file."""
    return [name for name, family in families().items() if family.maker is not None]


class Sheet(Section):
    """What a catalogue sheet states. Of power and pressure difference, one is needed."""

    centre_distance_mm: _Length = Field(description="distance of the rotors' axes")
    outer_diameter_mm: _Length = Field(description="diameter of a rotor over its tips")
    length_mm: _Length = Field(description="length of a rotor")
    lobes: Annotated[int, Field(ge=2, le=6)] = Field(description="lobes of a rotor: 2 to 6")
    speed_rpm: Speed = Field(description="speed")
    power_kW: _Optional = Field(None, description="shaft power: half of it on each rotor")
    pressure_difference_bar: _Pressure | None = Field(
        None, description="discharge minus suction pressure; used if both are given"
    )
    inlet_pressure_bar: _Pressure = Field(1.0, description="absolute suction pressure of a gas")
    clearance_mm: Annotated[float, between(0, 10)] | None = Field(
        None, description="gap of flanks, tips and ends; default: outer diameter / 1000"
    )
    medium: Annotated[str, Among(lambda: MEDIA)] = Field("air", description="what is pumped")
    material: Annotated[str, Among(lambda: MATERIALS)] = Field(
        "cast-iron", description="material of the rotors"
    )
    family: Annotated[str, Among(made)] | None = Field(
        None, description="profile family; default: the first that meets the diameter"
    )

    @property
    def command(self) -> str:
        """Options with which `rootsopt new` makes this sheet."""
        given = self.model_dump(exclude_none=True).items()
        return shlex.join(
            word
            for name, value in given
            for word in (option(name), f"{value:.10g}" if isinstance(value, float) else str(value))
        )

    def first_profile(self, family: Family) -> ProfileConfig:
        """Return the example of a `family` in the size of this sheet.

        Raises `ValueError` if a parameter is out of its range."""
        radius = self.centre_distance_mm / 2
        scale = radius / EXAMPLE_RADIUS
        size = {"family": family.name, "lobes": self.lobes, "pitch_radius_mm": radius}
        values = {k: v * scale if k.endswith("_mm") else v for k, v in family.example.items()}
        return ProfileConfig.model_validate(size | values)

    def displaced(self, efficiency: float) -> float:
        """Return the displaced volume (m³ per turn) at an area `efficiency`."""
        outer = self.outer_diameter_mm / 2
        return 2 * math.pi * outer**2 * self.length_mm * efficiency * 1e-9

    def power_of(self, pressure_bar: float, efficiency: float) -> float:
        """Return the power (kW) that a pressure difference takes without losses."""
        return pressure_bar * _BAR * self.displaced(efficiency) * self.speed_rpm / 60 * 1e-3

    @property
    def torque(self) -> float:
        """Torque (N·m) of the power on one rotor; 0 without a power."""
        return (self.power_kW or 0.0) * 1e3 / (2 * self.speed_rpm * RPM)

    def compared(self, efficiency: float) -> str:
        """Return a sentence on the load that is used, with its torque and power."""
        power, pressure = self.power_kW or 0.0, self.pressure_difference_bar
        if pressure is None:
            most = power / self.power_of(1.0, efficiency)
            return (
                f"{power:g} kW is {2 * self.torque:.4g} N·m, half of it on each rotor; without "
                f"losses it pumps against {most:.3g} bar"
            )
        needed = self.power_of(pressure, efficiency)
        verdict = "more than there is: check both" if needed > power else "the rest is for losses"
        share = f", {needed / (power or 1):.0%} of the {power:g} kW of `--power-kW` ({verdict})"
        text = f"{pressure:g} bar, which takes {needed:.3g} kW without losses"
        return text + (share if power else "")

    @property
    def greatest(self) -> float:
        """Outer diameter (mm) below which all rotors lie: E (1 + sin(π/2N)) at a centre distance E.

        The flanks of a larger rotor would fold back, seen from its axis."""
        return self.centre_distance_mm * (1 + math.sin(math.pi / (2 * self.lobes)))

    def text(
        self,
        profile: ProfileConfig,
        efficiency: float = 0.5,
        head: str = "",
        overrides: Iterable[str] = (),
    ) -> str:
        """Return the config as YAML with comments.

        `profile`: a profile, with its area `efficiency`; `head`: lines of the first comment;
        `overrides`: texts of the form `dotted.key=value`, as for `--set`. Raises `InputError` if
        one is of another form."""
        tree: dict[str, Any] = {}
        entries = self._pair(profile) | self._scene() | self._pump(efficiency)
        limit = (self.outer_diameter_mm / 2, "half of --outer-diameter-mm, the housing")
        for key, entry in (*entries.items(), ("constraints.outer_radius_max_mm", limit)):
            put(tree, key, entry)
        for override in overrides:
            override_in(tree, override)
        lines = [f"# {line}" for line in head.splitlines()]
        for name, section in tree.items():
            lines += ["", *_lines({name: section}, "")]
        return "\n".join(lines) + "\n"

    def _pair(self, profile: ProfileConfig) -> _Entries:
        """Return the entries of profile, rotor and contact by dotted key."""
        density, modulus, poisson, densities, moduli, source = MATERIALS[self.material]
        name = f"--material {self.material}"
        stiffness = line_stiffness(modulus, poisson, self.length_mm)
        # Effective mass at the pitch circle of two solid cylinders that turn against each other.
        mass = density * math.pi * profile.pitch_radius_mm**2 * self.length_mm * 1e-9 / 4
        damping = 2 * _RATIO * math.sqrt(stiffness * _LINE * _DEPTH ** (_LINE - 1) * 1e3 * mass)
        chosen = "--family" if self.family else "first of the table that meets the outer diameter"
        gap = "a thousandth of the outer diameter; usual: 0.0007 to 0.0015 of it"
        solved = f"solved for --outer-diameter-mm {self.outer_diameter_mm:g}"
        return {
            "profile.family": (profile.family, chosen),
            "profile.lobes": (self.lobes, "--lobes"),
            "profile.pitch_radius_mm": (profile.pitch_radius_mm, "half of --centre-distance-mm"),
            **{
                f"profile.{one.key}": (getattr(profile, one.key), f"{one.help}; {solved}")
                for one in family_of(profile.family).parameters
            },
            "rotor.length_mm": (self.length_mm, "--length-mm"),
            "rotor.density_kg_m3": (density, f"{name}: {source}; usual: {densities}"),
            "contact.stiffness_N_per_mm_e": (
                _short(stiffness),
                f"Lundberg's line contact, {name}: E = {modulus} GPa ({moduli}), ν = {poisson}",
            ),
            "contact.exponent": (_short(_LINE, 5), "10/9, line contact"),
            "contact.max_damping_N_s_per_mm": (
                _short(damping * 1e-3),
                f"damping ratio {_RATIO:g}: 73 % of the speed returns; usual: 60 to 90 %",
            ),
            "contact.full_damping_depth_mm": (
                _DEPTH,
                "roughness of ground flanks; usual: 0.0002 to 0.005",
            ),
            "contact.clearance_mm": (
                self._gap,
                gap if self.clearance_mm is None else "--clearance-mm, along the normal",
            ),
        }

    def _scene(self) -> _Entries:
        """Return the entries of the scene by dotted key."""
        across = self.centre_distance_mm
        backlash, why = gear_backlash(across), "least backlash of ISO/TR 10064-2"
        if 0 < self._gap < backlash:
            backlash, why = self._gap, "the clearance: up to twice of it, no flanks touch"
        pressure, across_bar = self.pressure_difference_bar, "--pressure-difference-bar"
        return {
            "scene.speed_rpm": (self.speed_rpm, "--speed-rpm"),
            **(
                {"scene.load.torque_N_m": (_short(self.torque), "half of --power-kW at this speed")}
                if pressure is None
                else {"scene.load.pressure_difference_Pa": (_short(pressure * _BAR), across_bar)}
            ),
            "scene.timing_gear.stiffness_N_m_per_rad": (
                _short(gear_stiffness(across)),
                f"ISO 6336-1: 20 N/(mm µm) (14 to 25), width {_FACE:g} (0.2 to 0.5) pitch "
                "diameters",
            ),
            "scene.timing_gear.damping_ratio": (_RATIO, "usual: 0.03 to 0.17"),
            "scene.timing_gear.backlash_mm": (
                _short(backlash),
                f"{why}; module {across / _TEETH:.3g}, {_TEETH} teeth (35 to 80)",
            ),
        }

    def _pump(self, efficiency: float) -> _Entries:
        """Return the entries of pump and objective by dotted key."""
        viscosity, constant, ratio, range_ = MEDIA[self.medium]
        name, gap = f"--medium {self.medium}", (self._gap, "as between the flanks")
        across: _Entries = {}
        if self.pressure_difference_bar is None:
            most = (self.power_kW or 0.0) / self.power_of(1.0, efficiency) * _BAR
            note = "what --power-kW pumps against without losses"
            across = {"pump.pressure_difference_Pa": (_short(most), note)}
        gas: _Entries = {
            "pump.gas.inlet_pressure_Pa": (
                _short(self.inlet_pressure_bar * _BAR),
                "--inlet-pressure-bar",
            ),
            "pump.gas.gas_constant_J_per_kg_K": (constant, name),
            "pump.gas.heat_ratio": (ratio, name),
        }
        why = "the gear keeps the flanks apart, so that no contact force counts"
        apart: _Entries = {
            "objective.mean_weight": (0, why),
            "objective.peak_weight": (0, why),
            "objective.terms.leakage_fraction": (1, "what `rootsopt optimize` lowers instead"),
        }
        return {
            "pump.viscosity_mPa_s": (viscosity, f"{name}; {range_}"),
            **across,
            "pump.tip_clearance_mm": gap,
            "pump.end_clearance_mm": gap,
            **({} if constant is None else gas),
            **(apart if self._gap else {}),
        }

    @property
    def _gap(self) -> float:
        given = self.clearance_mm
        return _short(self.outer_diameter_mm / 1000, 2) if given is None else given


def option(name: str) -> str:
    """Return the option of the command line for a field of `Sheet`."""
    return "--" + name.replace("_", "-")


def _lines(tree: Mapping[str, Any], indent: str) -> Iterator[str]:
    """Yield the lines of a section of YAML."""
    for name, inner in tree.items():
        if not (isinstance(inner, dict) and inner):
            value, why = inner if isinstance(inner, tuple) else (inner, "--set")
            word = yaml.safe_dump(value, default_flow_style=True, width=math.inf)
            line = f"{indent}{name}: {word.split('...')[0].strip()}"
            yield f"{line:<{_COLUMN}} # {why}"
        else:
            yield f"{indent}{name}:"
            yield from _lines(inner, f"{indent}  ")


def _short(value: float, digits: int = 4) -> float:
    """Return a number rounded to significant `digits`."""
    return float(f"{value:.{digits}g}")
