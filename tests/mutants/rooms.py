"""The numerical modules, and the tests that should notice a change in each, quickest first."""

from pathlib import Path

_TESTS = Path(__file__).parents[1]
_OF = {
    "continuation/arclength": "arclength continuation",
    "continuation/branch": "continuation",
    "continuation/family": "continuation",
    "contact/closest": "closed_forms contact accuracy conjugacy families gradients",
    "contact/gap": "conformance",
    "contact/impact": "impact contact extremes",
    "contact/law": "conformance extending_parts",
    "contact/near": "near",
    "contact/point": "scene",
    "contact/search": "closed_forms conformance",
    "contact/twisted": "twisted",
    "contact/worn": "worn",
    "contact/wrapped": "worn twisted",
    "dynamics/closed": "start motion steady",
    "dynamics/collocation/blocks": "system mesh",
    "dynamics/collocation/bordered": "continuation",
    "dynamics/collocation/closing": "motion known",
    "dynamics/collocation/elements": "mesh system",
    "dynamics/collocation/equation": "system motion",
    "dynamics/collocation/events": "system motion",
    "dynamics/collocation/forces": "motion",
    "dynamics/collocation/gauss": "mesh system",
    "dynamics/collocation/known": "known",
    "dynamics/collocation/mesh": "mesh motion",
    "dynamics/collocation/motion": "motion",
    "dynamics/collocation/newton": "system motion",
    "dynamics/collocation/peak": "known",
    "dynamics/collocation/seed": "motion known",
    "dynamics/collocation/system": "system motion",
    "dynamics/flow": "flow dynamics steady measures gradients scene extremes",
    "dynamics/integrator": "dynamics extremes",
    "dynamics/landing": "landing",
    "dynamics/linear": "steady measures",
    "dynamics/maxima": "maxima",
    "dynamics/measures": "measures extremes",
    "dynamics/orbit": "orbit measures steady gradients extremes",
    "dynamics/timescales": "extremes dynamics",
    "dynamics/flanks": "pair drive dynamics scene steady",
    "dynamics/pair": "pair drive dynamics scene steady",
    "dynamics/peak": "flow extremes steady gradients",
    "dynamics/saltation": "gradients steady",
    "dynamics/settle": "dynamics steady gradients",
    "dynamics/steady": "orbit measures steady gradients extremes",
    "dynamics/stepping": "stepping flow",
    "dynamics/switches": "pair steady gradients",
    "dynamics/tangent": "orbit steady gradients measures",
    "dynamics/varied": "known maxima loads",
    "dynamics/verdict": "pair extremes steady accuracy",
    "dynamics/window": "window idle steady",
    "dynamics/parts/base": "conformance extending_parts",
    "dynamics/parts/drive": "drive scene",
    "dynamics/parts/friction": "friction scene",
    "dynamics/parts/gear": "pair orbit contact dynamics",
    "dynamics/parts/load": "load scene dynamics",
    "dynamics/parts/resultants": "bearings loads",
    "dynamics/parts/supports": "scene",
    "config/families": "extending families config",
    "design/bounds": "bounds families optimize freeform beginning",
    "design/resemblance": "resemblance",
    "design/space": "search optimize freeform",
    "optimize/beginning": "beginning",
    "optimize/certificate": "sqp robust tradeoffs",
    "optimize/design": "optimize pareto",
    "optimize/infeasible": "optimize limits",
    "optimize/limits": "limits",
    "optimize/local": "sqp robust tradeoffs limits",
    "optimize/noise": "search noise ensemble",
    "optimize/problem": "search optimize speeds families freeform",
    "optimize/optimality": "optimality",
    "optimize/models": "sqp",
    "optimize/robust": "robust",
    "optimize/robust_problem": "robust",
    "optimize/search": "search optimize speeds",
    "optimize/sqp": "sqp robust",
    "profiles/arc_families": "families conjugacy",
    "profiles/arcs": "families conjugacy",
    "profiles/base": "profiles extending contact conjugacy families",
    "profiles/cic": "profiles contact conjugacy",
    "profiles/curve": "families conjugacy freeform",
    "profiles/departure": "resemblance freeform",
    "profiles/ee": "profiles contact gradients",
    "profiles/ellipse": "families conjugacy",
    "profiles/epicycloid": "families conjugacy",
    "profiles/edge": "families",
    "profiles/freeform": "freeform conjugacy",
    "profiles/geometry": "profiles families",
    "profiles/involute": "profiles families optimize",
    "profiles/outline": "outline",
    "profiles/trigonometry": "families profiles",
    "profiles/trochoid": "families conjugacy",
    "profiles/validity": "families",
    "pump/bearings": "bearings",
    "pump/flow": "pump_flow",
    "pump/gap": "leakage",
    "pump/gas": "leakage",
    "pump/laminar": "leakage",
    "pump/leakage": "leakage",
    "pump/loads": "loads free_twist",
    "pump/play": "play",
    "pump/section": "play leakage",
    "pump/sheet": "pump_flow play leakage",
    "response/checkpoint": "checkpoint journal",
    "response/ensemble": "members ensemble",
    "response/members": "members ensemble",
    "response/many": "many evaluations tolerances",
    "response/reducers": "risk idle speeds tolerances",
    "response/result": "journal speeds tolerances",
    "response/scatter": "tolerances",
    "response/sensitivity": "robust",
    "response/speeds": "speeds",
    "response/starts": "start journal",
    "response/steady": "steady gradients",
    "response/terms": "terms loads leakage free_twist",
    "response/together": "together",
    "sweeps/axes": "axes",
    "sweeps/plan": "plan",
    "sweeps/table": "scenes",
    "tradeoffs/aims": "tradeoffs",
    "tradeoffs/assembly": "tradeoffs",
    "tradeoffs/front": "tradeoffs",
    "tradeoffs/course": "evaluations tradeoffs",
    "tradeoffs/gaps": "tradeoffs",
    "tradeoffs/lattice": "tradeoffs",
    "tradeoffs/scalar": "tradeoffs",
    "tradeoffs/study": "tradeoffs",
    "tradeoffs/trace": "tradeoffs",
}
"""Modules, and the WORDs in the names `test_WORD.py` of their tests."""

