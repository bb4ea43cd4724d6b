"""The lock of a rig: one holder for all accounts, temporary folders and archives of a machine."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from spectralzoom.flows.opening import rig_field
from spectralzoom.flows.opening.rig_field import RigHold, rig_to_oneself
from spectralzoom.pipeline.errors import RigError
from tests.source_paths import PYTHON_PATH

PORT = f"/dev/ttyTEST{os.getpid()}"  # two runs of these tests on one machine use two rigs
HOLDS = """
import sys
from spectralzoom.flows.opening.rig_field import rig_to_oneself
with rig_to_oneself(sys.argv[1]):
    print(flush=True)
    sys.stdin.read()
"""


def assert_held(port: str) -> None:
    """Assert that another process or block holds a rig."""
    with pytest.raises(RigError, match=r"is in use by another survey; wait until that has ended"), rig_to_oneself(port):
        pass


def test_a_killed_holder_frees_the_rig(tmp_path: Path) -> None:
    """Until then it holds it also for processes with another TMPDIR and HOME."""
    environment = {**os.environ, "PYTHONPATH": PYTHON_PATH}
    environment |= {"TMPDIR": str(tmp_path), "HOME": str(tmp_path)}
    command = [sys.executable, "-c", HOLDS, PORT]
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"\n"
        assert_held(PORT)
        holder.kill()
    with rig_to_oneself(PORT):
        assert_held(PORT)


def test_a_survey_holds_the_rig_from_its_first_capture_to_its_end() -> None:
    """Stored captures need no rig; later ones find it held by their own survey."""
    with RigHold(PORT, print) as hold:
        with rig_to_oneself(PORT):
            assert_held(PORT)
        for _ in range(2):
            hold.take()
            assert_held(PORT)
    with rig_to_oneself(PORT):
        pass


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
