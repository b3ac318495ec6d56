"""Files of compiled programs: permissions, damage, eviction, processes."""

import os
import stat
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from rootsopt.runtime import store
from rootsopt.runtime.store import Store, UnsafeFolderError

DATA = b"program" * 1000
posix = pytest.mark.skipif(os.name != "posix", reason="owners and permissions of POSIX")


@pytest.fixture
def kept(tmp_path):
    made = Store(tmp_path / "cache")
    made.write("a", "for a", DATA)
    (file,) = (tmp_path / "cache").iterdir()
    return made, file


def test_what_was_written_is_read(kept, tmp_path):
    made, file = kept
    assert ("a" in made, "b" in made) == (True, False)
    assert made.read("a", "for a") == Store(tmp_path / "cache").read("a", "for a") == DATA
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
    "that of another name": lambda data: store._checksum("b", "for a", DATA) + DATA,
    "that of another purpose": lambda data: store._checksum("a", "for b", DATA) + DATA,
}


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_entry_is_none(kept, how):
    made, file = kept
    file.write_bytes(DAMAGE[how](file.read_bytes()))
    assert made.read("a", "for a") is None
    made.write("a", "for a", DATA)
    assert made.read("a", "for a") == DATA


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
    for patched in (
        (os, "geteuid", lambda: os.getuid() + 1),
        (store, "MOST_BYTES", len(whole) - 1),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(*patched)
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
    with pytest.raises(UnsafeFolderError, match="choose") as caught:
        Store(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "folder").mkdir()
    return tmp_path / "folder"


@posix
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777, 0o1777, 0o720])
def test_a_folder_others_may_write_to_is_refused(folder, mode):
    folder.chmod(mode)
    assert "chmod go-w" in refusal(folder)
    folder.with_name("link").symlink_to(folder)
    assert str(folder) in refusal(folder.with_name("link"))


@posix
def test_a_folder_others_may_exchange_is_refused(folder):
    inner = folder / "between" / "cache"
    for mode in (0o777, 0o775):
        folder.chmod(mode)
        assert f"{str(folder)!r}" in refusal(inner)
    folder.chmod(0o1777)
    Store(inner).write("a", "for a", DATA)
    modes = [stat.S_IMODE(x.stat().st_mode) for x in (inner.parent, inner, inner / "a.program")]
    assert modes == [0o700, 0o700, 0o600]


@posix
def test_a_folder_of_another_user_is_refused(folder, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert "belongs to another user" in refusal(folder)


def test_a_folder_that_cannot_be_used_is_an_os_error(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    for name, said in (
        ("file", "directory|exists"),
        ("file/below", "directory"),
        ("circle", "circle"),
    ):
        with pytest.raises(OSError, match=said):
            Store(tmp_path / name)


def test_an_entry_written_by_many_is_whole(tmp_path):
    gate, seen = threading.Barrier(6), set()

    def both(k):
        gate.wait()
        own = Store(tmp_path / "cache")
        for _ in range(20):
            own.write("a", "for a", bytes([k]) * 10_000)
            seen.add(own.read("a", "for a"))

    with ThreadPoolExecutor(6) as pool:
        [*pool.map(both, range(6))]
    assert seen <= {bytes([k]) * 10_000 for k in range(6)}
    assert Store(tmp_path / "cache").read("a", "for a") in seen
    assert [path.name for path in (tmp_path / "cache").iterdir()] == ["a.program"]


def test_unfinished_files_of_dead_processes_are_removed(folder):
    """Unfinished files of the last minutes stay, and so do other files."""
    for name in (".a.program.0123", ".program", ".a.txt"):
        (folder / name).write_text("half a program, or the user's")
    Store(folder)
    assert len(list(folder.iterdir())) == 3
    for path in folder.iterdir():
        os.utime(path, (time.time() - 1000,) * 2)
    Store(folder)
    assert {path.name for path in folder.iterdir()} == {".program", ".a.txt"}


def test_the_entries_unused_for_longest_give_way(kept, monkeypatch, tmp_path):
    made, file = kept
    size, now = file.stat().st_size, time.time()
    other = file.with_name("of the user")
    other.write_bytes(bytes(10 * size))
    os.utime(other, (0, 0))
    file.with_name("folder.program").mkdir()
    for age, name in ((100, "b"), (200, "c"), (300, "d"), (1000, "a")):
        made.write(name, f"for {name}", DATA)
        os.utime(file.with_name(f"{name}.program"), (now - age, now - age))
    assert made.read("a", "for a") == DATA
    monkeypatch.setattr(store, "MOST_BYTES", 3.5 * size)
    made.write("e", "x", DATA)
    names = {path.name.removesuffix(".program") for path in file.parent.iterdir()}
    assert names == {"a", "b", "e", "of the user", "folder"}


def test_entries_may_disappear_while_others_are_counted(kept, monkeypatch):
    made, file = kept
    listed, gone = type(file).glob, ("gone.program", ".x.program.y")
    monkeypatch.setattr(
        type(file), "glob", lambda *where: [*listed(*where), *map(file.with_name, gone)]
    )
    made.write("b", "for b", DATA)
    Store(file.parent)
    assert made.read("a", "for a") == made.read("b", "for b") == DATA


def test_a_system_without_owners(tmp_path, monkeypatch):
    """The store works as on Windows, without user ids."""
    monkeypatch.setattr(store, "_HAS_OWNERS", False)
    monkeypatch.delattr(os, "geteuid", raising=False)
    Store(tmp_path / "cache").write("a", "for a", DATA)
    assert Store(tmp_path / "cache").read("a", "for a") == DATA
