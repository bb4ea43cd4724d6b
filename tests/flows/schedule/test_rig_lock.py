"""One rig, one holder: whoever asks, from whichever account, folder for temporary files or archive."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flows.tasks import rig_lock as rig_locks
from flows.tasks.rig_lock import RigLock, rig_lock
from pipeline.errors import ArchiveError, RigError
from storage.archive.staging import take_lock

ROOT = Path(__file__).parents[3]
PORT = f"/dev/ttyTEST{os.getpid()}"  # two runs of these tests on one machine are two rigs
TAKES = """
import os, sys
os.access = lambda *given, **named: False  # /run/lock is for others
from flows.tasks.rig_lock import rig_lock
lock = rig_lock(sys.argv[1])
print(lock.take("a survey"), flush=True)
sys.stdin.read()
"""


@contextmanager
def takers(folder: Path, count: int) -> Iterator[list[tuple[subprocess.Popen[str], bool]]]:
    """Processes that take the rig one after the other, each with another TMPDIR; of other users, where that may be."""
    tried: list[tuple[subprocess.Popen[str], bool]] = []
    try:
        for number in range(count):
            temporary = folder / f"tmp-{number}"
            temporary.mkdir(mode=0o777)
            environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary), "HOME": str(temporary)}
            process = subprocess.Popen(
                [sys.executable, "-c", TAKES, PORT],
                env=environment,
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
            assert process.stdout is not None
            tried.append((process, process.stdout.readline() == "True\n"))
        yield tried
    finally:
        for process, _ in tried:
            process.kill()
            process.communicate()


def test_three_users_with_folders_of_their_own(tmp_path: Path) -> None:
    """With /run/lock shut and another TMPDIR each, one of three has the rig, and it is free once that one is killed."""
    with takers(tmp_path, 3) as tried:
        assert [took for _, took in tried] == [True, False, False]
        lock, holder = rig_lock(PORT), tried[0][0]
        assert not lock.take("a survey")
        assert lock.holder() == f"a survey (process {holder.pid})"
        holder.kill()
        holder.wait()
        assert lock.take("by hand")
        assert rig_lock(PORT).holder() == f"by hand (process {os.getpid()})"
        lock.release()
    assert rig_lock(PORT).holder() == "another process"


def test_locks_are_of_the_port_and_say_their_holder(tmp_path: Path) -> None:
    """A link to the device is the device; words of a killed process are not kept."""
    (tmp_path / "tty").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "tty")
    assert rig_lock(str(tmp_path / "by-id")).place == rig_lock(str(tmp_path / "tty")).place
    one, other = (rig_lock(f"socket://{'a' * 200}:{port}") for port in (5000, 5001))
    assert one.take("a survey")
    assert other.take("a survey")
    one.release()
    other.release()
    path = tmp_path / "rig.lock"
    path.write_text("a survey of a field with a very long name indeed (process 1)\n")
    lock = RigLock(path)
    assert lock.take("x")
    assert path.read_text() == f"x (process {os.getpid()})\n"
    lock.release()


def test_a_rig_that_cannot_be_locked_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the kernel refuses for another reason than that it is held, there is one message and no rig."""

    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(rig_locks.socket, "socket", refuse)
    with pytest.raises(RigError, match=r"cannot lock the rig .*: Operation not permitted; .* goes on without"):
        rig_lock(PORT).take("a survey")


def test_a_system_without_such_names_uses_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Elsewhere than on Linux a file at a fixed place is the lock, whatever TMPDIR says, and links are refused."""
    monkeypatch.setattr(rig_locks.sys, "platform", "darwin")
    place = rig_lock("/dev/cu.usb").place
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert rig_lock("/dev/cu.usb").place == place == Path("/tmp/spectralzoom-rig-dev-cu.usb.lock")
    monkeypatch.setattr(rig_locks, "FIXED_FOLDER", tmp_path)
    lock, other = rig_lock("/dev/cu.usb"), rig_lock("/dev/cu.usb")
    assert lock.take("a survey")
    assert not other.take("a survey")
    assert other.holder() == f"a survey (process {os.getpid()})"
    lock.release()


@pytest.mark.parametrize("kind", ["to a file", "to nothing", "hard"])
def test_what_a_lock_points_at_is_left_alone(tmp_path: Path, kind: str) -> None:
    """A link in the lock's place is refused by name; a file that has another name too is locked and not written."""
    target, path = tmp_path / "precious", tmp_path / "rig.lock"
    if kind != "to nothing":
        target.write_text("bytes")
    lock = RigLock(path)
    if kind == "hard":
        path.hardlink_to(target)
        assert lock.take("a survey")
        lock.release()
    else:
        path.symlink_to(target)
        with pytest.raises(ArchiveError, match=r"rig\.lock is a link, expected a lock file of its own; see where it"):
            lock.take("a survey")
    assert target.exists() == (kind != "to nothing")
    assert not target.exists() or target.read_text() == "bytes"


def test_locks_of_an_archive_follow_no_link(tmp_path: Path) -> None:
    """Neither a lock nor the folder of locks is used through a link; a FIFO is no lock file."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("linked", "piped"):
        (tmp_path / name).mkdir()
    (tmp_path / "linked" / ".locks").symlink_to(elsewhere)
    (tmp_path / "piped" / ".locks").mkdir()
    os.mkfifo(tmp_path / "piped" / ".locks" / "use.lock")
    with pytest.raises(ArchiveError, match=r"\.locks is a link, expected a folder of its own"):
        take_lock(tmp_path / "linked" / ".locks" / "use.lock")
    with pytest.raises(ArchiveError, match=r"use\.lock is no file, expected a lock file"):
        take_lock(tmp_path / "piped" / ".locks" / "use.lock")
    assert list(elsewhere.iterdir()) == []
