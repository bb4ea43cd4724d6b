"""Transactions: deadlines, retries, motions that are sent once, and late and stale bytes."""

from __future__ import annotations

import logging

import pytest

from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.rig import transports
from spectralzoom.pipeline.rig.fakes import FakeClock
from spectralzoom.pipeline.rig.transports import DeadlinePassed, DeviceGone, Kind, StateUnknown, Wire
from tests.pipeline.rig.scripted import Late, Pair, ScriptedTransport, scripted


def one_line(data: bytes) -> bytes | None:
    """Return data that end a line as the reply."""
    if data == b"bad\n":
        raise RigError("expected an answer, got bad")
    return data if data.endswith(b"\n") else None


def ask(wire: Wire, data: bytes = b"q\n", kind: Kind = "read") -> bytes:
    """Perform one transaction."""
    return wire.exchange(data, f"asking {data.decode().strip()}", kind, lambda: one_line)


def make(transport: ScriptedTransport) -> Wire:
    """Return a wire over the transport."""
    return Wire(transport, transport.clock)


ANSWERED, LOST, BAD = (b"q\n", b"a\n"), (b"q\n", b""), (b"q\n", b"bad\n")
SLOW = [*(Late(0.1 * number, b"a") for number in range(1, 9)), Late(0.9, b"\n")]
READS: dict[str, tuple[list[Pair], bytes | str]] = {  # the script, and the reply or the words of the error
    "answered": ([ANSWERED], b"a\n"),
    "one answer lost": ([LOST, ANSWERED], b"a\n"),
    "two answers lost": ([LOST, LOST, ANSWERED], b"a\n"),
    "three answers lost": ([LOST] * 3, "asking q from scripted"),
    "slow, a byte at a time": ([(b"q\n", SLOW)], b"\n"),
    "nonsense": ([BAD, ANSWERED], b"a\n"),
    "nothing but nonsense": ([BAD] * 3, "got bad"),
    "an answer behind nonsense": ([(b"q\n", [b"bad\n", Late(0.05, b"a\n")]), (b"q\n", b"b\n")], b"b\n"),
    "nobody there": ([(b"q\n", [DeviceGone("it went away")])], "it went away"),
}


@pytest.mark.parametrize("name", READS)
def test_reads_are_retried_within_one_deadline(name: str):
    """Up to two lost or invalid replies are retried within it, and a slow reply is not cut off."""
    script, given = READS[name]
    with scripted(script) as transport:
        if isinstance(given, bytes):
            assert ask(make(transport)) == given
        else:
            with pytest.raises(RigError, match=given):
                ask(make(transport))
        assert transport.clock.now() <= 1.0 + 1e-9


def test_silence_between_retries_stays_within_the_deadline():
    """Bytes that arrive slowly after a retry is due do not extend the transaction."""
    parts = [Late(0.4 + 0.09 * number, b"x") for number in range(20)]
    transport = ScriptedTransport([(b"q\n", parts), LOST], FakeClock())
    with pytest.raises(DeadlinePassed):
        ask(make(transport))
    assert transport.clock.now() == pytest.approx(1.0)


def test_writes_are_sent_once():
    """A write without a reply is not retried and blocks nothing."""
    with scripted([(b"w\n", b"")]) as transport:
        wire = make(transport)
        with pytest.raises(DeadlinePassed):
            ask(wire, b"w\n", "write")


@pytest.mark.parametrize("received", [b"", b"half", b"bad\n", [Late(1.5, b"ok\n")], [DeviceGone("it went away")]])
def test_an_unacknowledged_motion_is_sent_once(received):
    """If its acknowledgement is lost, damaged or late, the motion may have happened."""
    transport = ScriptedTransport([(b"m\n", received)], FakeClock())
    with pytest.raises(StateUnknown, match="asking m was sent to scripted and may have happened or not"):
        ask(make(transport), b"m\n", "motion")
    assert transport.sent == 1


def test_a_late_acknowledgement_does_not_answer_the_next_read(caplog: pytest.LogCaptureFixture):
    """The late acknowledgement is dropped; the message has a remedy."""
    pairs: list[Pair] = [(b"m\n", [Late(1.05, b"late\n")]), (b"q\n", b"a\n")]
    with scripted(pairs) as transport, caplog.at_level(logging.INFO):
        wire = make(transport)
        with pytest.raises(StateUnknown, match=r"Look at the device, .* run again, which connects anew"):
            ask(wire, b"m\n", "motion")
        assert ask(wire) == b"a\n"
    assert "dropped 5 stale bytes" in caplog.text


def test_a_late_reply_does_not_answer_the_next_request(monkeypatch: pytest.MonkeyPatch):
    """The next request waits once for a late reply and drops it before it is sent."""
    monkeypatch.setattr(transports, "RETRIES", 0)
    pairs: list[Pair] = [(b"q\n", [Late(1.05, b"old\n")]), (b"r\n", b"new\n"), (b"s\n", b"b\n")]
    with scripted(pairs) as transport:
        wire = make(transport)
        with pytest.raises(DeadlinePassed):
            ask(wire)
        assert ask(wire, b"r\n") == b"new\n"
        until = transport.clock.now()
        assert 1.05 <= until <= 1.2
        assert ask(wire, b"s\n") == b"b\n"
        assert transport.clock.now() == until


def test_a_late_reply_of_a_retried_read_does_not_answer_the_next_request(monkeypatch: pytest.MonkeyPatch):
    """Both replies to a read that was sent twice are removed from the line."""
    monkeypatch.setattr(transports, "QUIET_S", 0.3)
    pairs: list[Pair] = [(b"q\n", [Late(0.5, b"old\n")]), (b"q\n", b"a\n"), (b"r\n", b"new\n")]
    with scripted(pairs, drained=b"") as transport:
        wire = make(transport)
        assert ask(wire) == b"a\n"
        assert ask(wire, b"r\n") == b"new\n"


def test_stale_bytes_are_dropped_and_logged(caplog: pytest.LogCaptureFixture):
    """Bytes that an earlier session left on the line are no reply."""
    with scripted([(b"q\n", b"a\n")], stale=b"old\n", drained=b"old\n") as transport, caplog.at_level(logging.INFO):
        assert ask(make(transport)) == b"a\n"
    assert "scripted: dropped 4 stale bytes before asking q: b'old\\n'" in caplog.text


def test_a_device_that_sends_endlessly_does_not_block():
    """The wait for silence is limited: two requests end within 3 s."""

    class Babbling(ScriptedTransport):
        """Transport that receives a byte every 10 ms."""

        def read(self, at_most: int, deadline: float) -> bytes:
            if self.clock.now() >= deadline:
                return b""
            self.clock.sleep(0.01)
            return b"x"

    transport = Babbling([(b"q\n", b""), (b"r\n", b"")], FakeClock())
    wire = make(transport)
    with pytest.raises(DeadlinePassed, match=r"other bytes came: b'xx"):
        ask(wire)
    with pytest.raises(DeadlinePassed, match="r from"):
        ask(wire, b"r\n", "write")
    assert transport.clock.now() < 3


def test_a_motion_that_was_not_sent_is_no_motion():
    """Without a device the port cannot even be read, so nothing is sent."""

    class Gone(ScriptedTransport):
        """Transport that cannot be read."""

        def read(self, at_most: int, deadline: float) -> bytes:
            raise DeviceGone("it went away")

    with pytest.raises(DeviceGone):
        ask(make(Gone([], FakeClock())), b"m\n", "motion")
