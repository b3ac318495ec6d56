"""Config section of the pump's leakage: fluid, pressures and clearances."""

from typing import Annotated

from pydantic import Field, model_validator

from rootsopt.config.section import Section, between

_Clearance = Annotated[float, between(0, 10)]


class GasConfig(Section):
    """An ideal gas, compressed by the pump."""

    inlet_pressure_Pa: Annotated[float, between(1e-3, 1e8)] = Field(description="suction pressure")
    temperature_K: Annotated[float, between(50, 2000)] = Field(
        293.15, description="temperature of the gas that leaks"
    )
    gas_constant_J_per_kg_K: Annotated[float, between(10, 5000)] = Field(
        287.05, description="specific gas constant; default: air"
    )
    heat_ratio: Annotated[float, between(1.01, 1.7)] = Field(
        1.4, description="ratio of specific heats"
    )


class PumpConfig(Section):
    """Fluid, pressures and clearances of the pump, for its leakage. Nothing here is simulated."""

    viscosity_mPa_s: Annotated[float, between(1e-4, 1e6)] = Field(
        description="dynamic viscosity of the fluid"
    )
    pressure_difference_Pa: Annotated[float, between(0, 1e8)] | None = Field(
        None, description="discharge minus suction pressure; absent: that of scene.load"
    )
    tip_clearance_mm: _Clearance | None = Field(
        None, description="gap between rotor tip and housing; absent: no leakage there"
    )
    tips_in_series: Annotated[int, Field(ge=1, le=3)] = Field(
        1, description="number of tips of a rotor that seal in series"
    )
    end_clearance_mm: _Clearance | None = Field(
        None, description="gap between each end face and its cover; absent: no leakage there"
    )
    radial_allowance_mm: Annotated[float, between(-1, 10)] = Field(
        0.0, description="radius by which both rotors are smaller than their profile everywhere"
    )
    gas: GasConfig | None = Field(None, description="absent: the fluid is a liquid")

    @model_validator(mode="after")
    def _driven(self):
        if self.gas is not None and self.pressure_difference_Pa == 0:
            raise ValueError(
                "`pump.pressure_difference_Pa` must be greater than 0 with `pump.gas`, but is 0"
            )
        return self
