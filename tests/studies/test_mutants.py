"""`make mutants` can still make its mistakes, and knows the tests of every numerical module."""

import pytest

from tests.mutants.mistakes import ROOT, by_hand, chosen
from tests.mutants.rooms import ROOMS


def test_mistakes_made_by_hand_can_still_be_made():
    """Each text occurs once, its replacement is valid Python, and the named test exists."""
    mistakes = by_hand()
    assert len({str(one) for one in mistakes}) == len(mistakes) >= 16
    for one in mistakes:
        compile(one.source, one.file, "exec")
        file, _, name = one.tests[0].partition("::")
        assert (f"def {name}(" if name else "def test_") in (ROOT / file).read_text(), one.tests


def test_every_numerical_module_has_its_tests():
    found = {
        path.relative_to(ROOT).as_posix()
        for folder in ("contact", "dynamics", "optimize", "profiles", "pump")
        for path in (ROOT / "rootsopt" / folder).rglob("[!_]*.py")
    }
    assert found <= set(ROOMS)
    assert all((ROOT / file).exists() for file in ROOMS)


def test_choice_of_mistakes():
    pytest.importorskip("cosmic_ray")
    found = chosen(1, 8)
    assert found == chosen(1, 8) != chosen(2, 8)
    for one in found:
        assert one.source != (ROOT / one.file).read_text()
        compile(one.source, one.file, "exec")
