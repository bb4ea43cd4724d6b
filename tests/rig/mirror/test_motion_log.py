"""The controller's logger, byte by byte."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.rig.device_errors import DeviceRefused
from tests.rig.mirror.mirror_bytes import CONNECT, DONE, SET_LOG, START_LOG, STOP_LOG, connected, pair
from tests.rig.scripted import Late, Pair, scripted

START: list[Pair] = [STOP_LOG, SET_LOG, START_LOG]
X3 = pair("7E 00 15 05 24 00 00 00 0C 34 96 7E", "7E 00 15 0C 3F 00 00 00 3F 80 00 00 00 00 00 00 93 D1 7E")
Y3 = pair("7E 00 15 05 24 01 00 00 0C 35 6A 7E", "7E 00 15 0C BE 80 00 00 00 00 00 00 BE 80 00 00 22 F2 7E")
OUT_OF_RANGE = "7E 00 95 04 00 00 01 07 AC 97 7E"


def test_a_log_is_started_stopped_and_fetched():
    """Both feedbacks, the rate, the run bit, and as many samples as the time since the start has."""
    start = [STOP_LOG, SET_LOG, (START_LOG[0], [Late(0.002, bytes(START_LOG[1]))])]
    with scripted([*CONNECT, *start, STOP_LOG, X3, Y3]) as transport:
        mirror = connected(transport, log_rate_hz=1000.0)
        mirror.start_log()
        transport.clock.sleep(0.0035)
        log = mirror.read_log()
    np.testing.assert_array_equal(log.position, np.array([[0.5, -0.25], [1, 0], [0, -0.25]], np.float32))
    np.testing.assert_allclose(log.time_s, [0, 0.001, 0.002])
    assert (log.started_s, log.start_error_s) == (pytest.approx(0.002), pytest.approx(0.002))


def test_cells_that_are_played_are_logged_beside_positions():
    """The index of X's vector unit in slot 2, read as whole numbers."""
    slots = "24 00 24 01 24 02 24 11 00 00 23 02 00 00 23 03 00 00 68 0A 44 7A 00 00"
    set_three = pair(f"7E 00 12 1A 00 04 {slots} 60 DF 7E", DONE)
    index = pair("7E 00 15 05 24 02 00 00 0C 35 2E 7E", "7E 00 15 0C 00 00 00 00 00 00 00 01 00 00 00 07 79 1B 7E")
    with scripted([*CONNECT, STOP_LOG, set_three, START_LOG, STOP_LOG, X3, Y3, index]) as transport:
        mirror = connected(transport)
        mirror.start_log(1000.0, with_index=True)
        log = mirror.read_log(3)
    assert log.index is not None
    assert log.index.tolist() == [0, 1, 7]
    assert log.position.tolist() == [[0.5, -0.25], [1, 0], [0, -0.25]]


@pytest.mark.parametrize("samples", [3, 5000])
def test_never_more_than_the_logger_holds(samples: int):
    """A number may be asked for; the setting bounds it."""
    with scripted([*CONNECT, *START, STOP_LOG, X3, Y3]) as transport:
        mirror = connected(transport, log_samples=3)
        mirror.start_log(1000.0)
        assert len(mirror.read_log(samples).position) == 3


def test_a_log_ends_where_the_device_says(caplog: pytest.LogCaptureFixture):
    """An index outside the log ends it; both channels are as long as the shorter."""
    zeros = "7E 00 15 28" + " 00" * 40 + " 39 6E 7E"
    script = [
        pair("7E 00 15 05 24 00 00 00 28 34 8D 7E", zeros),
        pair("7E 00 15 05 24 00 00 28 08 2B 55 7E", OUT_OF_RANGE),
        pair("7E 00 15 05 24 01 00 00 28 35 71 7E", zeros),
        pair("7E 00 15 05 24 01 00 28 08 2A A9 7E", OUT_OF_RANGE),
    ]
    with scripted([*CONNECT, *START, STOP_LOG, *script]) as transport:
        mirror = connected(transport)
        mirror.start_log(1000.0)
        assert mirror.read_log(12).position.shape == (10, 2)
    assert "ends at 10 of 12 samples" in caplog.text


def test_other_refusals_are_errors():
    """Only an index outside the log is its end."""
    refused = pair("7E 00 15 05 24 00 00 00 0C 34 96 7E", "7E 00 95 04 00 00 01 01 2C 95 7E")
    with scripted([*CONNECT, *START, STOP_LOG, refused]) as transport:
        mirror = connected(transport)
        mirror.start_log(1000.0)
        with pytest.raises(DeviceRefused, match="no such register"):
            mirror.read_log(3)


def test_no_log_is_read_that_was_not_started():
    """A log is read once."""
    with scripted([*CONNECT, *START, STOP_LOG]) as transport:
        mirror = connected(transport)
        with pytest.raises(RigError, match="no log was started on scripted; start one"):
            mirror.read_log()
        mirror.start_log(1000.0)
        assert mirror.read_log().position.shape == (0, 2)
        with pytest.raises(RigError, match="no log was started"):
            mirror.read_log()
