"""Tests of interrupted and resumed searches, which equal an uninterrupted one to the last bit."""

import json
import types

import numpy as np
import pytest

from rootsopt.commands.table import optimize as command
from rootsopt.commands.work import optimize as work
from rootsopt.errors import InputError
from rootsopt.optimize.search import Search
from rootsopt.response.journal import Checkpoint
from rootsopt.response.result import Evaluation, Seed
from rootsopt.status import Status
from rootsopt.view.runs import RunFolder
from tests.optimize.test_optimize import config

SHORT = [f"optimizer.{one}" for one in ("screening=2", "starts=1", "iterations=2", "prove=false")]
HEADER = {"config": {"a": 1}, "versions": {"jax": "1"}}


def evaluation(value):
    start = Seed(np.array([value / 7, np.pi]), (np.array([[value]]), np.array(True)))
    return Evaluation(
        design={"a": value}, geometry={}, response={"mean_force_N": value / 3}, gradient={},
        steady_state={"period": 1}, status=Status.PERIODIC, message="", statistics={},
        series=None, start=start,
    )  # fmt: skip


def outcome(result):
    """Return everything that a search finds, without its run times."""
    rows = [{k: repr(v) for k, v in row.items()} for row in result.history]
    record = result.optimized.record() | {"statistics": None}
    return json.dumps([rows, record, result.optimality.record(), result.constraints])


def test_the_command_keeps_its_checkpoint_until_the_run_is_in_place(tmp_path, monkeypatch):
    """A kill while files are written does not lose the search, nor does an abandoned run."""
    kept, older = (tmp_path / f".run.checkpoint{end}" for end in ("", ".old"))
    kept.write_text("of an earlier run")

    def search_of(config, progress, stop, checkpoint, runs):
        checkpoint.add([((0, 0), ([0.0], evaluation(0.1)))])
        return types.SimpleNamespace(run=lambda: None, so_far=lambda: None)

    def given_up(self):
        raise InputError("no space")

    put = RunFolder.put_in_place
    monkeypatch.setattr(work, "search_of", search_of)
    monkeypatch.setattr(RunFolder, "put_in_place", given_up)
    arguments = ["configs/cic_drawn.yaml", "-o", str(tmp_path / "run")]
    assert command.main(arguments) == 2
    assert (older.read_text(), kept.exists()) == ("of an earlier run", True)
    monkeypatch.setattr(RunFolder, "put_in_place", put)
    command.main([*arguments, "--resume"])
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


SPEEDS = "objective.speeds_rpm=[2700, 3300]"


@pytest.mark.parametrize("more", [(), pytest.param((SPEEDS,), marks=pytest.mark.long)])
def test_a_resumed_search_equals_one_that_was_not_interrupted(tmp_path, more):
    """The file is cut at a random byte, as after a kill, and its lines are damaged at random.

    Orbits are closed from those of neighbours, which the file does not hold."""
    settings, path = config(*SHORT, *more), tmp_path / "c"
    full = Checkpoint(HEADER, path)
    expected = outcome(Search(settings, checkpoint=full).run())
    assert b"from_neighbour" in path.read_bytes()
    full.close()
    data = path.read_bytes()
    head = data.index(b"\n") + 1
    rng = np.random.default_rng(0)
    cut = data[: rng.integers(head + (len(data) - head) // 2, len(data))]
    flipped = bytearray(data)
    flipped[rng.integers(head)] ^= 1
    for place in rng.integers(head, len(data), 3):
        flipped[place] ^= 1 << rng.integers(8)
    for content in (cut, flipped):
        path.write_bytes(content)
        resumed = Checkpoint(HEADER, path, resume=True)
        assert outcome(Search(settings, checkpoint=resumed).run()) == expected
        assert resumed.reused > 0
        assert resumed.damage
        resumed.close()
