"""A rotor from a file as baseline: where the search begins, what it finds, what is said of it."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from rootsopt.config import load, parse
from rootsopt.optimize import infeasible as module
from rootsopt.optimize.infeasible import beginning
from rootsopt.optimize.outcome import Optimization
from rootsopt.optimize.search import Search
from rootsopt.response.result import RESPONSES
from rootsopt.scene import outline_mm
from rootsopt.scene.check import shape_of
from rootsopt.scene.resemblance import Likeness
from rootsopt.scene.space import bounds_of, widened
from tests.measured.test_outline import cut, write
from tests.standins import evaluation_of, refusal

CIC = "configs/cic_drawn.yaml"
BASE = load(CIC)


def measured(folder: Path, scatter: float, inset: float = 0.0, **optimizer) -> Path:
    """A config in `folder` whose baseline is the rotor of `CIC`, with `scatter` (mm) of its points,
    clockwise, turned and from another first point; `inset` (mm) smaller along its normals."""
    points = cut(outline_mm(BASE)[:-1] @ [1, 1j], inset)
    off = np.random.default_rng(5).normal(size=(len(points), 2)) @ [1, 1j]
    write(folder / "rotor.csv", np.roll((points + scatter * off)[::-1] * np.exp(0.3j), 321))
    data, path = yaml.safe_load(Path(CIC).read_text()), folder / "measured.yaml"
    smoothing = {"outline_smoothing_mm": scatter} if scatter else {}
    data["profile"] = {
        "family": "outline", "lobes": 3, "pitch_radius_mm": 33.0, "outline_file": "rotor.csv",
    } | smoothing  # fmt: skip
    data["optimizer"] |= optimizer
    path.write_text(yaml.safe_dump(data))
    return path


def test_members_get_the_gap_of_an_inset(tmp_path):
    """The inset is fitted with the parameters; both sides of the comparison have its gap, and the
    floor of the area efficiency is that of the member."""
    config = load(measured(tmp_path, 1e-3, 0.1, family="cic"), ["contact.clearance_mm=0.03"])
    found = beginning(config)
    assert found.likeness.inset == pytest.approx(1e-4, abs=0.5e-6)
    assert found.likeness.rms < found.likeness.departure < 2e-6
    assert (found.config.profile.family, found.widened) == ("cic", ())
    assert found.config.profile.parameters == pytest.approx(BASE.profile.parameters, rel=0.01)
    gap = found.config.contact.clearance_mm
    assert gap == pytest.approx(0.03 + 2e3 * found.likeness.inset, abs=1e-6)
    for said in (f"--set contact.clearance_mm={gap:.6g}`", "inset 0.1 mm"):
        assert said in found.message
    assert found.config.constraints.area_efficiency_min == pytest.approx(
        float(shape_of(BASE).area_efficiency), rel=1e-3
    )
    assert [found.record()[key] for key in ("departure_rms_um", "inset_um")] == [
        found.likeness.rms * 1e6,
        found.likeness.inset * 1e6,
    ]
    # An outline that overlaps has members that just touch.
    other, more = module._cut(config, -5e-5)
    assert (other.contact.clearance_mm, more) == (0.0, pytest.approx(0.07))
    assert module._cut(config, 0.0) == (config, 0.0)


def test_improvement_over_the_nominal_member():
    """A third less than the nominal member, which is a quarter quieter than the measured rotor."""
    problem = SimpleNamespace(
        objective=lambda found: found.response["mean_force_N"] / 100, config=BASE
    )
    found = SimpleNamespace(problem=problem, optimized=evaluation_of(50.0))
    for force, expected in ((100.0, 1 / 2), (75.0, 1 / 3)):
        gain = Optimization._gains(found, evaluation_of(force), force / 100)  # type: ignore[arg-type]
        assert gain == pytest.approx(dict.fromkeys(("objective", *RESPONSES), expected))


def test_a_search_in_the_own_family_has_no_beginning():
    assert beginning(BASE) is None
    assert beginning(load(CIC, ["optimizer.family=cic"])) is None
    assert "nearest" in refusal(load, CIC, ["optimizer.family=ee"])


def test_the_nearest_family_begins(tmp_path, monkeypatch):
    away = {"arc": 3e-5, "cic": 1e-6, "ellipse": 2e-6}

    def fitted(given, name):
        return Likeness(name, {"arc_center_mm": 29.0}, away[name], 0.0) if name != "cic" else None

    monkeypatch.setattr(module, "classical", lambda: ("ee", "arc", "cic"))
    monkeypatch.setattr(module, "likeness", fitted)
    found = beginning(load(measured(tmp_path, 0.0)))
    assert found.likeness.family == "arc"
    assert "optimizer.family=free_form" in found.message
    said = refusal(beginning, load(tmp_path / "measured.yaml", ["optimizer.family=cic"]))
    assert "`optimizer.family` must be a family with a sound" in said


def test_an_ensemble_is_refused(tmp_path, monkeypatch):
    config = load(measured(tmp_path, 0.0), ["objective.motion=ensemble"])
    given = module.Beginning(BASE.model_copy(update={"objective": config.objective}),
                             Likeness("cic", {}, 0.0, 0.0), [], (), "rotor.csv")  # fmt: skip
    monkeypatch.setattr("rootsopt.optimize.search.beginning", lambda config: given)
    assert "`objective.motion` must not be ensemble" in refusal(Search, config)


def test_default_bounds_are_widened_and_given_ones_are_kept():
    text = Path(CIC).read_text().replace("36.43", "21.0").replace("9.00 ", "2.0 ")
    config = parse(text)
    other, keys = widened(config)
    assert keys == ("pressure_angle_deg",)
    assert bounds_of(other) == [(19.0, 45.0), *bounds_of(config)[1:]]
    for kept in (parse(text, ["optimizer.bounds.pressure_angle_deg=[22,45]"]), BASE):
        assert widened(kept) == (kept, ())
