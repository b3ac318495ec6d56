"""Design Roots rotors by the gradient of their dynamic contact force; see the README.

Public names are imported on first use. Importing the package is therefore fast, loads no solver,
and changes no global setting. The first use of a name makes XLA compile loops as
`rootsopt.runtime.environment.use_compiled_loops` says, if JAX has not computed anything yet.

>>> import rootsopt
>>> rootsopt.__version__.count(".")
2
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rootsopt.config import Config as Config
    from rootsopt.config import load_config as load_config
    from rootsopt.config.families import Family as Family
    from rootsopt.config.families import Parameter as Parameter
    from rootsopt.config.families import register_family as register_family
    from rootsopt.contact.gap import Contact as Contact
    from rootsopt.contact.law import ContactLaw as ContactLaw
    from rootsopt.dynamics.parts.base import Part as Part
    from rootsopt.errors import InputError as InputError
    from rootsopt.identification.answer import Identification as Identification
    from rootsopt.identification.fit import identify as identify
    from rootsopt.optimize.design import optimize_design as optimize_design
    from rootsopt.optimize.design import pareto_front as pareto_front
    from rootsopt.optimize.outcome import Optimization as Optimization
    from rootsopt.optimize.tradeoffs.front import Front as Front
    from rootsopt.profiles.base import Profile as Profile
    from rootsopt.profiles.base import Segment as Segment
    from rootsopt.response.evaluation import evaluate as evaluate
    from rootsopt.response.result import Evaluation as Evaluation
    from rootsopt.response.steady import Response as Response
    from rootsopt.response.steady import steady_response as steady_response
    from rootsopt.response.sweeps.scenes import sweep_scenes as sweep_scenes
    from rootsopt.response.terms import Term as Term
    from rootsopt.response.terms import register_term as register_term
    from rootsopt.runtime.programs import COMPILER_OPTIONS as COMPILER_OPTIONS
    from rootsopt.scene import Scene as Scene
    from rootsopt.status import Status as Status

__version__ = "0.2.0"

# Public names, each with the module from which it is imported.
_PUBLIC = {
    "COMPILER_OPTIONS": "rootsopt.runtime.programs",
    "Config": "rootsopt.config",
    "Contact": "rootsopt.contact.gap",
    "ContactLaw": "rootsopt.contact.law",
    "Evaluation": "rootsopt.response.result",
    "Family": "rootsopt.config.families",
    "Front": "rootsopt.optimize.tradeoffs.front",
    "Identification": "rootsopt.identification.answer",
    "InputError": "rootsopt.errors",
    "Optimization": "rootsopt.optimize.outcome",
    "Parameter": "rootsopt.config.families",
    "Part": "rootsopt.dynamics.parts.base",
    "Profile": "rootsopt.profiles.base",
    "Response": "rootsopt.response.steady",
    "Scene": "rootsopt.scene",
    "Segment": "rootsopt.profiles.base",
    "Status": "rootsopt.status",
    "Term": "rootsopt.response.terms",
    "evaluate": "rootsopt.response.evaluation",
    "identify": "rootsopt.identification.fit",
    "load_config": "rootsopt.config",
    "optimize_design": "rootsopt.optimize.design",
    "pareto_front": "rootsopt.optimize.design",
    "register_family": "rootsopt.config.families",
    "register_term": "rootsopt.response.terms",
    "steady_response": "rootsopt.response.steady",
    "sweep_scenes": "rootsopt.response.sweeps.scenes",
}
__all__ = ["__version__", *_PUBLIC]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'rootsopt' has no attribute {name!r}")
    import_module("rootsopt.runtime.environment").use_compiled_loops()
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
