"""Between host and camera bytes are put in, doubled and cut out: no survey ends with others in silence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.rig.camera.camera_files import KeptInMemory, RemoteFile, fetch_files
from pipeline.rig.device_settings import FileServer
from pipeline.rig.emulator.camera_device import CameraUnit
from tests.pipeline.rig.camera.camera_line import LinesOf, control_of
from tests.pipeline.rig.camera_faults import CameraFault, FaultyCamera, FaultyServer
from tests.pipeline.rig.chaos_line import ChaosLine
from tests.pipeline.rig.chaotic_surveys import survey_in_chaos
from tests.pipeline.rig.in_process import ManualClock

DARK = "/captured/000000/darkReference"


@pytest.mark.parametrize("first", range(0, 10, 5))
def test_surveys_through_chaos(first: int) -> None:
    """Ten surveys: the undisturbed one's bytes or one message each, and the rerun gives all of them."""
    found = survey_in_chaos(range(first, first + 5))
    assert found.wrong == []
    assert found.surveys == 5
    assert found.strikes > 10


@contextmanager
def dark_frames() -> Iterator[tuple[bytes, FaultyServer]]:
    """A served dark reference of 32 frames, even but for some hot elements, as the camera writes it."""
    frames = np.full((32, 6, 4), 64, np.uint16)
    frames[:, 2, 1] = frames[:, 5, 3] = 3910
    clock = ManualClock()
    device = FaultyCamera(LinesOf(), clock, unit=CameraUnit(references={"darkReference": frames}))
    control_of(device, clock).capture(1)
    clock.advance(1.0)
    with FaultyServer(device) as served:
        yield device.files()[DARK], served


@pytest.mark.parametrize("held", ["half", "whole"])
def test_what_an_earlier_process_left_shifted_is_not_gone_on_with(held: str) -> None:
    """Bytes were put into a frame and the process died: its end looks like that of the file, and is not believed."""
    with dark_frames() as (whole, served):
        shifted = whole[:400] + whole[396:796] + whole[800:]  # some bytes twice, and as many lost further on
        kept = KeptInMemory({DARK: bytearray(shifted[: 760 if held == "half" else len(whole)])})
        server = FileServer(served.host, served.file_port, pause_s=0.0, overlap=16)
        with pytest.raises(RigError, match="it is another file; take what is held away"):
            fetch_files(server, [RemoteFile(DARK, len(whole), False)], kept)


def test_a_file_is_fetched_or_refused() -> None:
    """Transfers that are mangled, and broken off half way, bring the file's bytes or one message."""
    fetched, refused = 0, 0
    with dark_frames() as (whole, served), ChaosLine(0, served.file_port, 0) as line:
        server = FileServer(served.host, line.file_port, pause_s=0.0, stall_s=0.5)
        for seed in range(60):
            line.strike(seed, (1e9, float(np.random.default_rng(seed).choice([600, 1500, 4000]))))
            served.device.faults.left = {CameraFault.BREAKS_OFF: seed % 3}
            kept = KeptInMemory()
            try:
                fetch_files(server, [RemoteFile(DARK, len(whole), False)], kept)
            except RigError as error:
                assert DARK in str(error)  # noqa: PT017 - either end is well
                refused += 1
                line.calm, served.device.faults.left = True, {}
                if kept.size(DARK):  # broken off: what is held may be damaged, and then it is found now
                    assert "are kept" in str(error)  # noqa: PT017
                    continue
                fetch_files(server, [RemoteFile(DARK, len(whole), False)], kept)
            fetched += 1
            assert bytes(kept.files[DARK]) == whole
    assert fetched > 20
    assert refused > 0
