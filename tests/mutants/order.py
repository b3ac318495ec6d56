"""Pytest plugin: run tests in the order of the command line, cheapest first, not in conftest's."""

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(items):
    asked = list(items)
    result = yield
    items[:] = [item for item in asked if item in set(items)]
    return result
