"""Tests of result folders: complete, of one run, locked, rejected where they cannot be used."""

import json
import os
import re
import subprocess
import sys
from unittest import mock

import matplotlib
import pytest

from rootsopt.commands.console import main
from rootsopt.view import files, runs
from rootsopt.view.runs import RunFolder
from tests.deaths import digest, digest_of, write_run
from tests.standins import ROOT, refusal


def test_full_disk_or_death_at_every_file_operation():
    """At each operation, the folder is the old run or the new one.

    The next run finds it usable and leaves nothing behind. This runs in its own process, because it
    forks."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.deaths"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" 0 wrong") == 2


def test_an_earlier_run_is_moved_aside_or_replaced(tmp_path):
    """It is replaced if asked, but files that are not the run's own are never deleted."""
    target = tmp_path / "run"
    notes = [write_run(target, text) for text in ("first", "second", "third")]
    assert notes == [[]] + [[f"the earlier run is now in {target}.{k}"] for k in (1, 2)]
    assert write_run(target, "fourth", overwrite=True) == []
    texts = {"run": "fourth", "run.1": "first", "run.2": "second"}
    assert {name: digest(tmp_path / name) for name in os.listdir(tmp_path)} == {
        name: digest_of(text) for name, text in texts.items()
    }
    (target / "figures" / "note.txt").write_text("mine")
    (note,) = write_run(target, "new", overwrite=True)
    assert "not its own" in note
    assert (tmp_path / "run.3" / "figures" / "note.txt").read_text() == "mine"
    assert digest(target) == digest_of("new")


def test_what_a_run_needs_no_more_goes_when_it_is_in_place(tmp_path):
    (tmp_path / "spent").touch()
    for given_up in (True, False):
        with RunFolder(tmp_path / "run") as run:
            run.remove_afterwards(tmp_path / "spent")
            run.remove_afterwards(tmp_path / "gone")
            run.write_json("result.json", {})
            if not given_up:
                run.put_in_place()
        assert os.listdir(tmp_path) == ["spent" if given_up else "run"]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["thesis.doc", "result.json", ".hidden", "sub/file"])
def test_folders_of_others_are_refused(tmp_path, overwrite, name):
    file = tmp_path / "run" / name
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    before = digest(tmp_path)
    words = f"{name.partition('/')[0]}.*another folder"
    assert re.search(words, refusal(RunFolder, tmp_path / "run", "simulate", overwrite))
    assert digest(tmp_path) == before


def test_a_folder_that_others_fill_meanwhile_is_left_to_them(tmp_path):
    target = tmp_path / "run"
    with RunFolder(target) as folder:
        folder.write_text("config.yaml", "")
        target.mkdir()
        (target / "theirs").write_text("")
        folder.write_json("result.json", {})
        (note,) = folder.put_in_place()
    assert os.listdir(target) == ["theirs"]
    assert str(tmp_path / "run.1") in note
    assert sorted(os.listdir(tmp_path / "run.1")) == ["config.yaml", "result.json"]


def test_a_link_leads_to_the_folder_and_permissions_stay(tmp_path):
    (tmp_path / "there").mkdir()
    os.chmod(tmp_path / "there", 0o750)
    (tmp_path / "link").symlink_to("there")
    write_run(tmp_path / "link", "first")
    write_run(tmp_path / "link", "second")
    assert (tmp_path / "link").is_symlink()
    assert digest(tmp_path / "there") == digest_of("second")
    assert digest(tmp_path / "there.1") == digest_of("first")
    assert (tmp_path / "there").stat().st_mode & 0o777 == 0o750


@pytest.mark.parametrize(
    ("where", "words"),
    [(".", "current folder"), ("../here", "current folder"), ("sub/..", "current folder"),
     ("..", "one above"), ("file", "not a folder"), ("file/below", ""), ("pipe", "not a folder"),
     ("", "empty"), ("a\0b", "")],
)  # fmt: skip
def test_places_that_no_folder_can_take(tmp_path, monkeypatch, where, words):
    """Another folder would replace the current one, under the user's shell, even if it is empty."""
    here = tmp_path / "parent" / "here"
    (here / "sub").mkdir(parents=True)
    monkeypatch.chdir(here)
    (here / "file").write_text("")
    os.mkfifo(here / "pipe")
    before = digest(tmp_path)
    assert words in refusal(RunFolder, where, "simulate")
    if where in ("", "a\0b", "file/below"):
        assert "output folder" in refusal(files.ResultFolder, where)
    assert digest(tmp_path) == before


def test_runs_that_cannot_be_replaced_are_kept(tmp_path, monkeypatch):
    """Neither a mount point nor the folder above the current one is overwritten."""
    here = tmp_path / "here"
    write_run(here, "old")
    monkeypatch.setattr(runs, "_mount_points", lambda: {os.path.realpath(here)})
    write_run(here / "simulate", "inside")
    before = digest(here)
    told = refusal(RunFolder, here, "simulate", overwrite=True)
    assert re.search(r"mount point.*here/simulate", told)
    monkeypatch.undo()
    monkeypatch.chdir(here / "figures")
    assert "current folder" in refusal(RunFolder, "..", "simulate", overwrite=True)
    assert digest(here) == before


