"""The rig as a source: lines from fake devices equal those of the simulated source, bit for bit."""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import islice

import numpy as np
import pytest

from spectralzoom.pipeline.errors import RigError, SettingsError
from spectralzoom.pipeline.geometry.mirror import Mounting, wire_positions
from spectralzoom.pipeline.geometry.scan import Sweep, line_positions, sweep_positions
from spectralzoom.pipeline.rig.camera.camera_files import KeptInMemory
from spectralzoom.pipeline.rig.capture_runner import CaptureJournal
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.fakes import FakeCamera, FakeClock, FakeMirror
from spectralzoom.pipeline.rig.transports import DeviceRefused
from spectralzoom.pipeline.source import Line
from tests.pipeline.rig.small_rig import CAMERA, COARSE, FINE, SmallRig, assert_simulated, simulated_lines, small_source


def assert_same(found: list[Line], sweep: Sweep, first: int = 0) -> None:
    """Assert lines of the simulated source: equal bits, positions in the wire's precision, times to a microsecond."""
    assert_simulated(found, sweep, first)
    wired = wire_positions(line_positions(sweep, CAMERA)[first:])
    np.testing.assert_array_equal([(line.mirror_x, line.mirror_y) for line in found], wired.astype(np.float64))
    times = [line.time_s for line in simulated_lines(sweep)[first:]]
    np.testing.assert_allclose([line.time_s for line in found], times, atol=1e-6)
    assert all(line.valid and line.exposure_ms == CAMERA.exposure_ms for line in found)


def test_each_sweep_is_captured_with_its_own_exposure():
    """Lines and references have the sweep's exposure, and another process finds the references in the journal."""
    own = replace(COARSE, exposure_ms=25.0)
    kept = KeptInMemory()
    rig = SmallRig()
    source = rig.source(kept)
    with source.session():  # one visit: the camera is configured anew between sweeps
        given = {sweep: list(source.lines(sweep)) for sweep in (own, FINE)}
    for sweep, found in given.items():
        expected = list(small_source().lines(sweep))
        np.testing.assert_array_equal([line.data for line in found], [line.data for line in expected])
        np.testing.assert_allclose([line.time_s for line in found], [line.time_s for line in expected], atol=1e-6)
        assert {line.exposure_ms for line in found} == {sweep.exposure_ms or CAMERA.exposure_ms}
        wanted = small_source().references(sweep)
        np.testing.assert_array_equal(source.references(sweep).dark, wanted.dark)
        np.testing.assert_array_equal(source.references(sweep).white, wanted.white)
    assert len(rig.captures) == 2
    again = rig.source(kept)  # another process
    np.testing.assert_array_equal(again.references(own).white, source.references(own).white)
    assert len(rig.captures) == 2


@pytest.mark.parametrize("sweep", [COARSE, FINE], ids=lambda sweep: sweep.kind)
@pytest.mark.parametrize("first", [0, 9])
def test_rig_lines_equal_those_of_the_simulated_source(sweep: Sweep, first: int):
    """Coarse lines, with four held positions and binned by four, and lines from number 9 on are equal as well."""
    rig = SmallRig()
    source = rig.source()
    assert_same(list(source.lines(sweep, first)), sweep, first)
    assert list(source.lines(sweep, sweep.lines)) == []
    assert len(rig.captures) == 1
    held = sweep_positions(sweep, CAMERA)[first:].reshape(-1, 2)
    np.testing.assert_array_equal(rig.mirror.path, wire_positions(held))
    assert [rate_hz for _, rate_hz in rig.mirror.runs] == [sweep.positions * 1000 / CAMERA.frame_ms]


def test_the_record_has_the_mounting():
    """A mounting is in the record of the captures, where it is not straight."""
    mounting = Mounting("y,-x", 7.3, 0.05, -0.02)
    told = {f"mirror_{name}": value for name, value in asdict(mounting).items()}
    assert SmallRig(settings=SurveyRig(**told)).source().record["rig"]["mounting"] == asdict(mounting)
    assert "mounting" not in SmallRig().source().record["rig"]


