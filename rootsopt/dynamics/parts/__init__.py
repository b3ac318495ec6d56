"""Parts that can act on a rotor pair. A scene holds only the parts it needs."""

from rootsopt.dynamics.parts.base import Context, Loads, Motion, Own, Part, Units
from rootsopt.dynamics.parts.load import (
    AxisLoads,
    ConstantLoad,
    GasLoad,
    GasResultant,
    Load,
    TwistedLoad,
)
from rootsopt.dynamics.parts.machine import (
    Drive,
    Friction,
    GearErrors,
    MotorDrive,
    PrescribedDrive,
    Supports,
    TimingGear,
)

__all__ = [
    "AxisLoads",
    "ConstantLoad",
    "Context",
    "Drive",
    "Friction",
    "GasLoad",
    "GasResultant",
    "GearErrors",
    "Load",
    "Loads",
    "Motion",
    "MotorDrive",
    "Own",
    "Part",
    "PrescribedDrive",
    "Supports",
    "TimingGear",
    "TwistedLoad",
    "Units",
]
