"""The lock of a rig: one holder for all accounts, temporary folders and archives of a machine."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import pytest

from spectralzoom.flows.tasks import rig_field
from spectralzoom.flows.tasks.rig_field import rig_to_oneself
from spectralzoom.pipeline.errors import RigError

ROOT = Path(__file__).parents[3]
PORT = f"/dev/ttyTEST{os.getpid()}"  # two runs of these tests on one machine use two rigs
TAKES = """
import sys
from spectralzoom.flows.tasks.rig_field import rig_to_oneself
try:
    with rig_to_oneself(sys.argv[1]):
        print(True, flush=True)
        sys.stdin.read()
except OSError:
    print(False, flush=True)
    sys.stdin.read()
"""


@contextmanager
def takers(folder: Path, count: int) -> Iterator[list[tuple[subprocess.Popen[str], bool]]]:
    """Yield processes that try to take the rig in turn, each with another TMPDIR and HOME."""
    tried: list[tuple[subprocess.Popen[str], bool]] = []
    try:
        for number in range(count):
            temporary = folder / f"tmp-{number}"
            temporary.mkdir(mode=0o777)
            environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary), "HOME": str(temporary)}
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
            process = subprocess.Popen([sys.executable, "-c", TAKES, PORT], env=environment, text=True, **pipes)
            tried.append((process, process.stdout.readline() == "True\n"))
        yield tried
    finally:
        for process, _ in tried:
            process.kill()
            process.communicate()


def assert_held(port: str) -> None:
    """Assert that another process or block holds a rig."""
    with pytest.raises(RigError, match=r"is in use by another survey; wait until that has ended"), rig_to_oneself(port):
        pass


def test_one_of_three_processes_holds_the_rig(tmp_path: Path) -> None:
    """Each has another TMPDIR; the rig is free once its holder is killed."""
    with takers(tmp_path, 3) as tried:
        assert [took for _, took in tried] == [True, False, False]
        assert_held(PORT)
        first = tried[0][0]
        first.kill()
        first.wait()
        with rig_to_oneself(PORT):
            assert_held(PORT)


def test_a_lock_belongs_to_the_port(tmp_path: Path) -> None:
    """A link to the device has the lock of the device; long addresses that differ at the end have two locks."""
    (tmp_path / "tty").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "tty")
    with rig_to_oneself(str(tmp_path / "tty")):
        assert_held(str(tmp_path / "by-id"))
    one, other = (f"socket://{'a' * 200}:{port}" for port in (5000, 5001))
    with rig_to_oneself(one), rig_to_oneself(other):
        assert_held(one)
        assert_held(other)


def test_a_rig_that_cannot_be_locked_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel refuses the lock for a reason other than a holder; there is one message."""
    monkeypatch.setattr(rig_field.socket, "socket", Mock(side_effect=PermissionError(1, "Operation not permitted")))
    with (
        pytest.raises(RigError, match=r"cannot lock the rig .*: Operation not permitted; .* need Linux"),
        rig_to_oneself(PORT),
    ):
        pass
