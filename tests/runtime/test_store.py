"""Files of compiled programs: permissions, damage, eviction, processes."""

import os
import stat
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rootsopt.runtime import store
from rootsopt.runtime.store import Store, UnsafeFolderError

ROOT = Path(__file__).parents[2]
DATA = b"program" * 1000
posix = pytest.mark.skipif(os.name != "posix", reason="owners and permissions of POSIX")


@pytest.fixture
def kept(tmp_path):
    """Return a store with one entry, and the file that holds it."""
    made = Store(tmp_path / "cache")
    made.write("a", "for a", DATA)
    (file,) = (tmp_path / "cache").iterdir()
    return made, file


def test_what_was_written_is_read(kept, tmp_path):
    made, file = kept
    assert "a" in made
    assert "b" not in made
    assert made.read("a", "for a") == DATA
    assert Store(tmp_path / "cache").read("a", "for a") == DATA
    made.write("a", "for a", b"other")
    assert made.read("a", "for a") == b"other"
    assert [path.name for path in file.parent.iterdir()] == ["a.program"]


def flipped(data, place):
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


DAMAGE = {
    "empty": lambda data: b"",
    "one byte short": lambda data: data[:-1],
    "one byte long": lambda data: data + b"\0",
    "half": lambda data: data[: len(data) // 2],
    "no checksum": lambda data: DATA,
    "header": lambda data: flipped(data, 0),
    "checksum": lambda data: flipped(data, len(store._HEADER)),
    "first byte": lambda data: flipped(data, len(store._HEADER) + 32),
    "last byte": lambda data: flipped(data, len(data) - 1),
}


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_entry_is_none(kept, how):
    made, file = kept
    file.write_bytes(DAMAGE[how](file.read_bytes()))
    assert made.read("a", "for a") is None
    made.write("a", "for a", DATA)
    assert made.read("a", "for a") == DATA


def test_an_exchanged_entry_is_none(kept):
    """An entry under another name, or made for another purpose, is not returned."""
    made, file = kept
    made.write("b", "for b", DATA)
    other = file.with_name("b.program")
    assert made.read("b", "for a") is None
    other.write_bytes(file.read_bytes())
    assert made.read("b", "for b") is None
    assert made.read("b", "for a") is None


@posix
def test_only_plain_files_of_the_users_own_are_read(kept, monkeypatch, tmp_path):
    """Links, pipes and folders in an entry's place are ignored and do not block.

    So are files that others can write to."""
    made, file = kept
    whole = file.read_bytes()
    for mode in (0o620, 0o602, 0o666):
        file.chmod(mode)
        assert made.read("a", "for a") is None
    file.chmod(0o644)
    assert made.read("a", "for a") == DATA
    with monkeypatch.context() as patch:
        patch.setattr(os, "geteuid", lambda: os.getuid() + 1)
        assert made.read("a", "for a") is None
    with monkeypatch.context() as patch:
        patch.setattr(store, "MOST_BYTES", len(whole) - 1)
        assert made.read("a", "for a") is None
    (tmp_path / "elsewhere").write_bytes(whole)
    for put in (lambda: file.symlink_to(tmp_path / "elsewhere"), lambda: os.mkfifo(file),
                file.mkdir):  # fmt: skip
        file.unlink()
        put()
        assert made.read("a", "for a") is None
        assert "a" not in made
    with pytest.raises(OSError, match="directory"):
        made.write("a", "for a", DATA)
    assert [path.name for path in file.parent.iterdir()] == ["a.program"]


def refusal(folder):
    with pytest.raises(UnsafeFolderError) as caught:
        Store(folder)
    message = str(caught.value)
    assert "\n" not in message
    assert "choose" in message
    return message


@posix
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777, 0o1777, 0o720])
def test_a_folder_others_may_write_to_is_refused(tmp_path, mode):
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(mode)
    assert "chmod go-w" in refusal(folder)
    (tmp_path / "link").symlink_to(folder)
    assert str(folder) in refusal(tmp_path / "link")


