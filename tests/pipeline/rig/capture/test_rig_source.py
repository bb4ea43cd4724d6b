"""The rig as a source: lines from emulated devices equal those of the simulated source, bit for bit."""

from __future__ import annotations

from dataclasses import asdict, replace
from ftplib import FTP
from itertools import islice
from unittest.mock import create_autospec

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.geometry.mirror import Mounting, wire_positions
from pipeline.geometry.scan import Sweep, line_positions
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.capture_runner import CaptureJournal
from pipeline.rig.pro_mode import Command
from pipeline.source import Line
from tests.pipeline.rig.small_rig import (
    CAMERA,
    COARSE,
    FINE,
    assert_simulated,
    simulated_lines,
    small_rig,
    small_source,
)


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
    with small_rig() as rig:
        source = rig.source(kept)
        with source.session():  # one visit: the camera is configured anew between sweeps
            given = {sweep: list(source.lines(sweep)) for sweep in (own, FINE)}
        for sweep, found in given.items():
            expected = list(small_source().lines(sweep))
            np.testing.assert_array_equal([line.data for line in found], [line.data for line in expected])
            np.testing.assert_allclose([line.time_s for line in found], [line.time_s for line in expected], atol=1e-6)
            assert {line.exposure_ms for line in found} == {sweep.exposure_ms or CAMERA.exposure_ms}
            dark, white = source.references(sweep).dark, source.references(sweep).white
            wanted = small_source().references(sweep)
            np.testing.assert_allclose(dark, wanted.dark, atol=0.6)
            np.testing.assert_allclose(white, wanted.white, atol=0.6)
        assert len(rig.captures) == 2
        again = rig.source(kept)  # another process
        np.testing.assert_array_equal(again.references(own).white, source.references(own).white)
        assert len(rig.captures) == 2


@pytest.mark.parametrize("sweep", [COARSE, FINE], ids=lambda sweep: sweep.kind)
@pytest.mark.parametrize("first", [0, 9])
def test_rig_lines_equal_those_of_the_simulated_source(sweep: Sweep, first: int):
    """Coarse lines, with four held positions and binned by four, and lines from number 9 on are equal as well."""
    with small_rig() as rig:
        source = rig.source()
        assert_same(list(source.lines(sweep, first)), sweep, first)
        assert list(source.lines(sweep, sweep.lines)) == []
        assert len(rig.captures) == 1


MOUNTED = {
    "upside down": Mounting("-x,-y"),
    "turned": Mounting("y,-x"),
    "turned, mirrored, clocked and beside its middle": Mounting("-y,-x", 7.3, 0.05, -0.02),
}


@pytest.mark.parametrize("mounting", MOUNTED.values(), ids=MOUNTED)
def test_a_configured_mounting_gives_the_same_lines(mounting: Mounting):
    """Lines by pulses are equal bit for bit, those by the mirror's log to 3 px. Without the setting they differ."""
    told = {f"mirror_{name}": value for name, value in asdict(mounting).items()}
    with small_rig(mounting=mounting, **told) as rig:
        source = rig.source()
        assert_same(list(source.lines(COARSE)), COARSE)
        assert_same(list(source.lines(FINE)), FINE)
        assert source.record["rig"]["mounting"] == asdict(mounting)
    with small_rig(mounting=mounting, pulses="none", log_samples=16000, **told) as rig:
        found = list(rig.source().lines(FINE))
    assert_simulated(found, FINE)
    off = np.array([(line.mirror_x, line.mirror_y) for line in found]) - line_positions(FINE, CAMERA)
    assert np.hypot(*off.T).max() * 11275 < 3  # px
    with small_rig(mounting=mounting) as rig:
        source = rig.source()
        untold = list(source.lines(FINE))
        assert "mounting" not in source.record["rig"]
    assert not np.array_equal([line.data for line in untold], [line.data for line in found])


@pytest.mark.parametrize(("sweep", "captures"), [(COARSE, 3), (FINE, 2)], ids=lambda value: getattr(value, "kind", ""))
def test_several_loads_of_the_vector_memory_change_no_line(sweep: Sweep, captures: int):
    """A sweep in several loads has the same numbers, because noise depends on sweep name and line number.

    Times are the camera's own, so each load within a sweep delays the lines after it.
    """
    with small_rig(vector_pairs=17) as rig:
        found = list(rig.source().lines(sweep))
        assert len(rig.captures) == captures
    assert_simulated(found, sweep)
    late = np.array([line.time_s for line in found]) - [line.time_s for line in simulated_lines(sweep)]
    assert abs(late[0]) < 1e-6
    assert (np.diff(late) > -2e-6).all()
    assert np.count_nonzero(np.diff(late) > 0.01) == captures - 1


