"""`rig check` and `rig emulate` on the command line, through a real pty and real sockets."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import pytest
import serial

from flows.cli.rig_commands import _write_survey, emulated_settings, run_emulate
from flows.settings.flags import RenderingFlags
from flows.settings.load import SURVEY, TABLES, load_settings
from pipeline.rig.emulator.emulated_rig import FastClock, ServedRig
from tests.conftest import QUIET
from tests.flows.conftest import CommandLine
from tests.pipeline.rig.camera_faults import FaultyRig
from tests.pipeline.rig.mirror_faults import make_fault
from tests.pipeline.rig.small_rig import set_anything, small_source

NOWHERE = "127.0.0.1:1:1"


@contextmanager
def served(*faults: str) -> Iterator[ServedRig]:
    """Yield an emulated rig behind ports, whose faults occur at the first occasion."""
    struck = [make_fault(name, at=0) for name in faults]
    with FaultyRig(small_source(), FastClock(20.0), mirror_faults=struck).serve() as rig:
        yield rig


def test_rig_check_reads_addresses_from_a_settings_file(command_line: CommandLine, tmp_path: Path) -> None:
    """Flags override it; --move drives the square and returns to 0; 0, and --json prints one object."""
    with served() as rig:
        file = tmp_path / "field.toml"
        file.write_text(
            f'source = "rig"\n[rig]\nport = "/dev/ttyNONE"\nhost = "{rig.host}"\ncontrol_port = {rig.camera_port}\n'
            f"file_port = {rig.file_port}\n"
        )
        ended = command_line("rig", "check", file, "--port", rig.port, "--move", "--json")
        record = json.loads(ended.out)
        assert ended.code == record["exit_code"] == 0
        assert (record["failed"], record["warned"], record["move"]) == (0, 0, True)
        assert [row["asked"] for row in record["rows"] if row["asked"].startswith("go to")][-1] == "go to 0; 0"
        assert record["port"] == rig.port
        assert record["camera"] == f"{rig.host}:{rig.camera_port}"
        assert set_anything(rig.rig.mirror)


def test_rig_check_exits_with_3_if_one_of_two_devices_fails(command_line: CommandLine) -> None:
    """An unreachable camera beside a working mirror gives 3; a port in use, or a single failed device, gives 1."""
    with served() as rig, serial.Serial(rig.port, exclusive=True):
        ended = command_line("rig", "check", "--port", rig.port)
        assert ended.code == 1
        assert "no other program" in " ".join(ended.out.split())
    with served() as rig:
        ended = command_line("rig", "check", "--port", rig.port, "--camera", NOWHERE, "--json")
        record = json.loads(ended.out)
        assert ended.code == record["exit_code"] == 3
        failed = [row for row in record["rows"] if row["verdict"] == "fail"]
        assert [row["device"] for row in failed] == ["camera", "camera"]
        assert "no connection to 127.0.0.1:1" in failed[0]["came"]
        assert "is the camera on" in failed[0]["mend"]
    assert command_line("rig", "check", "--camera", NOWHERE).code == 1


@pytest.mark.parametrize(
    "words",
    [
        ("check", "--camera", "host:99999"),
        ("check", "--camera", ":80"),
        ("check", "no.toml"),
        ("check", "--port", "nonsense://x"),
        ("check", "--prot", "x"),
        ("nonsense",),
        ("emulate", "--speed", "0"),
        ("emulate", "--baud", "-1"),
        ("emulate", "--size", "12"),
        ("emulate", "-o", "/nowhere/x.toml"),
        ("emulate", "--seed", "x"),
    ],
)
def test_usage_errors_exit_with_2(command_line: CommandLine, words: tuple[str, ...]) -> None:
    """One message is printed before anything is rendered or connected."""
    command_line("rig", *words).refused(2, "")


def test_rig_check_of_a_working_rig_moves_nothing(command_line: CommandLine) -> None:
    """It prints a table of requests and replies, and exits with 0."""
    with served() as rig:
        camera = f"{rig.host}:{rig.camera_port}:{rig.file_port}"
        ended = command_line("rig", "check", "--port", rig.port, "--camera", camera)
        assert ended.code == 0
        assert "MR-E-2" in ended.out
        assert "nothing to mend" in ended.out
        assert not set_anything(rig.rig.mirror)


def test_a_driver_that_cannot_be_imported_is_refused(command_line: CommandLine, tmp_path: Path) -> None:
    """One message has the setting and its value; the exit code is 2."""
    file = tmp_path / "field.toml"
    file.write_text('[rig]\nmirror_driver = "nowhere:open_it"\n')
    command_line("rig", "check", file).refused(2, "rig.mirror_driver = 'nowhere:open_it' cannot be imported")


def test_rig_check_reads_the_file_of_an_emulated_rig(command_line: CommandLine, tmp_path: Path) -> None:
    """The file has the survey settings of that rig; both devices answer there until the emulation ends."""
    file = tmp_path / "emulated.toml"
    wanted: dict[str, object] = {"scene": "scouting", "size": "64x48", "bands": "40,90", "effects": "all", "seed": "3"}
    wanted |= {"interest": "0.5", "day": "150", "hour": "9.5", "sky.light_fraction": "0.4"}
    wanted |= {"rig.mirror_axes": "y,-x", "camera.samples": "320", "detector.noiseless": True, "optics.focus_m": 40.0}
    settings = emulated_settings(None, wanted)
    ended = threading.Event()
    codes = []

    def emulate() -> None:
        codes.append(run_emulate(settings, QUIET, baud=0, speed=20.0, out=file, as_json=True, ended=ended))

    thread = threading.Thread(target=emulate)
    thread.start()
    try:
        while thread.is_alive() and not file.exists():
            thread.join(0.05)
        written = load_settings(file)
        assert written.simulated_rig == settings.simulated_rig
        assert (written.rig.provenance, written.rig.mirror_axes) == ("emulated", "y,-x")
        of_the_light = {one.name for one in fields(RenderingFlags)} & (set(SURVEY) - set(TABLES))
        assert {"seed", "interest", "hour"} <= of_the_light
        for name in ("scene", "size", *of_the_light):
            assert getattr(written, name) == getattr(settings, name)
        assert written.source == "rig"
        assert command_line("rig", "check", file).code == 0
    finally:
        ended.set()
        thread.join()
    assert codes == [0]
    assert command_line("rig", "check", file).code == 1


def test_emulated_scene_is_found_from_every_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative names in a file start at its folder, those of flags at the current folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    _write_survey(tmp_path / "there" / "x.toml", load_settings(None, {"scene": "x.png", "source": "sim"}), {})
    assert load_settings(tmp_path / "there" / "x.toml").scene == str(tmp_path / "x.png")


def test_emulation_ends_at_ctrl_c(scene_files: Path) -> None:
    """The exit code is 0, and the port is gone."""
    words = ["rig", "emulate", "--scene", str(scene_files / "scene.png"), "--effects", "shot"]
    with subprocess.Popen(
        [sys.executable, "-m", "flows.cli.main", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        lines = iter(process.stdout.readline, "")
        port = tomllib.loads("".join(next(lines) for _ in range(7)))["rig"]["port"]
        assert Path(port).exists()
        process.send_signal(signal.SIGINT)
        _, words_left = process.communicate(timeout=30)
    assert process.returncode == 0
    assert "closed" in words_left
    assert "Traceback" not in words_left
    with pytest.raises(serial.SerialException):
        serial.Serial(port)
