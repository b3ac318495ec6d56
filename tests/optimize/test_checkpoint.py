"""Tests of interrupted and resumed searches, which equal an uninterrupted one to the last bit."""

import json

import numpy as np
import pytest

from rootsopt.commands import optimize as command
from rootsopt.commands.work import optimize as work
from rootsopt.config import parse
from rootsopt.errors import InputError
from rootsopt.optimize.checkpoint import Checkpoint, set_aside
from rootsopt.optimize.search import Search
from rootsopt.output.runs import RunFolder
from rootsopt.response.evaluation import Evaluation
from rootsopt.status import Status

SCENE = """
profile: {family: cic, lobes: 3, pitch_radius_mm: 33.0, pressure_angle_deg: 36.43,
          involute_length_mm: 8.0, tip_arc_angle_deg: 4.0}
rotor: {length_mm: 100.0, density_kg_m3: 7800.0}
contact: {stiffness_N_per_mm_e: 2.0e5, exponent: 2.2, max_damping_N_s_per_mm: 0.25,
          full_damping_depth_mm: 0.01}
scene:
  speed_rpm: 3000.0
  load: {torque_N_m: 4.775}
  timing_gear: {stiffness_N_m_per_rad: 2.0e4, damping_ratio: 0.5, backlash_mm: 0.1}
constraints: {seal_width_min_mm: 2.0}
optimizer: {screening: 3, starts: 2, iterations: 8}
"""
HEADER = {"config": {"a": 1}, "versions": {"jax": "1"}}


def evaluation(value):
    return Evaluation(
        design={"a": value}, geometry={}, response={"mean_force_N": value / 3}, gradient={},
        steady_state={"period": 1}, status=Status.PERIODIC, message="", statistics={},
        series=None, state=np.array([value / 7, np.pi]),
    )  # fmt: skip


def outcome(result):
    """Return everything that a search finds, without its run times."""
    rows = [{k: repr(v) for k, v in row.items()} for row in result.history]
    record = result.optimized.record()
    record.pop("statistics")
    return json.dumps([rows, record, result.optimality.record(), result.constraints])


def test_floats_come_back_to_the_last_bit(tmp_path):
    path, point = tmp_path / "c", np.array([0.1, 1 / 3])
    first = Checkpoint(path, HEADER)
    assert first.empty
    first.add((0, 3), point, evaluation(0.1))
    first.close(remove=False)
    again = Checkpoint(path, HEADER, resume=True)
    found = again.known((0, 3), point)
    assert found.state.tobytes() == evaluation(0.1).state.tobytes()
    assert found.response == evaluation(0.1).response
    assert found.status is Status.PERIODIC
    assert again.known((0, 3), point + 1e-16) is None or np.all(point + 1e-16 == point)
    assert again.known((0, 4), point) is None
    again.close()
    assert not path.exists()


def test_a_run_that_does_not_resume_keeps_the_older_checkpoint(tmp_path):
    path = tmp_path / "c"
    assert set_aside(path) is None
    Checkpoint(path, HEADER).close(remove=False)
    older = set_aside(path)
    assert older == tmp_path / "c.old"
    assert not path.exists()
    older.rename(path)
    Checkpoint(path, HEADER, resume=True).close()


def test_the_command_keeps_its_checkpoint_until_the_run_is_in_place(tmp_path, monkeypatch):
    """A kill while files are written does not lose the search, nor does an abandoned run."""
    kept, older = (tmp_path / f".run.checkpoint{end}" for end in ("", ".old"))
    kept.write_text("of an earlier run")

    def searched(config, progress, stop, checkpoint, runs):
        checkpoint.add((0, 0), np.zeros(1), evaluation(0.1))
        return config, {}, None

    def given_up(self):
        raise InputError("no space")

    put = RunFolder.put_in_place
    monkeypatch.setattr(work, "_searched", searched)
    monkeypatch.setattr(RunFolder, "put_in_place", given_up)
    arguments = ["configs/cic.yaml", "-o", str(tmp_path / "run")]
    assert command.main(arguments) == 2
    assert older.read_text() == "of an earlier run"
    assert kept.exists()
    monkeypatch.setattr(RunFolder, "put_in_place", put)
    command.main([*arguments, "--resume"])
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_other_configs_and_missing_files_are_refused(tmp_path):
    path = tmp_path / "c"
    with pytest.raises(InputError, match="no '"):
        Checkpoint(path, HEADER, resume=True)
    Checkpoint(path, HEADER).close(remove=False)
    other = {"config": {"a": 2}, "versions": {"jax": "1"}}
    with pytest.raises(InputError, match=r"config\.a \(then 1, now 2\)"):
        Checkpoint(path, other, resume=True)


def test_a_line_cut_off_is_ignored(tmp_path):
    path, point = tmp_path / "c", np.array([0.5])
    first = Checkpoint(path, HEADER)
    for k in range(3):
        first.add((0, k), point, evaluation(float(k)))
    first.close(remove=False)
    data = path.read_bytes()
    path.write_bytes(data[:-5])
    again = Checkpoint(path, HEADER, resume=True)
    assert again.known((0, 1), point) is not None
    assert again.known((0, 2), point) is None
    again.add((0, 2), point, evaluation(2.0))
    again.close(remove=False)
    assert path.read_bytes() == data


SPEEDS = "objective: {speeds_rpm: [2700.0, 3300.0]}\n"
"""Over several speeds, orbits are closed from those of neighbours, which the file does not hold."""


@pytest.mark.parametrize("more", ["", pytest.param(SPEEDS, marks=pytest.mark.long)])
def test_a_resumed_search_equals_one_that_was_not_interrupted(tmp_path, more):
    """The file is cut at random bytes, as after a kill."""
    settings, path = parse(SCENE + more), tmp_path / "c"
    full = Checkpoint(path, HEADER)
    expected = outcome(Search(settings, checkpoint=full).run())
    assert (b"from_neighbour" in path.read_bytes()) == bool(more)
    full.close(remove=False)
    data = path.read_bytes()
    head = data.index(b"\n") + 1
    rng = np.random.default_rng(0)
    for cut in rng.integers(head + (len(data) - head) // 2, len(data), 2):
        path.write_bytes(data[:cut])
        resumed = Checkpoint(path, HEADER, resume=True)
        found = outcome(Search(settings, checkpoint=resumed).run())
        assert resumed.reused > 0
        resumed.close(remove=False)
        assert found == expected
