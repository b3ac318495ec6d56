"""Results equal those stored in `tests/reference`: a few always, all in long runs."""

import json

import pytest

from tests.reference import kept
from tests.reference.__main__ import check
from tests.reference.cases import CASES, SHORT


@pytest.fixture(scope="module")
def results():
    return kept.read()


def agrees(case, results):
    """Assert that a case gives its stored results."""
    if case.name not in results:
        pytest.skip("nothing is kept of it: python -m tests.reference --missing")
    off, allowed = check(case, results)
    assert {name: x for name, x in off.items() if not x <= allowed[name]} == {}


@pytest.mark.parametrize("name", SHORT)
def test_a_few_results_are_as_kept(name, results):
    agrees(next(case for case in CASES if case.name == name), results)


@pytest.mark.long
@pytest.mark.parametrize("case", [c for c in CASES if c.name not in SHORT], ids=lambda c: c.name)
def test_every_result_is_as_kept(case, results):
    agrees(case, results)


def test_results_are_kept_with_their_configs(results):
    """Each case is stored once, in strict JSON, without a path of a machine."""
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
    assert list(results) == [name for name in names if name in results]
    for case in CASES:
        found = results.get(case.name)
        if found is not None:
            assert (found["config"], found["overrides"]) == (case.config, case.overrides)
    text = kept.FILE.read_text()
    json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} in {kept.FILE.name}"))
    assert str(kept.FILE.parent) not in text
