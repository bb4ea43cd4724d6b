"""The mirror controller, byte by byte: connecting, moving, loading, playing, closing and blocking."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from typing import Any

import pytest

from spectralzoom.pipeline.errors import PoseError, RigError, SettingsError, ShapeError
from spectralzoom.pipeline.rig import drivers
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.mirror_controller import MirrorController
from spectralzoom.pipeline.rig.transports import DeadlinePassed, DeviceGone, StateUnknown
from tests.pipeline.rig.mirror import mirror_bytes as w
from tests.pipeline.rig.mirror.mirror_bytes import connected, pair
from tests.pipeline.rig.scripted import Pair, ScriptedTransport, scripted

WRONG = pair(
    "7E 00 15 05 26 00 00 00 18 4D 59 7E",
    "7E 00 15 18 3F 00 00 00 00 00 00 00 3F 80 00 00 BE 80 00 00 3E 80 00 00 00 00 00 00 82 25 7E",
)
BOOT = b"\x00\xffMR-E-2 boot 1.2\r\nready\r\n"
THERE, LOST = pair(w.GOTO, w.DONE), (bytes.fromhex(w.GOTO), b"")
Call = Callable[[MirrorController], object]


def play(mirror: MirrorController) -> None:
    """Load the path, and play it."""
    mirror.load_path(w.PATH)
    mirror.run(10.0)


# exchanges after connecting, the call, settings, and the call's result
DONE_AS_ASKED: dict[str, tuple[list[Pair], Call, dict[str, Any], object]] = {
    "who is there": ([], lambda mirror: mirror.identity, {}, "MR-E-2, version 1.2.4065, serial ABCD0123"),
    "going, in one frame": ([w.WELL, THERE], lambda mirror: mirror.goto(0.5, -0.25), {}, None),
    "a path, X before Y, half open, begun in one frame": (
        [w.HALT, w.LOAD, w.READ_BACK, w.HALT, w.SET_X, w.SET_Y, w.WELL, pair(w.RUN, w.DONE)],
        play,
        {},
        None,
    ),
    "a path of a device with inclusive ends": (
        [w.HALT, w.LOAD, w.READ_BACK, w.HALT, w.SET_X_INCLUSIVE, w.SET_Y_INCLUSIVE, w.WELL, pair(w.RUN, w.DONE)],
        play,
        {"ends": "inclusive"},
        None,
    ),
    "waiting for rest": ([w.UNREST, w.UNREST, w.WELL], lambda mirror: mirror.settle(1.0), {}, None),
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
    "an acknowledgement of which a second reader took the rest": (
        [w.WELL, (bytes.fromhex(w.GOTO), bytes.fromhex(w.DONE)[:4])],
        lambda mirror: mirror.goto(0.5, -0.25),
        {},
        StateUnknown,
        "4 other bytes came",
    ),
    "an acknowledgement with a wrong CRC": (
        [w.WELL, pair(w.GOTO, w.DONE.replace("0C A0", "0C A1"))],
        lambda mirror: mirror.goto(0.5, -0.25),
        {},
        StateUnknown,
        "may have happened or not: no answer to going to 0.5; -0.25",
    ),
    "a controller that restarts while it plays": (
        [w.HALT, w.LOAD, w.READ_BACK, w.HALT, w.SET_X, w.SET_Y, w.WELL, pair(w.RUN, w.DONE), (w.HALT[0], BOOT)],
        lambda mirror: [play(mirror), mirror.halt()],
        {},
        DeadlinePassed,
        "no answer to halting the path .* other bytes came: .*MR-E-2 boot",
    ),
    "a run that is not acknowledged": (
        [w.HALT, w.LOAD, w.READ_BACK, w.HALT, w.SET_X, w.SET_Y, w.WELL, (bytes.fromhex(w.RUN), b"")],
        play,
        {},
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
    with scripted([*w.CONNECT, w.HALT, w.LOAD, w.READ_BACK, w.HALT, (w.LOAD[0], b"")]) as transport:
        mirror = connected(transport)
        mirror.load_path(w.PATH)
        with pytest.raises(DeadlinePassed, match="writing cells 0 to 6"):
            mirror.load_path(w.PATH)
        with pytest.raises(SettingsError, match="no path is loaded"):
            mirror.run(10.0)


def give(monkeypatch: pytest.MonkeyPatch, transport: ScriptedTransport) -> None:
    """Replace the port of the settings by the transport."""

    def opened(port: str, clock: object) -> ScriptedTransport:
        assert (port, clock) == ("/dev/mirror", transport.clock)
        return transport

    monkeypatch.setattr(drivers, "SerialTransport", opened)


SETTINGS = SurveyRig(port="/dev/mirror", with_crc=True)


def test_opening_connects_or_releases_the_port(monkeypatch: pytest.MonkeyPatch):
    """The port is that of the settings. Without a controller the port is closed."""
    silent = (b"START\r\n", b"")
    with scripted(w.CONNECT) as transport:
        give(monkeypatch, transport)
        with closing(drivers.open_mirror_driver(SETTINGS, 1500, transport.clock)) as mirror:
            assert isinstance(mirror, MirrorController)
            assert mirror.identity.startswith("MR-E-2,")
        assert transport.closed
    with scripted([*[silent] * 3, (w.LEAVE[0], b""), *[silent] * 3]) as transport:
        give(monkeypatch, transport)
        with pytest.raises(DeadlinePassed):
            drivers.open_mirror_driver(SETTINGS, 1500, transport.clock)
        assert transport.closed