def test_long_and_odd_names(tmp_path):
    for name in ("x" * 240, "ü" * 120, "a b\nc", "-o", "trailing.", "run.1"):
        write_run(tmp_path / "p" / name, "first")
        write_run(tmp_path / "p" / name, "second")
        assert digest(tmp_path / "p" / name) == digest_of("second")
    assert len(os.listdir(tmp_path / "p")) == 12


def test_a_second_process_is_kept_out(tmp_path):
    target = tmp_path / "run"
    with RunFolder(target):
        assert f"process {os.getpid()} is writing" in refusal(RunFolder, target, overwrite=True)
        write_run(tmp_path / "other", "not concerned")
        assert len(os.listdir(tmp_path)) == 3  # two of the run that goes on
    assert os.listdir(tmp_path) == ["other"]
    write_run(target, "free again")


def test_a_lock_on_a_file_that_is_gone_is_none(tmp_path, monkeypatch):
    """A lock is void if the last holder removes the file between opening and locking."""
    real = files.fcntl.flock

    def late(*arguments):
        monkeypatch.undo()
        os.unlink(tmp_path / "lock")
        return real(*arguments)

    monkeypatch.setattr(files.fcntl, "flock", late)
    held = files.Lock(tmp_path / "lock")
    assert refusal(files.Lock, tmp_path / "lock") == f"process {os.getpid()}"
    held.release()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("locks", [True, False])
def test_what_dead_processes_left_is_removed(tmp_path, monkeypatch, locks):
    """Also what a run into another folder left. Without locks, it may be of a run that goes on."""
    left = [f".{name}.1-00000000.rootsopt" for name in ("never again", "run")]
    for name in left:
        (tmp_path / name / "figures").mkdir(parents=True)
    if not locks:
        monkeypatch.setattr(files.fcntl, "flock", mock.Mock(side_effect=OSError(37, "No locks")))
    write_run(tmp_path / "run", "new")
    assert sorted(os.listdir(tmp_path)) == [*([] if locks else left), "run"]


def test_what_a_command_leaves_when_it_fails(tmp_path, capsys, monkeypatch):
    """After bad input found late, or an interrupt, nothing is new and the earlier run is unchanged.

    Each command has its own default folder, and the result names the command."""
    monkeypatch.chdir(tmp_path)
    command = ["profile", "cic_drawn", "--no-figures"]
    assert main([*command, "--export", "paper"]) == 2
    assert os.listdir(tmp_path) == []
    assert main(command) == 0
    place = tmp_path / "results" / "cic_drawn-profile"
    record = json.loads((place / "result.json").read_text())
    assert record["run"] == {"command": "profile", "files": sorted(os.listdir(place))}
    before = digest(tmp_path)
    write = "rootsopt.commands.work.profile.write"
    monkeypatch.setattr(write, mock.Mock(side_effect=KeyboardInterrupt))
    capsys.readouterr()
    assert main(command) == 3
    assert capsys.readouterr().err == "rootsopt profile: stopped by the user\n"
    assert digest(tmp_path) == before


AUDIT = """
import os, sys
seen = []
def hook(event, args):
    if event == "open" and isinstance(args[0], (str, bytes)):
        flags = args[2] if isinstance(args[2], int) else 0
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            seen.append(os.fsdecode(args[0]))
    elif event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link"):
        if args[-1] not in (None, -1) and event in ("os.remove", "os.rmdir"):
            return  # relative to a folder that was itself to be removed
        seen.append(os.fsdecode(args[0]))
sys.addaudithook(hook)
from rootsopt.commands.console import main
assert main(sys.argv[2:]) == 0
parent = os.path.realpath(sys.argv[1])
allowed = (os.path.join(parent, ".run."), "/dev/")
allowed += tuple(os.environ[name] for name in ("MPLCONFIGDIR", "XDG_CACHE_HOME", "ROOTSOPT_CACHE"))
print(*sorted({p for p in seen if not os.path.abspath(p).startswith(allowed)}), sep="\\n")
"""


@pytest.mark.parametrize("formats", ["dxf,svg", pytest.param("all", marks=pytest.mark.long)])
def test_nothing_is_written_outside_of_the_runs_own_folder(tmp_path, formats):
    """Figures, drawings, solids and animations are included.

    The system reports all files opened for writing, made, renamed or removed."""
    parent = tmp_path / "parent"
    parent.mkdir()
    others = {"MPLCONFIGDIR": matplotlib.get_cachedir(), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = [
        sys.executable, "-B", "-c", AUDIT, str(parent),
        "profile", "configs/cic_drawn.yaml", "-o", str(parent / "run"), "--export", formats,
    ]  # fmt: skip
    said = subprocess.check_output(command, cwd=ROOT, env=os.environ | others, text=True)
    assert said.split(f"results in {parent / 'run'}\n")[1].strip() == ""
    assert os.listdir(parent) == ["run"]
