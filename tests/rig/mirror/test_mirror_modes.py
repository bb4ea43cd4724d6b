"""Connecting to a controller in either mode, with what an earlier session left behind."""

from __future__ import annotations

import logging

import pytest

from pipeline.errors import RigError
from pipeline.rig.device_errors import DeadlinePassed, DeviceRefused
from tests.rig.mirror.mirror_bytes import CONNECT, ENTER, GREET, LEAVE, WELL, WHO, connected
from tests.rig.scripted import scripted

SILENT = (b"START\r\n", b"")
DAMAGED = bytes.fromhex("7E 00 D4 04 00 00 00 01 22 14 7E")  # what the greeting gets in pro mode


@pytest.mark.parametrize("complaint", [b"", DAMAGED])
def test_a_controller_in_pro_mode_is_brought_to_simple_mode_first(complaint: bytes):
    """It does not answer the greeting; then it is told to change, and may complain about the greeting's bytes."""
    leave = (LEAVE[0], [complaint, LEAVE[1]])
    with scripted([SILENT, SILENT, SILENT, leave, GREET, *WHO, ENTER, WELL]) as transport:
        assert connected(transport).identity().device == "MR-E-2"


def test_a_usual_reconnect_warns_of_nothing(caplog: pytest.LogCaptureFixture):
    """In pro mode as drivers leave it, with bytes of another program before: noted, no cause to look."""
    leave = (LEAVE[0], [DAMAGED, LEAVE[1]])
    with (
        caplog.at_level(logging.INFO),
        scripted([SILENT, SILENT, SILENT, leave, GREET, *WHO, ENTER, WELL]) as transport,
    ):
        assert connected(transport).found_in_pro
    with caplog.at_level(logging.INFO), scripted(CONNECT, stale=b"NO", drained=b"NO") as transport:
        assert not connected(transport).found_in_pro
    assert "it may be in pro mode" in caplog.text
    assert "dropped 2 stale bytes" in caplog.text
    assert {record.levelno for record in caplog.records} == {logging.INFO}


def test_damage_at_a_reconnect_is_warned_of(caplog: pytest.LogCaptureFixture):
    """Half of an answer to the greeting is nothing that another mode explains."""
    with caplog.at_level(logging.INFO), scripted([(b"START\r\n", b"O"), *CONNECT]) as transport:
        connected(transport)
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_a_line_that_somebody_began_is_ended_by_the_greeting():
    """The first greeting ends it and is refused, the second is answered."""
    for answer in (b"NO\r\n", b"ERROR\r\n"):
        with scripted([(b"START\r\n", answer), *CONNECT]) as transport:
            connected(transport)


def test_a_lost_greeting_is_sent_again():
    """A greeting moves nothing and is repeated."""
    with scripted([SILENT, *CONNECT]) as transport:
        connected(transport)


def test_stale_bytes_at_connect_are_no_answer():
    """Whatever lies on the line from before is dropped."""
    stale = b"NO\r\n" + bytes.fromhex("7E 00 11 04 00 00")
    with scripted(CONNECT, stale=stale, drained=stale) as transport:
        connected(transport)


def test_nobody_there_is_said_within_the_deadlines():
    """No answer in either mode: three transactions' time, and what to look at."""
    with scripted([*[SILENT] * 3, (LEAVE[0], b""), *[SILENT] * 3]) as transport:
        with pytest.raises(DeadlinePassed, match=r"no answer to START from scripted .*is the controller on"):
            connected(transport)
        assert transport.clock.now() < 4


def test_firmware_that_does_not_know_a_question_is_served_all_the_same():
    """A version that is not told stays empty."""
    who = [WHO[0], (b"GETVERSION\r\n", b"NO\r\n"), (b"GETSN\r\n", b"NO\r\n")]
    with scripted([GREET, *who, ENTER, WELL]) as transport:
        identity = connected(transport).identity()
    assert (identity.device, identity.version, identity.serial) == ("MR-E-2", "", "")


def test_a_change_of_mode_whose_answer_was_lost_is_found_out():
    """The status tells that it is in pro mode."""
    with scripted([GREET, *WHO, (ENTER[0], b""), WELL]) as transport:
        connected(transport)


def test_firmware_without_crc_says_which_setting_to_turn():
    """GOPROCRC is unknown: the message names the setting, and the setting sends GOPRO."""
    words = r"Firmware without GOPROCRC\? Turn mirror.with_crc over"
    with scripted([GREET, *WHO, (ENTER[0], b"NO\r\n")]) as transport, pytest.raises(DeviceRefused, match=words):
        connected(transport)
    status = (bytes.fromhex("7E 00 02 02 00 00 00 00 7E"), bytes.fromhex("7E 00 02 04 00 00 00 00 00 00 7E"))
    with scripted([GREET, *WHO, (b"GOPRO\r\n", b"OK\r\n"), status]) as transport:
        connected(transport, with_crc=False)


def test_another_device_is_refused():
    """What talks without being asked, or answers otherwise, is not the mirror."""
    with scripted([(b"START\r\n", b"login: \r\n")] * 3) as transport, pytest.raises(RigError, match="got 'login:'"):
        connected(transport)