@pytest.mark.parametrize("white_at_rest", [True, False])
def test_references_are_the_mean_of_the_cameras_frames(white_at_rest: bool):
    """References equal the simulated source's to the rounding of frames. The mirror moves only for a white at rest."""
    with small_rig(white_reference=2.0, white_at_rest=white_at_rest) as rig:
        source = rig.source()
        for sweep in (COARSE, FINE):
            found, expected = source.references(sweep), small_source().references(sweep)
            np.testing.assert_allclose(found.dark, expected.dark, atol=sweep.binning / 64)
            np.testing.assert_allclose(found.white, expected.white, atol=sweep.binning / 64)
            assert found.white_reference.tolist() == [2.0] * 3
            assert found.by_mirror == white_at_rest
            assert found.bad is None
        assert sum("references" in said for said in rig.emulated.camera.commands if "capture(" in said) == 1
        assert any(request.command == Command.SET_VALUES for request in rig.emulated.mirror.requests) == white_at_rest


def test_references_are_fetched_once(monkeypatch: pytest.MonkeyPatch):
    """All sweeps, and sources that share the files, use one fetch. A source with other files fetches its own."""
    log_in = create_autospec(FTP.login, side_effect=FTP.login)
    monkeypatch.setattr(FTP, "login", log_in)
    with small_rig() as rig:
        kept = KeptInMemory()
        source = rig.source(kept)
        source.references(FINE)
        once = log_in.call_count
        opened = rig.opened
        assert once > 0
        dark = small_source().references(COARSE).dark
        for sharing in (source, source.saying(lambda words: None)):
            np.testing.assert_allclose(sharing.references(COARSE).dark, dark, atol=0.1)
        assert (log_in.call_count, rig.opened) == (once, opened)
        elsewhere = KeptInMemory()
        CaptureJournal(elsewhere).record_references(CaptureJournal(kept).references[None])
        source.keeping(elsewhere).references(FINE)
        assert (log_in.call_count, rig.opened) == (2 * once, opened + 1)
        assert elsewhere.files.keys() == kept.files.keys()


@pytest.mark.parametrize("pulses", ["none", "frame"])
def test_lines_without_pulses_lie_at_the_logged_positions(pulses: str):
    """The log locates lines of a path on its own clock. One pulse per frame steps fine sweeps only."""
    with small_rig(pulses=pulses, log_samples=16000) as rig:
        source = rig.source()
        found = list(source.lines(COARSE))
        (told,) = source.record["captures"]
        if pulses == "frame":
            assert_same(list(source.lines(FINE)), FINE)
            assert source.record["captures"][1]["method"] == "trigger"
    assert [line.number for line in found] == list(range(COARSE.lines))
    assert all(line.valid for line in found)
    off = np.array([(line.mirror_x, line.mirror_y) for line in found]) - line_positions(COARSE, CAMERA)
    assert np.hypot(*off.T).max() * 11275 < 3  # a unit of the disk is about 11275 px
    assert (told["method"], told["sweep"], told["first"], told["stop"]) == ("log", "coarse-0", 0, 10)
    assert 0 <= told["residual_px"] < 3
    assert any("software timing" in note for note in told["notes"])


def test_devices_are_released_after_every_call():
    """A consumer that stops early, or an error, leaves no device open. A session keeps them over several calls."""
    with small_rig() as rig:
        source = rig.source()
        lines = source.lines(FINE)
        assert len(list(islice(lines, 3))) == 3
        lines.close()  # type: ignore[attr-defined]
        with pytest.raises(RigError, match="closed"):
            rig.line.transport.drain()
        assert_same(list(source.lines(FINE)), FINE)
        assert rig.opened == 2
        with source.session():
            source.references(FINE)
            list(source.lines(COARSE))
        assert rig.opened == 3


def test_lines_of_another_size_are_refused():
    """If the camera's lines differ from the settings, the sweep ends with both sizes in the message."""
    with small_rig() as rig:
        rig.wavelength_nm = np.array([500.0, 600.0])
        with pytest.raises(RigError, match=r"holds lines of \(48, 3\) \(sample, band\), the settings say \(48, 2\)"):
            list(rig.source().lines(FINE))
