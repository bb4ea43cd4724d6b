"""A camera that means harm holds nobody beyond a deadline, fills no disk and no memory, and is told in one message."""

from __future__ import annotations

import time
from dataclasses import dataclass

import pytest

from pipeline.errors import RigError
from pipeline.rig.camera.camera_files import KeptInMemory, RemoteFile, fetch_files, log_in
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.device_settings import CameraAddress, ControlPatience, FileServer
from pipeline.rig.rig_check import check_camera
from pipeline.rig.transports import DeadlinePassed, DeviceGone
from tests.pipeline.rig.camera.hostile_camera import Answers, HostileControl, HostileFiles, Pieces, flood, trickled

STALL_S = 0.3
FILE = RemoteFile("/captured/a/raw_0", None, False, most=1000)


def server(port: int, **changed: object) -> FileServer:
    """A file server that is waited for but shortly."""
    given = {"stall_s": STALL_S, "tries": 2, "pause_s": 0.0, **changed}
    return FileServer("127.0.0.1", port, **given)  # type: ignore[arg-type]


def assert_one_message(error: BaseException) -> None:
    """One line that an operator can read."""
    words = str(error)
    assert "\n" not in words
    assert "\r" not in words
    assert 20 < len(words) < 700


@pytest.mark.parametrize(
    ("greeting", "kind"),
    [
        (trickled(b"2"), DeadlinePassed),
        (trickled(b"220-more\r\n"), DeadlinePassed),
        (flood(b"220-more\r\n"), RigError),
        (flood(b"x"), RigError),
        ((b"\xff\xfe\xfd\r\n",), RigError),
        ((b"HTTP/1.1 400\r\n",), RigError),
        ((b"220", 9.0), DeadlinePassed),
        ((), DeadlinePassed),
    ],
    ids=[
        "a byte now and then",
        "lines now and then",
        "lines without end",
        "a line without end",
        "no text",
        "no FTP",
        "half",
        "none",
    ],
)
def test_greetings(greeting: Pieces, kind: type[RigError]) -> None:
    """However a server greets, logging in ends by its deadline, in one message."""
    with HostileFiles(greeting=greeting) as hostile:
        began = time.monotonic()
        with pytest.raises(kind) as caught:
            log_in(server(hostile.port))
        assert time.monotonic() - began < 3 * STALL_S + 0.5
    assert_one_message(caught.value)


def test_greeting_of_another_encoding() -> None:
    """A server that greets in Latin-1 is a server all the same."""
    with HostileFiles(greeting=(b"220 caf\xe9\r\n",)) as hostile:
        assert log_in(server(hostile.port)) == "caf\ufffd"


def test_logging_in_has_one_deadline() -> None:
    """A server that takes just less than the deadline for each reply does not get it for each."""
    slow: dict[str, Pieces] = dict.fromkeys(("USER", "PASS", "TYPE"), (0.8 * STALL_S, b"331 go on\r\n"))
    with HostileFiles(slow, greeting=(0.8 * STALL_S, b"220 hello\r\n")) as hostile:
        began = time.monotonic()
        with pytest.raises(DeadlinePassed):
            log_in(server(hostile.port))
        assert time.monotonic() - began < 2.5 * STALL_S


@pytest.mark.parametrize("words", ["abc", "-5", "", "1e3", "9" * 5000, "0x10", "5 6"])
def test_sizes_that_are_none(words: str) -> None:
    """A size in other words than a number ends in one message, and nothing is kept."""
    kept = KeptInMemory()
    says = {"SIZE": [f"213 {words}\r\n".encode()]}
    with HostileFiles(says) as hostile, pytest.raises(RigError, match="expected a number") as caught:
        fetch_files(server(hostile.port), [FILE], kept)
    assert type(caught.value) is RigError
    assert_one_message(caught.value)
    assert kept.files == {}


def test_size_beyond_what_was_asked_for() -> None:
    """Ten gigabytes where a kilobyte was asked for: not a byte is fetched."""
    kept = KeptInMemory()
    words = "is said to have 10000000000 bytes, expected 1000 at most; nothing of it"
    says = {"SIZE": [b"213 10000000000\r\n"]}
    with HostileFiles(says, flood(b"x")) as hostile, pytest.raises(RigError, match=words):
        fetch_files(server(hostile.port), [FILE], kept)
    assert kept.files == {}