@pytest.mark.parametrize(("sweep", "captures"), [(COARSE, 3), (FINE, 2)], ids=lambda value: getattr(value, "kind", ""))
def test_several_loads_of_the_vector_memory_change_no_line(sweep: Sweep, captures: int):
    """A sweep in several loads has the same numbers, because noise depends on sweep name and line number."""
    rig = SmallRig(vector_pairs=16)
    found = list(rig.source().lines(sweep))
    assert len(rig.captures) == captures
    assert_simulated(found, sweep)
    with pytest.raises(SettingsError, match=r"memory 3 pairs; give cost\.vector_pairs of at least 4"):
        list(SmallRig(vector_pairs=3).source().lines(COARSE))


@pytest.mark.parametrize("white_at_rest", [True, False])
def test_references_are_those_of_the_camera(white_at_rest: bool):
    """References equal the simulated source's. The mirror moves only for a white at rest."""
    rig = SmallRig(settings=SurveyRig(white_reference=2.0, white_at_rest=white_at_rest))
    rig.mirror.position = (0.5, 0.5)
    source = rig.source()
    for sweep in (COARSE, FINE):
        found, expected = source.references(sweep), small_source().references(sweep)
        np.testing.assert_array_equal(found.dark, expected.dark)
        np.testing.assert_array_equal(found.white, expected.white)
        assert found.white_reference.tolist() == [2.0] * 3
        assert found.by_mirror == white_at_rest
        assert found.bad is None
    assert sum("references" in folder for folder in rig.camera.captures) == 1
    assert rig.mirror.position == ((0.0, 0.0) if white_at_rest else (0.5, 0.5))


def test_an_overexposed_white_frame_is_named():
    """The note begins with the folder on the camera. The small scene's white is at full scale at 100 ms."""
    rig, notes = SmallRig(), list[str]()
    source = rig.source(note=notes.append)
    source.references(replace(FINE, exposure_ms=1.0))
    assert notes == []
    source.references(FINE)
    assert [note.partition(" in ")[0] for note in notes] == [
        f"{rig.camera.captures[1]}: the white frame is at full scale (4095 DN)"
    ]


def test_references_are_fetched_once():
    """All sweeps use one fetch. A source with other files fetches its own."""
    rig = SmallRig()
    kept = KeptInMemory()
    source = rig.source(kept)
    source.references(FINE)
    np.testing.assert_array_equal(source.references(COARSE).dark, small_source().references(COARSE).dark)
    assert rig.opened == 1
    elsewhere = KeptInMemory()
    CaptureJournal(elsewhere).record_references(CaptureJournal(kept).references[None])
    source.keeping(elsewhere).references(FINE)
    assert rig.opened == 2


def test_devices_are_released_after_every_call():
    """A consumer that stops early, or an error, leaves no device open. A session keeps them over several calls."""
    rig = SmallRig()
    source = rig.source()
    lines = source.lines(FINE)
    assert len(list(islice(lines, 3))) == 3
    lines.close()  # type: ignore[attr-defined]
    assert (rig.opened, rig.closed) == (1, 1)
    assert_same(list(source.lines(FINE)), FINE)
    assert rig.opened == 2
    with source.session():
        source.references(FINE)
        list(source.lines(COARSE))
    assert (rig.opened, rig.closed) == (3, 3)


def test_lines_of_another_size_are_refused():
    """If the camera's lines differ from the settings, the sweep ends with both sizes in the message."""
    rig = SmallRig()
    rig.wavelength_nm = np.array([500.0, 600.0])
    with pytest.raises(RigError, match=r"holds lines of \(48, 3\) \(sample, band\), the settings say \(48, 2\)"):
        list(rig.source().lines(FINE))


def test_a_fake_camera_without_a_scene_has_no_lines():
    """It refuses folders of other cameras, and captures that no survey named."""
    camera = FakeCamera(FakeClock())
    folder = camera.capture(3, prefix="field").folder
    with pytest.raises(RigError, match="has no scene here"):
        camera.fetch(folder, KeptInMemory())
    with pytest.raises(DeviceRefused, match="still captures"):
        camera.capture(3)
    seeing = FakeCamera(FakeClock(), small_source())
    with pytest.raises(DeviceRefused, match="has no capture /captured/a"):
        seeing.fetch("/captured/a", KeptInMemory())
    with pytest.raises(RigError, match="announces no lines"):
        seeing.fetch(folder, KeptInMemory())
    mirror = FakeMirror(FakeClock(), vector_pairs=1)
    for call in (lambda: mirror.run(1.0), lambda: mirror.load_path([(0, 0), (0, 0.1)])):
        with pytest.raises(SettingsError):
            call()
