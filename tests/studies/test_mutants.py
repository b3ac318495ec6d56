"""The texts that `make mutants` changes are still in the sources."""

from pathlib import Path

import pytest

from tests.mutants.by_hand import by_hand
from tests.mutants.equivalent import equivalents
from tests.mutants.rooms import ROOMS, modules

ROOT = Path(__file__).parents[2]


def test_mistakes_made_by_hand_can_still_be_made():
    """Each text occurs once, its replacement is valid Python, and the named test exists."""
    mistakes = by_hand(ROOT)
    assert len({one.key for one in mistakes}) == len(mistakes) >= 16
    for one in mistakes:
        assert one.source is not None, f"{one.file}: {one.was!r} must occur once"
        compile(one.source, one.file, "exec")
        (test,) = one.tests
        file, _, name = test.partition("::")
        assert (f"def {name}(" if name else "def test_") in (ROOT / file).read_text(), test


def test_every_numerical_module_has_its_tests():
    """The tests of each module are named in `tests/mutants/rooms.py` and exist."""
    assert set(modules(ROOT)) == set(ROOMS)
    assert all((ROOT / test).exists() for tests in ROOMS.values() for test in tests)


def test_equivalent_mutants_can_still_be_made():
    for one in equivalents():
        text = " ".join((ROOT / one["file"]).read_text().split())
        assert " ".join(one["was"].split()) in text, one["was"]
        assert one["reason"]


def test_choice_of_mutants():
    """The choice depends on the seed alone and has the requested size.

    Equivalent mutants are left out."""
    pytest.importorskip("cosmic_ray")
    from tests.mutants.candidates import chosen

    few, again, other = (chosen(ROOT, seed, 3) for seed in (1, 1, 2))
    assert [one.key for one in few] == [one.key for one in again]
    assert {one.key for one in few} != {one.key for one in other}
    assert len({one.key for one in few}) == len(few) == 3
    for one in few:
        assert one.was != one.becomes
        compile(one.source, one.file, "exec")
        assert all((ROOT / test).exists() for test in one.tests)


def test_operators_do_what_their_examples_say():
    pytest.importorskip("cosmic_ray")
    from cosmic_ray.mutating import mutate_code

    from tests.mutants.operators import operators

    for _, name, operator in operators():
        for example in operator.examples():
            made = mutate_code(example.pre_mutation_code, operator, example.occurrence)
            assert made == example.post_mutation_code, name
