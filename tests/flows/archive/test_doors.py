"""Hostile receipts open no door: only `survey` and `rig check` open devices, and never those that a receipt names."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

import spectralzoom
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.drivers import open_devices
from tests.conftest import QUIET
from tests.flows.conftest import CommandLine
from tests.storage.small_archive import rewrite

EVIL = "evil_driver_of_a_receipt"
DRIVERS = {"mirror_driver": f"{EVIL}:open", "camera_driver": f"{EVIL}:open"}
ADDRESSES = {"port": "socket://evil.example:1", "host": "evil.example", "user": "x", "password": "y"}
HOSTILE: dict[str, Any] = {
    "drivers": {**DRIVERS, **ADDRESSES},
    "addresses": {"mirror_driver": "", "camera_driver": "", **ADDRESSES},
    "one fake": {"mirror_driver": "fake", "camera_driver": "", **ADDRESSES},
    "other fake": {"mirror_driver": "", "camera_driver": "fake", **ADDRESSES},
    "program": {"mirror_driver": "os:system", "camera_driver": "os:system", "port": "spy:///dev/null?file=/tmp/evil"},
    "no table": "socket://evil.example:1",
    "no text": {"port": 7, "mirror_driver": ["os:system"], "mirror_axes": {}},
}


class Doors:
    """What the process connects to, looks up, opens below /dev and imports, by Python's audit events."""

    def __init__(self) -> None:
        self.watches = False
        self.opened: list[str] = []
        sys.addaudithook(self.hear)  # for the rest of the process; without a watch it hears nothing

    def hear(self, event: str, told: tuple[Any, ...]) -> None:
        if not self.watches:
            return
        if event in ("socket.connect", "socket.getaddrinfo", "os.system", "subprocess.Popen"):
            self.opened.append(f"{event} {told}")
        if event == "open" and str(told[0]).startswith("/dev/") and told[0] not in ("/dev/null", "/dev/urandom"):
            self.opened.append(str(told[0]))
        if event == "open" and EVIL in Path(str(told[0])).name and "r" in (told[1] or "r"):
            self.opened.append(EVIL)


DOORS = Doors()


@pytest.fixture
def doors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Yield the doors that are opened from here on; the evil driver can be imported."""
    (tmp_path / f"{EVIL}.py").write_text("def open(rig, clock):\n    raise SystemExit(99)\n")
    monkeypatch.syspath_prepend(tmp_path)
    DOORS.opened, DOORS.watches = [], True
    yield DOORS.opened
    DOORS.watches = False
    sys.modules.pop(EVIL, None)


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive of one survey through a fake rig; do not change it."""
    out = tmp_path_factory.mktemp("doors") / "archive"
    asked = {
        **{"size": "64x64", "bands": "40,90,150,200", "engine": "plain", "budget": 0.8, "visit": "first"},
        **{"effects": "none", "keep": "raw", "source": "rig", "out": str(out)},
        **{"rig.mirror_driver": "fake", "rig.camera_driver": "fake"},
    }
    run_survey(load_settings(None, asked), QUIET)
    return out


def forged(surveyed: Path, out: Path, rig: Any) -> Path:
    """Return a copy of the archive whose receipt has a hostile table [rig], with checksums that fit."""
    shutil.copytree(surveyed, out)
    (run,) = (out / "runs").iterdir()
    receipt = json.loads((run / "receipt.json").read_text())
    receipt["settings"]["rig"] = {**receipt["settings"]["rig"], **rig} if isinstance(rig, dict) else rig
    text = json.dumps(receipt).encode()
    (run / "receipt.json").write_bytes(text)
    files = json.loads((run / "manifest.json").read_text())["files"]
    rewrite(run / "manifest.json", files=files | {"receipt.json": [len(text), hashlib.sha256(text).hexdigest()]})
    return run


