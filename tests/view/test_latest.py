"""Jobs of the explorer: the newest wins, at most one runs, errors are reported."""

import threading

import pytest

from rootsopt.view.pages.session import Latest


@pytest.fixture
def lane():
    errors = []
    made = Latest(errors.append)
    made.errors = errors
    yield made
    made.close()


def test_newest_job_replaces_those_that_wait(lane):
    """While the first job runs, a hundred others arrive: only the last of them runs."""
    begun, go, end = (threading.Event() for _ in range(3))
    ran: list[int] = []

    def first():
        begun.set()
        go.wait(20)
        ran.append(-1)

    lane.submit(first)
    assert begun.wait(20)
    for k in range(100):
        lane.submit(lambda k=k: (ran.append(k), k == 99 and end.set()))
    assert lane.seconds > 0
    go.set()
    assert end.wait(20)
    assert ran == [-1, 99]


def test_delayed_job_is_replaced_and_dropped(lane):
    ran, end = [], threading.Event()
    lane.submit(lambda: ran.append("late"), delay=60)
    lane.submit(lambda: (ran.append("now"), end.set()))
    assert end.wait(20)
    end.clear()
    lane.submit(lambda: ran.append("dropped"), delay=0.05)
    lane.clear()
    lane.submit(end.set, delay=0.1)
    assert end.wait(20)
    assert ran == ["now"]


def test_error_is_reported_and_the_next_job_runs(lane):
    end = threading.Event()

    def fail():
        raise ValueError("no idea")

    lane.submit(fail)
    while not lane.errors:
        pass
    lane.submit(end.set)
    assert end.wait(20)
    assert str(lane.errors[0]) == "no idea"
