"""Results equal those stored in `tests/reference`: a few always, all in long runs."""

import copy
import json

import pytest

from rootsopt.config import FAMILY_KEYS
from tests.reference import kept
from tests.reference.__main__ import check
from tests.reference.cases import CASES, SHORT
from tests.reference.compare import ChangedError, differences, limits


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


def test_every_family_occurs():
    """Every family occurs in the cases."""
    text = " ".join(" ".join(case.overrides) for case in CASES)
    assert {family for family in FAMILY_KEYS if f"family: {family}," not in text} <= OF_CONFIGS


OF_CONFIGS = {"cic", "ee", "free_form"}
"""Families of the shipped configs."""


def test_every_status_occurs(results):
    """Every status occurs, and so do periods of 1, 2, 3 and more."""
    if missing := [case.name for case in CASES if case.name not in results]:
        pytest.skip(f"not kept: {', '.join(missing)}: python -m tests.reference --missing")
    statuses = {found["status"] for found in results.values()}
    assert statuses >= STATUSES
    periods = {found["steady_state"].get("period") for found in results.values()}
    assert {1, 2, 3} <= periods


STATUSES = {
    "periodic",
    "averaged",
    "idle",
    "chaotic",
    "not_settled",
    "passed_through",
    "stalled",
    "too_deep",
    "inaccurate",
    "solver_failed",
}


def test_a_changed_number_is_noticed(results):
    """A difference of twice the allowed one is found in every quantity.

    Other words are found too."""
    result = results["cic"]
    allowed = limits(result)
    assert max(allowed.values()) < 1e-5

    def off_by(part, name, quantity):
        changed = copy.deepcopy(result)
        row, key = changed[part], name
        if part == "gradient":
            row = row[name]
            key = max(row, key=lambda one: abs(row[one]))
        row[key] *= 1 + 2 * allowed[quantity]
        return differences(changed, result)[quantity]

    for part in ("geometry", "response", "gradient"):
        for name in result[part]:
            peak = part == "gradient" and name == "peak_force_N"
            quantity = "of the peak" if peak else part
            assert off_by(part, name, quantity) > allowed[quantity], (part, name)
    moved = copy.deepcopy(result)
    moved["steady_state"]["floquet_multiplier"] += 2 * allowed["multiplier"]
    assert differences(moved, result)["multiplier"] > allowed["multiplier"]
    other = copy.deepcopy(result)
    other["steady_state"]["period"] = 2
    for words in (result | {"status": "chaotic"}, other, result | {"gradient": {}}):
        with pytest.raises(ChangedError):
            differences(words, result)
