"""The camera that how-to/second-rig.md builds takes a sweep with the fake mirror."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from spectral.io import envi

from spectralzoom.flows.cli.rig_commands import check_camera, try_capture
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.pipeline.errors import RigError, SettingsError
from spectralzoom.pipeline.frame_indices import LineTimes
from spectralzoom.pipeline.geometry.scan import line_positions
from spectralzoom.pipeline.rig.camera.camera_cubes import CapturedLines
from spectralzoom.pipeline.rig.camera.camera_files import KeptInMemory
from spectralzoom.pipeline.rig.capture_paths import REFERENCES, capture_prefix
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.drivers import (
    CameraDriver,
    DriverFailed,
    OtherMake,
    RigDevices,
    open_camera_driver,
    open_mirror_driver,
)
from spectralzoom.pipeline.rig.fakes import FakeCamera, FakeClock, FakeMirror
from spectralzoom.pipeline.rig.rig_source import RigSource
from spectralzoom.pipeline.rig.transports import Clock, StateUnknown
from tests.docs.pages import DOCS, blocks_of
from tests.pipeline.rig.small_rig import CAMERA, FINE, small_source

MODULE = "folder_camera"


class SharedClock(FakeClock):
    """A clock whose sleep lets another program work."""

    program: Program | None = None

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        if self.program is not None:
            self.program.work()


@dataclass
class Program:
    """The camera's program as the page describes it: it captures by a fake camera and writes ENVI by SPy."""

    folder: Path
    seen: FakeCamera
    busy: bool = False
    runs: dict[str, str] = field(default_factory=dict)  # folders of the fake camera, by names of captures

    def work(self) -> None:
        """Take new requests, and save finished captures."""
        if self.busy:
            return
        self.busy = True
        for request in self.folder.glob("*.request"):
            self._begin(request)
        if self.runs and not self.seen.is_capturing():
            self._drop()
        self.busy = False

    def _begin(self, request: Path) -> None:
        frames, *times = request.read_text().split()
        self.seen.configure(*map(float, times))
        self.runs[request.stem] = self.seen.capture(int(frames), prefix=request.stem.rpartition("-")[0]).folder
        (self.folder / f"{request.stem}.raw").touch()
        request.unlink()

    def _drop(self) -> None:
        for name, folder in self.runs.items():
            if not name.startswith(REFERENCES):
                self._save(name, self.seen.fetch(folder, KeptInMemory()).values)
                continue
            for kind, frame in self.seen.references(folder, KeptInMemory()).items():
                self._save(f"{name}_{kind}", np.rint(frame.mean)[None].astype(np.uint16))
            self._save(name, np.zeros((1, *frame.mean.shape), np.uint16))
        self.runs.clear()

    def _save(self, name: str, values: np.ndarray[Any, Any]) -> None:
        fps = 1000 / self.seen.times_ms[1]
        path = str(self.folder / f"{name}.hdr")
        envi.save_image(path, values, dtype=np.uint16, interleave="bil", ext="raw", force=True, metadata={"fps": fps})


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Write the page's code as an importable module for one test."""
    (block,) = (block for block in blocks_of(DOCS / "how-to" / "second-rig.md") if block.file == f"{MODULE}.py")
    path = tmp_path / "code" / f"{MODULE}.py"
    path.parent.mkdir()
    path.write_text(block.text)
    monkeypatch.syspath_prepend(path.parent)
    yield
    sys.modules.pop(MODULE, None)


def folder_rig(folder: Path) -> tuple[RigSource, CameraDriver, Program]:
    """Return a source of a fake mirror and the page's camera, the camera, and its program in ``folder``."""
    folder.mkdir()
    clock = SharedClock(50.0)
    settings = SurveyRig(camera_driver=f"{MODULE}:open_camera", host=str(folder))
    clock.program = Program(folder, FakeCamera(clock, small_source()))
    camera = open_camera_driver(settings, clock)
    devices = RigDevices(FakeMirror(clock), camera, clock)
    source = RigSource(CAMERA, small_source().wavelength_nm, lambda seen: devices, rig=settings)
    return source, camera, clock.program


@pytest.mark.usefixtures("module")
def test_the_camera_of_the_page_takes_a_sweep(tmp_path: Path) -> None:
    """All lines are valid and in their places, and have values and references of the camera's files."""
    source, _, _ = folder_rig(tmp_path / "incoming")
    found = list(source.lines(FINE))
    references = source.references(FINE)
    (told,) = source.record["captures"]
    assert [line.number for line in found] == list(range(FINE.lines))
    assert all(line.valid for line in found)
    assert told["folder"] == f"{capture_prefix(FINE)}-0"
    header = tmp_path / "incoming" / f"{capture_prefix(FINE)}-0.hdr"
    stored = envi.open(str(header)).open_memmap(interleave="bip")
    np.testing.assert_array_equal([line.data for line in found], stored)
    np.testing.assert_allclose([line.time_s for line in found], CAMERA.mid_exposure_s(np.arange(FINE.lines)), atol=1e-6)
    places = [(line.mirror_x, line.mirror_y) for line in found]
    np.testing.assert_allclose(places, line_positions(FINE, CAMERA), atol=told["residual_px"] / 10_000 + 1e-7)
    expected = small_source().references(FINE)
    np.testing.assert_allclose(references.dark, expected.dark, atol=0.5)
    np.testing.assert_allclose(references.white, expected.white, atol=0.5)


