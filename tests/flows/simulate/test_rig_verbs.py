"""`rig check` on the command line, with fake devices, a scripted mirror behind a pty, and ports of nothing."""

from __future__ import annotations

import json
import os
import sys
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial

from tests.flows.conftest import CommandLine
from tests.pipeline.rig.mirror import mirror_bytes as w

NOWHERE = "127.0.0.1"
PLAIN = {b"GOPRO\r\n": b"OK\r\n", bytes.fromhex("7E 00 02 02 00 00 00 00 7E"): bytes(w.WELL[1])}
ANSWERS = {bytes(sent): received for sent, received in (w.GREET, *w.WHO)} | PLAIN


@contextmanager
def mirror_port() -> Iterator[str]:
    """Yield a port behind which a controller answers what connecting asks, one request at a time."""
    device, driver = os.openpty()
    tty.setraw(driver)

    def answer() -> None:
        try:
            while True:
                os.write(device, ANSWERS[os.read(device, 100)])  # type: ignore[arg-type]
        except (OSError, KeyError):
            return

    threading.Thread(target=answer, daemon=True).start()
    try:
        yield os.ttyname(driver)
    finally:
        os.close(driver)


def test_rig_check_of_fakes_moves_the_mirror_on_request(command_line: CommandLine, tmp_path: Path) -> None:
    """--move drives the square and returns to 0; 0, and --json prints one object."""
    file = tmp_path / "field.toml"
    file.write_text('source = "rig"\n[rig]\nport = "none"\nmirror_driver = "fake"\ncamera_driver = "fake"\n')
    ended = command_line("rig", "check", file, "--move", "--json")
    record = json.loads(ended.out)
    assert ended.code == record["exit_code"] == 0
    assert (record["failed"], record["warned"], record["move"]) == (0, 0, True)
    assert [row["asked"] for row in record["rows"] if row["asked"].startswith("go to")][-1] == "go to 0; 0"
    assert (record["port"], record["camera"]) == ("none", "10.0.65.50")
    ended = command_line("rig", "check", file)
    assert ended.code == 0
    assert "nothing to mend" in ended.out
    assert "go to" not in ended.out


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo terminals are of POSIX systems")
def test_rig_check_exits_with_3_if_one_of_two_devices_fails(command_line: CommandLine) -> None:
    """An unreachable camera beside a working mirror gives 3; a port in use, or a single failed device, gives 1."""
    with mirror_port() as port, serial.Serial(port, exclusive=True):
        ended = command_line("rig", "check", "--port", port)
        assert ended.code == 1
        assert "no other program" in " ".join(ended.out.split())
    with mirror_port() as port:
        ended = command_line("rig", "check", "--port", port, "--camera", NOWHERE, "--json")
        record = json.loads(ended.out)
        assert ended.code == record["exit_code"] == 3
        failed = [row for row in record["rows"] if row["verdict"] == "fail"]
        assert [row["device"] for row in failed] == ["camera", "camera"]
        assert "no connection to 127.0.0.1:8100" in failed[0]["came"]
        assert "is the camera on" in failed[0]["mend"]
        assert record["rows"][0]["came"].startswith("MR-E-2, version")
    assert command_line("rig", "check", "--camera", NOWHERE).code == 1


SPY = ("check", "--port", "spy:///dev/null?file=/tmp/x")


@pytest.mark.parametrize("words", [("check", "no.toml"), SPY, ("check", "--prot", "x"), ("nonsense",), ("emulate",)])
def test_usage_errors_exit_with_2(command_line: CommandLine, words: tuple[str, ...]) -> None:
    """One message is printed before anything is connected."""
    command_line("rig", *words).refused(2, "")


def test_a_driver_that_cannot_be_imported_is_refused(command_line: CommandLine, tmp_path: Path) -> None:
    """One message has the setting and its value; the exit code is 2."""
    file = tmp_path / "field.toml"
    file.write_text('[rig]\nmirror_driver = "nowhere:open_it"\n')
    command_line("rig", "check", file).refused(2, "rig.mirror_driver = 'nowhere:open_it' cannot be imported")
