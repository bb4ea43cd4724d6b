"""Commands are the documented bytes, and replies are read however they are cut."""

from __future__ import annotations

import pytest

from pipeline.errors import RigError
from pipeline.rig.camera import headwall_replies
from pipeline.rig.camera.headwall_replies import ReplyReader, to_request

REPLY = b'isCapturing\r\n{"success": true, "response": false, "errorMessage": ""}\r\nhpi> '


@pytest.mark.parametrize(
    ("name", "argument", "sent"),
    [
        ("configure", {"exposure": 10.5, "framePeriod": 11}, b'configure({"exposure": 10.5, "framePeriod": 11})\r'),
        (
            "capture",
            {"prefix": "a", "maxCubes": 1, "maxFramesPerCube": 500},
            b'capture({"prefix": "a", "maxCubes": 1, "maxFramesPerCube": 500})\r',
        ),
        ("isCapturing", None, b"isCapturing\r"),
        ("stopCapture", None, b"stopCapture\r"),
        ("listFiles", "/captured", b'listFiles("/captured")\r'),
        ("exit", None, b"exit\r"),
    ],
)
def test_requests(name: str, argument: object, sent: bytes) -> None:
    """Each command is its line and a carriage return."""
    assert to_request(name, argument) == sent


@pytest.mark.parametrize("size", [1, 2, 3, 5, 8, 1000])
def test_cut_anywhere(size: int) -> None:
    """Two replies in a row come out the same, whatever the pieces."""
    reader = ReplyReader()
    data = REPLY * 2
    said = [item for at in range(0, len(data), size) for item in reader.feed(data[at : at + size])]
    assert [(item.command, item.reply) for item in said] == [
        ("isCapturing", {"success": True, "response": False, "errorMessage": ""})
    ] * 2
    assert reader.held == b""


@pytest.mark.parametrize(
    "data",
    [
        b'{"success": true}\r\nhpi> ',
        b'capture({"prefix": "a"})\r\n{"success": true}\r\nhpi> ',
        b'capture({"prefix": "a"})\n{\n  "success":\r\n true\n}\nhpi> ',
        b'{"success": true}hpi> ',
        b'\xff\xfd\x18\r\n{"success": true}\0\r\nhpi> ',
    ],
)
def test_forms_of_a_reply(data: bytes) -> None:
    """With and without its command, on one line or several, with a telnet server's bytes."""
    (said,) = ReplyReader().feed(data)
    assert said.reply == {"success": True}


def test_prompt_in_a_text() -> None:
    """A reply that speaks of the prompt does not end there."""
    (said,) = ReplyReader().feed(b'{"success": false, "errorMessage": "type after hpi> only"}\r\nhpi> ')
    assert said.reply is not None
    assert said.reply["errorMessage"] == "type after hpi> only"


def test_what_is_no_reply() -> None:
    """A greeting and torn JSON have no reply; a bare prompt is nothing."""
    said = ReplyReader().feed(b'Welcome\r\nhpi> hpi> {"success": tr\r\nhpi> ')
    assert [(item.reply, item.text) for item in said] == [(None, "Welcome"), (None, '{"success": tr')]


def test_two_replies_before_one_prompt() -> None:
    """Where a prompt was lost both replies are there, the later one without its command."""
    said = ReplyReader().feed(b'stopCapture\r\n{"success": true, "response": 1}\r\n{"success": true}\r\nhpi> ')
    assert [item.command for item in said] == ["stopCapture", ""]


def test_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes without a prompt are refused before they fill the memory."""
    monkeypatch.setattr(headwall_replies, "LONGEST_REPLY", 100)
    with pytest.raises(RigError, match=r"bytes came without a prompt .* is this the camera's control port"):
        ReplyReader().feed(b"x" * 101)