@posix
def test_a_folder_others_may_exchange_is_refused(tmp_path):
    """A folder is refused if others can write to a folder above it without a sticky bit."""
    above = tmp_path / "above"
    above.mkdir()
    folder = above / "between" / "cache"
    for mode in (0o777, 0o775):
        above.chmod(mode)
        assert f"{str(above)!r}" in refusal(folder)
    above.chmod(0o1777)
    Store(folder).write("a", "for a", DATA)
    assert (
        stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE(folder.parent.stat().st_mode) == 0o700
    )
    assert stat.S_IMODE((folder / "a.program").stat().st_mode) == 0o600


@posix
def test_a_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    (tmp_path / "cache").mkdir()
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert "belongs to another user" in refusal(tmp_path / "cache")


def test_a_folder_that_cannot_be_used_is_an_os_error(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OSError, match=r"directory|exists"):
            Store(path)
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    with pytest.raises(OSError, match="circle"):
        Store(tmp_path / "circle")


def test_an_entry_written_by_many_is_whole(tmp_path):
    made, gate = Store(tmp_path / "cache"), threading.Barrier(6)

    def both(k):
        gate.wait()
        own = Store(tmp_path / "cache")
        seen = set()
        for _ in range(20):
            own.write("a", "for a", bytes([k]) * 10_000)
            seen.add(own.read("a", "for a"))
        return seen

    with ThreadPoolExecutor(6) as pool:
        seen = set().union(*pool.map(both, range(6)))
    assert None not in seen
    assert all(len(data) == 10_000 and len(set(data)) == 1 for data in seen)
    assert made.read("a", "for a") in seen
    assert [path.name for path in (tmp_path / "cache").iterdir()] == ["a.program"]


def make_older(folder):
    for path in folder.iterdir():
        os.utime(path, (time.time() - 1000,) * 2)


def test_unfinished_files_of_dead_processes_are_removed(tmp_path):
    """Unfinished files of the last minutes stay, and so do other files."""
    cache = tmp_path / "cache"
    Store(cache)
    (cache / ".a.program.0123").write_bytes(b"half")
    (cache / ".program").write_text("the user's")
    (cache / ".a.txt").write_text("the user's")
    Store(cache)
    assert len(list(cache.iterdir())) == 3
    make_older(cache)
    Store(cache)
    assert {path.name for path in cache.iterdir()} == {".program", ".a.txt"}


def test_the_entries_unused_for_longest_give_way(kept, monkeypatch, tmp_path):
    """The entries unused for longest are deleted; reading counts as use.

    Other files in the folder, older and larger, are left alone."""
    made, file = kept
    size = file.stat().st_size
    other = file.with_name("of the user")
    other.write_bytes(bytes(10 * size))
    os.utime(other, (0, 0))
    folder = file.with_name("folder.program")
    folder.mkdir()
    now = time.time()
    for age, name in enumerate("bcd", start=1):
        made.write(name, "x", DATA)
        os.utime(file.with_name(f"{name}.program"), (now - 100 * age, now - 100 * age))
    os.utime(file, (now - 1000, now - 1000))
    assert made.read("a", "for a") == DATA
    monkeypatch.setattr(store, "MOST_BYTES", 3.5 * size)
    made.write("e", "x", DATA)
    names = {path.name for path in file.parent.iterdir()}
    assert names == {"a.program", "b.program", "e.program", other.name, folder.name}


def test_entries_may_disappear_while_others_are_counted(kept, monkeypatch):
    made, _ = kept
    listed = os.listdir
    monkeypatch.setattr(os, "listdir", lambda path: [*listed(path), "gone.program", ".x.program.y"])
    made.write("b", "for b", DATA)
    assert made.read("a", "for a") == DATA
    assert made.read("b", "for b") == DATA


def test_a_system_without_owners(tmp_path, monkeypatch):
    """The store works as on Windows, without user ids."""
    monkeypatch.setattr(store, "_HAS_OWNERS", False)
    monkeypatch.delattr(os, "geteuid", raising=False)
    Store(tmp_path / "cache").write("a", "for a", DATA)
    assert Store(tmp_path / "cache").read("a", "for a") == DATA
