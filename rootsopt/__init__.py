"""Roots rotors designed by gradient; see the README."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rootsopt.config.families import Family as Family
    from rootsopt.config.families import Parameter as Parameter
    from rootsopt.config.families import register_family as register_family
    from rootsopt.profiles.base import Profile as Profile
    from rootsopt.profiles.base import Segment as Segment

__version__ = "0.1.0"

_PUBLIC = {
    "Family": "rootsopt.config.families",
    "Parameter": "rootsopt.config.families",
    "Profile": "rootsopt.profiles.base",
    "Segment": "rootsopt.profiles.base",
    "register_family": "rootsopt.config.families",
}
"""Public names and where they are; each is imported when first asked for."""


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'rootsopt' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