@pytest.mark.parametrize(
    ("data", "kind"),
    [(flood(b"x"), RigError), (trickled(), DeadlinePassed), ((9.0,), DeadlinePassed), ((b"x" * 900,), RigError)],
    ids=["without end", "a byte now and then", "silence", "short"],
)
def test_transfers(data: Pieces, kind: type[RigError]) -> None:
    """However a file comes, its transfer ends by the deadline, with no byte beyond its size."""
    kept = KeptInMemory()
    with HostileFiles({"SIZE": [b"213 1000\r\n"]}, data) as hostile:
        one = server(hostile.port)
        began = time.monotonic()
        with pytest.raises(kind) as caught:
            fetch_files(one, [FILE], kept)
        assert time.monotonic() - began < one.most_s(1000) + 2 * STALL_S
    assert_one_message(caught.value)
    assert kept.size(FILE.name) <= 1000


def test_a_byte_each_time_is_no_way_to_bring_a_file() -> None:
    """A server that breaks off after each byte gains one each time, and still meets a deadline."""
    file = RemoteFile(FILE.name, 100_000, False)
    with HostileFiles({"SIZE": [b"213 100000\r\n"]}, (b"x",), end=(0.02, b"426 broken off\r\n")) as hostile:
        one = server(hostile.port, stall_s=0.4, least_kb_s=1e6)
        began = time.monotonic()
        with pytest.raises(DeviceGone, match="are kept"):
            fetch_files(one, [file], KeptInMemory())
        assert time.monotonic() - began < one.most_s(100_000) + 5


def test_two_readings_that_differ() -> None:
    """A server that gives other bytes each time never brings a file, and nothing of it stays."""
    count = iter(range(1000))
    kept = KeptInMemory()
    others = HostileFiles({"SIZE": [b"213 1000\r\n"]}, lambda: [bytes([next(count)]) * 1000])
    with others as hostile, pytest.raises(RigError, match="came differently each time") as caught:
        fetch_files(server(hostile.port), [FILE], kept)
    assert type(caught.value) is RigError
    assert kept.files == {}


REPLY = b'{"success": true, "response": %s, "errorMessage": ""}\r\nhpi> '


@dataclass(frozen=True)
class Case:
    """What a control socket does, and what is said of it."""

    answers: Answers
    words: str


CONTROL = {
    "greeting without end": Case(Answers(flood(b"x")), "greets without end"),
    "greeting a byte now and then": Case(Answers(trickled()), "no prompt"),
    "reply without end": Case(Answers(usual=flood(b"x")), "without a prompt|within"),
    "reply a byte now and then": Case(Answers(usual=trickled(b"{")), "no reply"),
    "prompts without end": Case(Answers(usual=flood(b"xhpi> ")), "prompts"),
    "replies to others": Case(Answers(usual=flood(b"exit\r\n" + REPLY % b"1")), "replies to others"),
    "deep": Case(Answers(usual=(b"[" * 20_000 + b"\r\nhpi> ",)), "expected JSON"),
    "a long number": Case(Answers(usual=(REPLY % (b"1" * 5000),)), "expected JSON"),
    "line ends in a name": Case(
        Answers(says={"listFiles": (REPLY % rb'[{"name": "/a\r\nDELE b", "size": 1}]',)}), "expected no line ends"
    ),
    "half a character in a name": Case(
        Answers(says={"listFiles": (REPLY % rb'[{"name": "/\ud800", "size": 1}]',)}), "expected no line ends"
    ),
}


@pytest.mark.parametrize("name", CONTROL)
def test_control_sockets(name: str) -> None:
    """Whatever the control socket says, a check of the camera ends by its deadline and each row is one message."""
    case = CONTROL[name]
    patience = ControlPatience(STALL_S, 1, 0.01)
    with HostileControl(case.answers) as control, HostileFiles() as files:
        camera = HeadwallCamera.at(CameraAddress("127.0.0.1", control.port), server(files.port), patience=patience)
        began = time.monotonic()
        rows = check_camera(lambda: camera)
        assert time.monotonic() - began < 12 * STALL_S + 2
    failed = [row for row in rows if row.verdict == "fail"]
    assert any(case.words.split("|")[0] in row.came or case.words.split("|")[-1] in row.came for row in failed), failed
    for row in failed:
        assert_one_message(Exception(f"{row.came}; {row.mend}"))


def test_size_without_measure_in_a_listing() -> None:
    """A size that is infinite, or no number, counts as one that the camera does not say."""
    listing = REPLY % b'[{"name": "/a", "size": Infinity}, {"name": "/b", "size": NaN}, {"name": "/c", "size": "x"}]'
    with HostileControl(Answers(says={"listFiles": (listing,)})) as control:
        camera = HeadwallCamera.at(CameraAddress("127.0.0.1", control.port), FileServer())
        assert [file.size for file in camera.list_files("/")] == [None] * 3
        camera.close()