@pytest.mark.usefixtures("module")
def test_a_camera_program_that_does_not_run_ends_in_one_message(tmp_path: Path) -> None:
    """The request is withdrawn, so that no late capture follows; fetching a missing capture names it."""
    _, camera, program = folder_rig(tmp_path / "incoming")
    program.busy = True
    camera.configure(100.0, 110.0)
    with pytest.raises(StateUnknown, match=r"lines-0.request was not taken in 10 s; does the camera's program run"):
        camera.capture(5, prefix="lines")
    with pytest.raises(RigError, match="cannot read capture lines-0"):
        camera.fetch("lines-0", KeptInMemory())
    assert list(program.folder.iterdir()) == []
    assert [row.came for row in check_camera(lambda: camera)] == ["no capture runs"]


WHOLE = np.zeros((FINE.lines, 48, 3), np.uint16)
KNOWN = LineTimes(np.arange(FINE.lines), np.arange(FINE.lines) * 100_000)
MEANS = {"dark": WHOLE[0].astype(np.float32)}


@pytest.mark.usefixtures("module")
def test_the_check_takes_lines_and_references(tmp_path: Path) -> None:
    """The scene's overexposed white is a warning; lines of another size than the settings' are an error."""
    _, camera, program = folder_rig(tmp_path / "incoming")
    wanted = Settings(source="rig", scene="field", size=(48, 40), camera=CAMERA, wavelengths=(460.0, 550.0, 640.0))
    row = try_capture(lambda: camera, wanted, program.seen.clock)
    assert (row.verdict, row.came) == ("warn", "20 of 20 lines, dark and white frames")
    assert row.mend.startswith("references-0: the white frame is at full scale")
    row = try_capture(lambda: camera, wanted.but(wavelengths=(460.0, 550.0)), program.seen.clock)
    assert "holds lines of (48, 3) (sample, band), the settings say (48, 2)" in row.came


FAULTS: dict[str, tuple[str, object, str]] = {
    "cable": ("fetch", OSError("cable pulled"), "OSError: cable pulled"),
    "key": ("references", KeyError("nope"), "KeyError: 'nope'"),
    "name": ("capture", "lines-0", "TypeError: expected Capture, got <class 'str'>"),
    "nothing": ("is_capturing", None, "TypeError: expected bool, got <class 'NoneType'>"),
    "array": ("fetch", WHOLE, "TypeError: expected CapturedLines, got <class 'numpy.ndarray'>"),
    "float": ("fetch", CapturedLines(WHOLE.astype(float), 0, KNOWN), r"TypeError: .* uint16, got \(17, 48, 3\) <f8"),  # type: ignore[arg-type]
    "short": ("fetch", CapturedLines(WHOLE[1:], 0, KNOWN), "TypeError: expected 16 int64 numbers and stamps, got .17,"),
    "means": ("references", MEANS, r"TypeError: expected a MeanFrame .* of dark, got <class 'numpy.ndarray"),
}


@pytest.mark.usefixtures("module")
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_a_driver_is_one_message(tmp_path: Path, name: str) -> None:
    """It names the driver, its method and the cause; a capture is not taken again for it."""
    method, does, words = FAULTS[name]
    source, camera, _ = folder_rig(tmp_path / "incoming")
    assert isinstance(camera, OtherMake)
    faulty = Mock(side_effect=does) if isinstance(does, Exception) else Mock(return_value=does)
    setattr(camera.device, method, faulty)
    with pytest.raises(DriverFailed, match=rf"^{MODULE}:open_camera: {method} failed \({words}.*; look at the device"):
        assert (list(source.lines(FINE)), source.references(FINE)) == ([], None)
    assert faulty.call_count == 1


def unplugged(rig: SurveyRig, clock: Clock) -> None:
    raise OSError("no route to the host")


def test_a_driver_that_cannot_be_opened_is_named() -> None:
    """Its function's own exception is the cause."""
    name = f"{__name__}:unplugged"
    with pytest.raises(DriverFailed, match=f"rig.camera_driver = '{name}' does not .*OSError: no route to the host"):
        open_camera_driver(SurveyRig(camera_driver=name))


BROKEN = {
    "no module": ("nowhere:open_it", r"cannot be imported \(ModuleNotFoundError: No module named 'nowhere'\)"),
    "no function": (f"{MODULE}:open_it", r"cannot be imported \(AttributeError: .*open_it"),
    "no function of rig and clock": (f"{MODULE}:POLL_S", r"does not open a driver .* the table \[rig\] and a clock"),
    "of other things": (f"{MODULE}:CapturedLines", r"does not open a driver \(.*missing 1 required"),
    "no driver": (f"{MODULE}:FolderCamera", r"gives a FolderCamera without goto, .*method of MirrorDriver in"),
}


@pytest.mark.usefixtures("module")
@pytest.mark.parametrize("name", BROKEN)
def test_an_invalid_driver_is_refused_in_one_message(name: str) -> None:
    """The message has the setting, its value, the reason and the expected value."""
    value, words = BROKEN[name]
    with pytest.raises(SettingsError, match=rf"rig.mirror_driver = '{value}' {words}"):
        open_mirror_driver(SurveyRig(mirror_driver=value), 1500)
