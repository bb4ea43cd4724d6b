"""The mirror controller, byte by byte: connecting, moving, loading, playing, logging, closing and blocking."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pipeline.errors import PoseError, RigError, SettingsError, ShapeError
from pipeline.rig import mirror_controller
from pipeline.rig.device_settings import SurveyRig
from pipeline.rig.mirror_controller import Identity, MirrorController, open_mirror
from pipeline.rig.pro_mode import Status, Trigger
from pipeline.rig.transports import DeadlinePassed, DeviceGone, DeviceRefused, StateUnknown
from tests.pipeline.rig.mirror import mirror_bytes as w
from tests.pipeline.rig.mirror.mirror_bytes import connected, pair
from tests.pipeline.rig.scripted import Late, Pair, ScriptedTransport, scripted

WRONG = pair(
    "7E 00 15 05 26 00 00 00 18 4D 59 7E",
    "7E 00 15 18 3F 00 00 00 00 00 00 00 3F 80 00 00 BE 80 00 00 3E 80 00 00 00 00 00 00 82 25 7E",
)
INDEX = pair("7E 00 11 02 68 0A 0B 3B 7E", "7E 00 11 04 00 00 00 02 73 40 7E")
THERE, LOST = pair(w.GOTO, w.DONE), (bytes.fromhex(w.GOTO), b"")
Call = Callable[[MirrorController], object]


def play(mirror: MirrorController) -> None:
    """Load the path, and play it by pulses."""
    mirror.load_path(w.PATH)
    mirror.run(10.0, Trigger.RISING_EDGE)


# exchanges after connecting, the call, settings, and the call's result
DONE_AS_ASKED: dict[str, tuple[list[Pair], Call, dict[str, Any], object]] = {
    "who is there": ([], lambda mirror: mirror.identity, {}, Identity("MR-E-2", "1.2.4065", "ABCD0123")),
    "going, in one frame": ([w.WELL, THERE], lambda mirror: mirror.goto(0.5, -0.25), {}, None),
    "a path, X before Y, half open, begun in one frame": (
        [w.HALT, w.LOAD, w.READ_BACK, w.HALT, w.SET_X, w.SET_Y, w.WELL, pair(w.RUN, w.DONE)],
        play,
        {"read_back": "all"},
        None,
    ),
    "a path of a device with inclusive ends": (
        [w.HALT, w.LOAD, w.HALT, w.SET_X_INCLUSIVE, w.SET_Y_INCLUSIVE, w.WELL, pair(w.RUN, w.DONE)],
        play,
        {"ends": "inclusive", "read_back": "none"},
        None,
    ),
    "waiting for rest": ([w.UNREST, w.UNREST, w.WELL], lambda mirror: mirror.settle(1.0), {}, None),
    "the cell of X": ([INDEX], lambda mirror: mirror.index(), {}, 2),
    "letting go": ([], lambda mirror: mirror.close(), {}, None),
}


@pytest.mark.parametrize("name", DONE_AS_ASKED)
def test_each_call_sends_exactly_these_bytes(name: str):
    """Every frame is acknowledged, and only closing releases the port."""
    script, call, settings, given = DONE_AS_ASKED[name]
    with scripted([*w.CONNECT, *script]) as transport:
        assert call(connected(transport, **settings)) == given
        assert transport.closed == name.startswith("letting go")


OUTSIDE = "keep the field within the mirror's range"
REFUSED: dict[str, tuple[list[Pair], Call, dict[str, Any], type[Exception], str]] = {
    "beyond the rim": ([], lambda mirror: mirror.goto(1.01, 0.0), {}, PoseError, OUTSIDE),
    "path beyond": ([], lambda mirror: mirror.load_path([(0, 0), (0.8, 0.8)]), {}, PoseError, r"\(index 1\)"),
    "long": ([], lambda mirror: mirror.load_path(w.PATH), {"vector_pairs": 2}, SettingsError, "holds 2 .* in parts"),
    "empty path": ([], lambda mirror: mirror.load_path([]), {}, ShapeError, "at least one"),
    "warm": ([w.WARM], lambda mirror: mirror.goto(0.5, 0), {}, RigError, "mirror warm; mend that"),
    "a path that is not loaded": ([], lambda mirror: mirror.run(10.0), {}, SettingsError, "no path is loaded"),
    "never at rest": ([w.UNREST] * 6, lambda mirror: mirror.settle(0.05), {}, RigError, "not at rest after 0.05 s"),
    "trimmed": ([w.TRIMMED], lambda mirror: mirror.settle(1.0), {}, RigError, "not where it was sent; .*trimmed"),
    "pulled cable": (
        [w.WELL, (bytes.fromhex(w.GOTO), [DeviceGone("scripted went away")])],
        lambda mirror: mirror.goto(0.5, -0.25),
        {},
        StateUnknown,
        "went away",
    ),
    "a run that is not acknowledged": (
        [w.HALT, w.LOAD, w.HALT, w.SET_X, w.SET_Y, w.WELL, (bytes.fromhex(w.RUN), b"")],
        play,
        {"read_back": "none"},
        StateUnknown,
        "running the path was sent",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_calls_and_device_errors_are_refused(name: str):
    """Invalid calls send no byte. A status that forbids motion prevents it. Device errors are reported in words."""
    script, call, settings, error, words = REFUSED[name]
    with scripted([*w.CONNECT, *script]) as transport, pytest.raises(error, match=words):
        call(connected(transport, **settings))


def test_a_path_that_was_not_stored_is_not_played():
    """Cells that differ after reading back are named. After a failed upload no path counts as loaded."""
    with scripted([*w.CONNECT, w.HALT, w.LOAD, WRONG]) as transport:
        mirror = connected(transport)
        with pytest.raises(RigError, match=r"cells 0 to 6 of the vector memory on scripted hold other values"):
            mirror.load_path(w.PATH)
        with pytest.raises(SettingsError, match="no path is loaded"):
            mirror.run(10.0)
    with scripted([*w.CONNECT, w.HALT, w.LOAD, w.HALT, (w.LOAD[0], b"")]) as transport:
        mirror = connected(transport, read_back="none")
        mirror.load_path(w.PATH)
        with pytest.raises(DeadlinePassed, match="writing cells 0 to 6"):
            mirror.load_path(w.PATH)
        with pytest.raises(SettingsError, match="no path is loaded"):
            mirror.run(10.0)


def test_an_unacknowledged_motion_blocks_further_motions():
    """The motion is sent once and later ones send no byte. Status, halting and closing still work."""
    late = Late(1.02, bytes.fromhex(w.DONE))
    script = [*w.CONNECT, w.HALT, w.LOAD, w.WELL, (bytes.fromhex(w.GOTO), [late]), w.WELL, w.HALT]
    with scripted(script) as transport:
        mirror = connected(transport, read_back="none")
        mirror.load_path(w.PATH)
        with pytest.raises(StateUnknown, match=r"going to 0.5; -0.25 was sent to scripted and may have happened"):
            mirror.goto(0.5, -0.25)
        with pytest.raises(StateUnknown, match="going to 0; 0 is refused"):
            mirror.goto(0, 0)
        with pytest.raises(StateUnknown, match="running a path is refused"):
            mirror.run(10.0)
        assert mirror.status() == Status(0)
        mirror.halt()
        mirror.close()
        assert transport.closed


def give(monkeypatch: pytest.MonkeyPatch, transport: ScriptedTransport) -> None:
    """Replace the port of the settings by the transport."""

    def opened(port: str, baud: int, clock: object) -> ScriptedTransport:
        assert (port, baud, clock) == ("/dev/mirror", 256000, transport.clock)
        return transport

    monkeypatch.setattr(mirror_controller, "SerialTransport", opened)


SETTINGS = SurveyRig(port="/dev/mirror", baud=256000, with_crc=True, strict_crc=True)


def test_opening_connects_or_releases_the_port(monkeypatch: pytest.MonkeyPatch):
    """Port and baud rate are those of the settings. Without a controller the port is closed."""
    silent = (b"START\r\n", b"")
    with scripted(w.CONNECT) as transport:
        give(monkeypatch, transport)
        with open_mirror(SETTINGS, 1500, transport.clock) as mirror:
            assert mirror.identity.device == "MR-E-2"
        assert transport.closed
    with scripted([*[silent] * 3, (w.LEAVE[0], b""), *[silent] * 3]) as transport:
        give(monkeypatch, transport)
        with pytest.raises(DeadlinePassed):
            open_mirror(SETTINGS, 1500, transport.clock)
        assert transport.closed


START: list[Pair] = [w.STOP_LOG, w.SET_LOG, w.START_LOG]
X3 = pair("7E 00 15 05 24 00 00 00 0C 34 96 7E", "7E 00 15 0C 3F 00 00 00 3F 80 00 00 00 00 00 00 93 D1 7E")
Y3 = pair("7E 00 15 05 24 01 00 00 0C 35 6A 7E", "7E 00 15 0C BE 80 00 00 00 00 00 00 BE 80 00 00 22 F2 7E")
OUT_OF_RANGE = "7E 00 95 04 00 00 01 07 AC 97 7E"


def test_a_log_is_started_stopped_and_read():
    """The log has both feedbacks and as many samples as fit into the time since its start."""
    start = [w.STOP_LOG, w.SET_LOG, (w.START_LOG[0], [Late(0.002, bytes(w.START_LOG[1]))])]
    with scripted([*w.CONNECT, *start, w.STOP_LOG, X3, Y3]) as transport:
        mirror = connected(transport, log_rate_hz=1000.0)
        mirror.start_log(1000.0)
        transport.clock.sleep(0.0035)
        log = mirror.read_log()
    np.testing.assert_array_equal(log.position, np.array([[0.5, -0.25], [1, 0], [0, -0.25]], np.float32))
    assert log.rate_hz == 1000.0
    assert (log.started_s, log.start_error_s) == (pytest.approx(0.002), pytest.approx(0.002))


def test_a_log_ends_at_the_index_that_the_device_refuses(caplog: pytest.LogCaptureFixture):
    """An index outside of the log ends it, and both channels get the shorter length."""
    zeros = "7E 00 15 28" + " 00" * 40 + " 39 6E 7E"
    script = [
        pair("7E 00 15 05 24 00 00 00 28 34 8D 7E", zeros),
        pair("7E 00 15 05 24 00 00 28 08 2B 55 7E", OUT_OF_RANGE),
        pair("7E 00 15 05 24 01 00 00 28 35 71 7E", zeros),
        pair("7E 00 15 05 24 01 00 28 08 2A A9 7E", OUT_OF_RANGE),
    ]
    with scripted([*w.CONNECT, *START, w.STOP_LOG, *script]) as transport:
        mirror = connected(transport)
        mirror.start_log(1000.0)
        transport.clock.sleep(0.0121)
        assert mirror.read_log().position.shape == (10, 2)
    assert "ends at 10 of 12 samples" in caplog.text


def test_a_log_that_was_not_started_is_not_read():
    """A log is read once and up to the configured samples. Only an index outside of it ends it, not other refusals."""
    refused = pair("7E 00 15 05 24 00 00 00 0C 34 96 7E", "7E 00 95 04 00 00 01 01 2C 95 7E")
    logs = [*START, w.STOP_LOG, X3, Y3, *START, w.STOP_LOG, refused]
    with scripted([*w.CONNECT, *logs]) as transport:
        mirror = connected(transport, log_samples=3)
        with pytest.raises(RigError, match="no log was started on scripted; start one"):
            mirror.read_log()
        mirror.start_log(1000.0)
        transport.clock.sleep(5.0)
        assert len(mirror.read_log().position) == 3
        with pytest.raises(RigError, match="no log was started"):
            mirror.read_log()
        mirror.start_log(1000.0)
        transport.clock.sleep(5.0)
        with pytest.raises(DeviceRefused, match="no register"):
            mirror.read_log()
