"""Results equal those stored in `tests/reference`: a few always, all in long runs."""

import json

import pytest

from tests.reference.__main__ import FILE, check, read
from tests.reference.cases import CASES, SHORT


@pytest.fixture(scope="module")
def results():
    return read()


def _every():
    """Return all cases as parameters of a test; those not in `SHORT` belong to long runs."""
    for case in CASES:
        marks = () if case.name in SHORT else pytest.mark.long
        yield pytest.param(case, id=case.name, marks=marks)


@pytest.mark.parametrize("case", [*_every()])
def test_results_are_as_kept(case, results):
    if case.name not in results:
        pytest.skip("nothing is kept of it: python -m tests.reference --missing")
    off, allowed = check(case, results)
    assert {name: x for name, x in off.items() if not x <= allowed[name]} == {}


def test_results_are_kept_with_their_configs(results):
    """Each case is stored once, in strict JSON, without a path of a machine."""
    kept_of = {case.name: [case.config, case.overrides] for case in CASES if case.name in results}
    assert len({case.name for case in CASES}) == len(CASES)
    found = {name: [one["config"], one["overrides"]] for name, one in results.items()}
    assert [*found.items()] == [*kept_of.items()]
    text = FILE.read_text()
    json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} in {FILE.name}"))
    assert str(FILE.parent) not in text