def commands(out: Path, run: str, to: Path) -> list[list[str]]:
    """Return commands that read receipts, in an order in which all of them find the run."""
    return [
        ["ls", str(out)],
        ["verify", str(out)],
        ["explain", str(out), run],
        ["export", str(out), run, "--out", str(to / "exported")],
        ["plan", "--sweeps", f"{out}/runs/{run}", "--out", str(to / "planned")],
        ["survey", "--sweeps", f"{out}/runs/{run}", "--out", str(to / "again"), "--engine", "plain"],
        ["reprocess", str(out), "--dry-run"],
        ["reprocess", str(out)],
    ]


@pytest.mark.parametrize("name", HOSTILE)
def test_no_command_follows_a_hostile_receipt(
    surveyed: Path, doors: list[str], command_line: CommandLine, tmp_path: Path, name: str
) -> None:
    """Each command ends with output or one message; nothing is connected, opened or imported."""
    out = tmp_path / "archive"
    run = forged(surveyed, out, HOSTILE[name]).name
    for words in commands(out, run, tmp_path):
        ended = command_line(*words)
        assert ended.code in (0, 1, 2, 3), (words, ended.err)
        assert not {"Traceback", "Unknown"} & set(ended.err.split())
        assert doors == [], words
    assert spectralzoom.open(out).latest.class_map is not None
    assert not (tmp_path / "evil").exists()
    receipts = [path.read_text() for path in (tmp_path / "again").rglob("receipt.json")]
    assert receipts or HOSTILE[name] in (HOSTILE["no table"], HOSTILE["no text"])
    assert not any("evil" in text for text in receipts)  # nor does a new receipt repeat an address


@pytest.mark.parametrize("name", ["drivers", "addresses", "one fake"])
def test_lost_lines_are_not_captured_again_from_a_receipt(
    surveyed: Path, doors: list[str], command_line: CommandLine, tmp_path: Path, name: str
) -> None:
    """One message says that only `survey` opens a rig."""
    out = tmp_path / "archive"
    forged(surveyed, out, HOSTILE[name])
    for stage in (out / "stages").iterdir():
        if stage.name.startswith(("capture", "condense")):
            shutil.rmtree(stage)
    ended = command_line("reprocess", str(out))
    assert ended.code == 1
    assert "only `spectralzoom survey` opens a rig" in " ".join((ended.out + ended.err).split())
    assert doors == []


def test_a_plan_imports_no_driver(doors: list[str], command_line: CommandLine, tmp_path: Path) -> None:
    """`plan` of one's own settings needs no device; `survey` imports the driver, which here ends it."""
    file = tmp_path / "field.toml"
    table = "\n".join(f'{name} = "{value}"' for name, value in {**DRIVERS, **ADDRESSES}.items())
    file.write_text(f'source = "rig"\nsize = "64x64"\nbands = "40,90,150,200"\n[rig]\n{table}\n')
    assert command_line("plan", str(file), "--out", str(tmp_path / "out")).code == 0
    assert doors == []
    with pytest.raises(SystemExit, match="99"), closing(open_devices(SurveyRig(**DRIVERS), 1500)):
        pass
    assert EVIL in doors


DEVICES = {
    'mirror_driver = "nowhere:open_it"': "rig.mirror_driver = 'nowhere:open_it' cannot be imported",
    'camera_driver = "a b"': "rig.camera_driver = 'a b' cannot be imported",
    'port = "spy:///dev/null?file=/tmp/x"': "rig.port = 'spy:///dev/null.* is no port; give a device such as",
}


@pytest.mark.parametrize("line", DEVICES)
def test_a_survey_refuses_a_device_before_it_begins(command_line: CommandLine, tmp_path: Path, line: str) -> None:
    """One message, and no archive is made."""
    file = tmp_path / "field.toml"
    file.write_text(f'source = "rig"\nsize = "64x64"\nbands = "40,90"\n[rig]\n{line}\n')
    ended = command_line("survey", str(file), "--engine", "plain", "--out", str(tmp_path / "out"))
    ended.refused(2, DEVICES[line])
    assert not (tmp_path / "out").exists()