_FILES = {
    path.stem: path.relative_to(_TESTS.parent).as_posix() for path in _TESTS.rglob("test_*.py")
}
ROOMS = {
    f"rootsopt/{module}.py": tuple(_FILES[f"test_{word}"] for word in words.split())
    for module, words in _OF.items()
}


_FOLDERS = (
    "contact",
    "continuation",
    "design",
    "dynamics",
    "optimize",
    "profiles",
    "pump",
    "tradeoffs",
)
_RESPONSE = (
    "checkpoint",
    "ensemble",
    "many",
    "members",
    "reducers",
    "result",
    "scatter",
    "sensitivity",
    "speeds",
    "starts",
    "steady",
    "terms",
    "together",
)


def modules(root: Path) -> list[str]:
    """Return the numerical modules.

    Raises `LookupError` for a module without tests, or tests without a module."""
    found = {path.relative_to(root).as_posix() for path in _numerical(root)}
    if found != set(ROOMS):
        odd = ", ".join(sorted(found ^ set(ROOMS)))
        raise LookupError(f"tests/mutants/rooms.py and the package differ in {odd}")
    return sorted(found)


def _numerical(root: Path):
    package = root / "rootsopt"
    yield package / "config" / "families.py"
    for name in _RESPONSE:
        yield package / "response" / f"{name}.py"
    for name in ("axes", "plan", "table"):
        yield package / "sweeps" / f"{name}.py"
    for folder in _FOLDERS:
        for path in (package / folder).rglob("*.py"):
            if path.name not in ("__init__.py", "__main__.py"):
                yield path
