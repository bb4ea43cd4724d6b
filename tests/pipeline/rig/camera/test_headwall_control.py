"""The control client sends the documented bytes, retries what is safe to retry, and reports what it finds."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest

from spectralzoom.pipeline.errors import RigError, SettingsError
from spectralzoom.pipeline.rig.camera import headwall_camera
from spectralzoom.pipeline.rig.camera.camera_files import KeptInMemory
from spectralzoom.pipeline.rig.camera.headwall_camera import Entry, HeadwallCamera, ReplyReader, response_of
from spectralzoom.pipeline.rig.device_settings import FileServer, check_times
from spectralzoom.pipeline.rig.fakes import FakeClock
from spectralzoom.pipeline.rig.transports import DeviceGone, DeviceRefused, StateUnknown
from tests.pipeline.rig.scripted import Pair, Reply, ScriptedTransport

HELLO = b"Hyperspec\r\nhpi> "
CAPTURE = b'capture({"prefix": "f1", "maxCubes": 1, "maxFramesPerCube": 500})\r'
IS_CAPTURING = b"isCapturing\r"


def said(command: bytes, response: bytes) -> bytes:
    """Return a reply as the camera writes it."""
    return command + b'\n{"success": true, "response": ' + response + b', "errorMessage": ""}\r\nhpi> '


def refused(command: bytes, why: bytes) -> bytes:
    """Return a refusal as the camera writes it."""
    return command + b'\n{"success": false, "response": null, "errorMessage": "' + why + b'"}\r\nhpi> '


@contextmanager
def talk(*connections: Sequence[Pair], hello: bytes = HELLO) -> Iterator[HeadwallCamera]:
    """Yield a client whose connections follow these scripts; all of them must be used up."""
    clock = FakeClock()
    scripts = [ScriptedTransport(pairs, clock, hello) for pairs in connections]
    waiting = iter(scripts)
    yield HeadwallCamera(lambda: next(waiting), FileServer(), clock=clock)
    for script in scripts:
        script.check()


@pytest.mark.parametrize("echo", [True, False])
def test_every_command_is_sent_and_its_reply_read(echo: bool) -> None:
    """Replies are read with or without an echo of the command."""

    def answer(command: bytes, response: bytes) -> Pair:
        return command, said(command if echo else b"", response)

    listing = (
        b'[{"name": "/captured//a/raw_0", "size": 12, "mtime": 1.5, "isDirectory": false}, '
        b'{"name": "/captured/a/b", "isDirectory": true}]'
    )
    with talk(
        [
            answer(b'configure({"exposure": 10.5, "framePeriod": 11})\r', b"{}"),
            answer(CAPTURE, b'{"folder": "/captured/f1_0"}'),
            answer(IS_CAPTURING, b"true"),
            answer(b"stopCapture\r", b"true"),
            answer(b"isCapturing\r", b"false"),
            answer(b'listFiles("/captured/a")\r', listing),
            (b"exit\r", b""),
        ]
    ) as control:
        control.configure(10.5, 11)
        assert control.capture(500, prefix="f1").folder == "/captured/f1_0"
        assert control.is_capturing()
        control.stop()
        assert control.references("/captured/a", KeptInMemory()) == {}  # of a folder without dark and white
        control.close()


def test_replies_in_pieces_are_assembled() -> None:
    """Greeting, prompt and reply may be cut anywhere, also within the prompt."""
    whole = said(IS_CAPTURING, b"false")
    pieces: list[Reply] = [whole[at : at + 1] for at in range(len(whole))]
    with talk([(IS_CAPTURING, pieces)], hello=b"hpi> ") as control:
        assert not control.is_capturing()


def test_a_late_reply_is_not_taken_for_the_next_one() -> None:
    """A reply after the deadline leads to a new connection, 5.5 s after the request."""
    with talk([(b"isCapturing\r", b"")], [(b"isCapturing\r", said(IS_CAPTURING, b"true"))]) as control:
        assert control.is_capturing()
        assert control.clock.now() == pytest.approx(5.5)


@pytest.mark.parametrize(
    ("reply", "hello", "words"),
    [
        (b"Segmentation fault\r\nhpi> ", HELLO, "Segmentation fault.*: Invalid JSON"),
        (said(IS_CAPTURING, b"7"), HELLO, "Input should be a valid boolean; is this the camera"),
        (b'{"response": true}\r\nhpi> ', HELLO, "Field required"),
        (b"{]\r\nhpi> ", HELLO, "Invalid JSON"),
        (b"isCapturing\r\n{", HELLO, r"within 5 s .*14 other bytes came"),
        (None, b"SSH-2.0\r\n", "no answer to the greeting .*SSH-2.0.*; is it the camera's control port"),
    ],
)
def test_invalid_replies_are_reported(
    monkeypatch: pytest.MonkeyPatch, reply: bytes | None, hello: bytes, words: str
) -> None:
    """The message quotes the reply, or names the deadline and what came. A peer without a prompt is no camera."""
    monkeypatch.setattr(headwall_camera, "RETRIES", 0)
    pairs: list[Pair] = [] if reply is None else [(IS_CAPTURING, reply)]
    with talk(pairs, hello=hello) as control, pytest.raises(RigError, match=words):
        control.is_capturing()


def test_a_refused_capture_did_not_begin() -> None:
    """The refusal is reported once, and the capture is not retried. Stopping without a capture is no failure."""
    stop = (b"stopCapture\r", refused(b"stopCapture\r", b"oh"))
    with talk([(CAPTURE, refused(CAPTURE, b"disk full")), stop]) as control:
        with pytest.raises(DeviceRefused, match="refused capture: 'disk full'; see its manual"):
            control.capture(500, prefix="f1")
        control.stop()


def test_a_capture_without_a_reply_is_sent_once() -> None:
    """Stopping still works afterwards."""
    with talk([(CAPTURE, b"")], [(b"stopCapture\r", said(b"stopCapture\r", b"true"))]) as control:
        with pytest.raises(StateUnknown, match=r"capture was sent to scripted and may have happened or not: no answer"):
            control.capture(500, prefix="f1")
        control.stop()


def test_a_connection_that_the_camera_ended_is_made_again() -> None:
    """Nothing of the capture was sent on the old one, so that it begins on a new one."""
    first = [(IS_CAPTURING, [said(IS_CAPTURING, b"false"), DeviceGone("closed by the other end")])]
    with talk(first, [(CAPTURE, said(CAPTURE, b'{"folder": "/captured/f1_0"}'))]) as control:
        assert not control.is_capturing()
        assert control.capture(500, prefix="f1").folder == "/captured/f1_0"


def test_stale_bytes_are_dropped(caplog: pytest.LogCaptureFixture) -> None:
    """Bytes that arrive before a command are dropped and not taken for its reply."""
    caplog.set_level(logging.INFO)
    torn = [said(IS_CAPTURING, b"false"), said(IS_CAPTURING, b"true")[:20]]
    with talk([(IS_CAPTURING, torn), (IS_CAPTURING, said(IS_CAPTURING, b"false"))]) as control:
        assert not control.is_capturing()
        assert not control.is_capturing()
    assert "scripted: dropped 20 stale bytes" in caplog.text


@pytest.mark.parametrize(
    ("exposure", "period", "words"),
    [
        (0.003, 10, r"exposure 0.003 ms, expected 0.5 ms up to the frame period of 10 ms"),
        (3, 0.003, r"frame period 0.003 ms, expected 2.857 to 10000 ms"),
        (20, 10, "up to the frame period of 10 ms"),
        (float("nan"), 10, "exposure nan"),
        (100_000, 100_000, "frame period 100000 ms"),
    ],
)
def test_implausible_exposure_times_are_refused(exposure: float, period: float, words: str) -> None:
    """Seconds instead of milliseconds, and exposures above the frame period, are refused."""
    with pytest.raises(SettingsError, match=words):
        check_times(exposure, period, 350.0)


@pytest.mark.parametrize(
    "data",
    [
        b'{"success": true, "response": 1}\r\nhpi> ',
        b'capture({"prefix": "a"})\r\n{"success": true, "response": 1}\r\nhpi> ',
        b'capture({"prefix": "a"})\n{\n  "success":\r\n true, "response": 1\n}\nhpi> ',
        b'{"success": true, "response": 1}hpi> ',
        b'\xff\xfd\x18\r\n{"success": true, "response": 1}\0\r\nhpi> ',
    ],
)
def test_every_form_of_a_reply_is_parsed(data: bytes) -> None:
    """Replies come with or without the command, on one line or several, and with bytes of a telnet server."""
    (reply,) = ReplyReader().feed(data)
    assert response_of(reply, "it", "here", int) == 1


def test_other_text_before_a_prompt_is_separated() -> None:
    """The reader splits off a greeting, torn JSON and a prompt within a text, and two replies in pieces of any size."""
    assert ReplyReader().feed(b'Welcome\r\nhpi> {"success": tr\r\nhpi> ') == ["Welcome", '{"success": tr']
    (one,) = ReplyReader().feed(b'{"success": false, "errorMessage": "type after hpi> only"}\r\nhpi> ')
    assert one == '{"success": false, "errorMessage": "type after hpi> only"}'
    both = b'stopCapture\r\n{"success": true}\r\nhpi> {"success": true}\r\nhpi> '
    for size in (1, 2, 3, 5, 8, 1000):
        reader = ReplyReader()
        found = [reply for at in range(0, len(both), size) for reply in reader.feed(both[at : at + size])]
        assert found == ['stopCapture\r\n{"success": true}', '{"success": true}']
        assert reader.held == b""


def test_bytes_without_a_prompt_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reader raises an error before such bytes fill the memory."""
    monkeypatch.setattr(headwall_camera, "LONGEST_REPLY", 100)
    with pytest.raises(RigError, match=r"bytes came without a prompt .* is this the camera's control port"):
        ReplyReader().feed(b"x" * 101)


def test_a_listing_has_files_and_folders() -> None:
    """A folder has no size; other responses are refused."""
    file, folder = (
        '{"name": "/c/raw_0", "size": 12, "mtime": 1.5, "isDirectory": false}',
        '{"name": "/c/b", "isDirectory": true}',
    )

    def listed(response: str) -> list[Entry]:
        return response_of(f'{{"success": true, "response": {response}}}', "listFiles", "here", list[Entry])

    assert [(one.name, one.size, one.is_folder) for one in listed(f"[{file}, {folder}]")] == [
        ("/c/raw_0", 12, False),
        ("/c/b", None, True),
    ]
    for other in ("7", "[7]", '[{"name": 7}]', '[{"name": "/c/raw_0", "size": "12"}]', "null"):
        with pytest.raises(RigError, match=r"here answered listFiles with .*is this the camera's control port"):
            listed(other)
