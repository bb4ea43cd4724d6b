"""The mirror controller, byte by byte: connecting, going, loading, playing, parking, freezing."""

from __future__ import annotations

import pytest

from pipeline.errors import PoseError, RigError, SettingsError, ShapeError
from pipeline.rig.clock import ManualClock
from pipeline.rig.device_errors import DeadlinePassed, DeviceGone, DeviceRefused, StateUnknown
from pipeline.rig.mirror.mirror_controller import MirrorController
from pipeline.rig.mirror.registers import Status, Trigger
from pipeline.rig.mirror.steering import Identity, Steering
from tests.rig.mirror.mirror_bytes import (
    CONNECT,
    DONE,
    ENTER,
    GOTO,
    GREET,
    HALT,
    IDLE,
    LEAVE,
    LOAD,
    PARK,
    PATH,
    PLAYING,
    READ_BACK,
    RUN,
    SET_X,
    SET_X_INCLUSIVE,
    SET_Y,
    SET_Y_INCLUSIVE,
    TRIMMED,
    UNREST,
    WARM,
    WELL,
    connected,
    pair,
)
from tests.rig.scripted import Late, ScriptedTransport, scripted


def test_connecting_moves_nothing_and_says_who_is_there():
    """Greeting, id, version, serial number, pro mode, status: no other byte is sent."""
    with scripted(CONNECT) as transport:
        mirror: Steering = connected(transport)
        assert mirror.identity() == Identity("MR-E-2", "1.2.4065", "ABCD0123")


def test_nothing_is_sent_before_connecting():
    """All that speaks to the device wants it connected."""
    mirror = MirrorController(ScriptedTransport([], ManualClock()), clock=ManualClock())
    for call in (mirror.identity, mirror.status, mirror.temperature, mirror.park, mirror.halt, mirror.index):
        with pytest.raises(RigError, match="scripted is not connected; call connect first"):
            call()


def test_another_controller_is_refused():
    """The id that the settings expect is looked for in what the device says."""
    with scripted(CONNECT) as transport, pytest.raises(RigError, match=r"whose id holds 'MR-E-9' .* got 'MR-E-2'"):
        connected(transport, expected_id="MR-E-9")


def test_going_is_one_frame():
    """Both positions, control, inputs and the stopped units go in one frame, after a look at the status."""
    with scripted([*CONNECT, WELL, pair(GOTO, DONE)]) as transport:
        connected(transport).goto(0.5, -0.25)


def test_parking_is_going_to_the_middle():
    """Park is 0; 0."""
    with scripted([*CONNECT, WELL, pair(PARK, DONE)]) as transport:
        connected(transport).park()


@pytest.mark.parametrize(("x", "y"), [(1.01, 0.0), (0.8, 0.8), (float("nan"), 0.0)])
def test_targets_outside_the_disk_send_no_byte(x: float, y: float):
    """What the device would trim to its rim unasked is refused before the wire, as a target and in a path."""
    with scripted(CONNECT) as transport:
        mirror = connected(transport)
        with pytest.raises(PoseError, match="keep the field within the mirror's range"):
            mirror.goto(x, y)
        with pytest.raises(PoseError, match=r"\(index 1\)"):
            mirror.load_path([(0, 0), (x, y)])


def test_a_warm_mirror_is_not_moved():
    """A status that forbids motion is said in words, and no motion is sent; without the check it is."""
    with scripted([*CONNECT, WARM]) as transport, pytest.raises(RigError, match="the mirror is too warm; mend that"):
        connected(transport).goto(0.5, -0.25)
    with scripted([*CONNECT, pair(GOTO, DONE)]) as transport:
        connected(transport, check_status=False).goto(0.5, -0.25)


def test_a_path_is_loaded_and_played_half_open():
    """X lies before Y, a part of the path is a range of both, and both units start in one frame."""
    script = [*CONNECT, IDLE, LOAD, READ_BACK, HALT, SET_X, SET_Y, WELL, pair(RUN, DONE)]
    with scripted(script) as transport:
        mirror = connected(transport)
        mirror.load_path(PATH, read_back="all")
        mirror.run(1, 3, 10.0, cycles=2, trigger=Trigger.RISING_EDGE)


def test_a_device_with_inclusive_ends_gets_the_last_cell():
    """The one place where half-open ranges become the device's is a setting."""
    script = [*CONNECT, IDLE, LOAD, HALT, SET_X_INCLUSIVE, SET_Y_INCLUSIVE, WELL, pair(RUN, DONE)]
    with scripted(script) as transport:
        mirror = connected(transport, ends="inclusive", read_back="none")
        mirror.load_path(PATH)
        mirror.run(1, 3, 10.0, cycles=2, trigger=Trigger.RISING_EDGE)


def test_what_is_not_loaded_is_not_played():
    """Ranges outside what is loaded, rates and cycles that mean nothing send no byte."""
    with scripted([*CONNECT, IDLE, LOAD]) as transport:
        mirror = connected(transport, read_back="none")
        with pytest.raises(SettingsError, match="0:1 is no range of the 0 positions loaded; load them first"):
            mirror.run(0, 1, 10.0)
        mirror.load_path(PATH)
        for first, stop in ((0, 4), (2, 2), (-1, 2), (2, 1)):
            with pytest.raises(SettingsError, match=f"{first}:{stop} is no range of the 3 positions"):
                mirror.run(first, stop, 10.0)
        for rate_hz, cycles in ((0.0, 1), (float("nan"), 1), (float("inf"), 1), (10.0, 0), (10.0, -2)):
            with pytest.raises(SettingsError, match="a rate above 0 Hz"):
                mirror.run(0, 3, rate_hz, cycles)


def test_a_path_that_is_too_long_sends_no_byte():
    """1500 positions to a load, or what the settings say."""
    with scripted(CONNECT) as transport:
        mirror = connected(transport, vector_pairs=2)
        with pytest.raises(SettingsError, match="holds 2 positions, got 3; load in parts"):
            mirror.load_path(PATH)
        with pytest.raises(ShapeError, match="at least one"):
            mirror.load_path([])


def test_nothing_is_loaded_under_a_playing_path():
    """The memory that plays is not written, and modes are not changed under it."""
    with scripted([*CONNECT, PLAYING, PLAYING]) as transport:
        mirror = connected(transport)
        for call in (lambda: mirror.load_path(PATH), mirror.temperature):
            with pytest.raises(RigError, match=r"plays a path; .* when that is over, or halt it"):
                call()


def test_a_path_that_was_not_kept_is_not_played():
    """A cell that came back otherwise is named, nothing moves, and the path does not count as loaded."""
    wrong = pair(
        "7E 00 15 05 26 00 00 00 18 4D 59 7E",
        "7E 00 15 18 3F 00 00 00 00 00 00 00 3F 80 00 00 BE 80 00 00 3E 80 00 00 00 00 00 00 82 25 7E",
    )
    with scripted([*CONNECT, IDLE, LOAD, wrong]) as transport:
        mirror = connected(transport)
        with pytest.raises(RigError, match=r"cell 4 .*\(Y of position 1\) holds 0.25, 0 was sent"):
            mirror.load_path(PATH)
        with pytest.raises(SettingsError, match="0 positions loaded"):
            mirror.run(0, 3, 10.0)


def test_path_whose_upload_failed_is_not_played():
    """Neither it nor the one before: the memory holds some of both, however many cells were written."""
    with scripted([*CONNECT, IDLE, LOAD, IDLE, (LOAD[0], b"")]) as transport:
        mirror = connected(transport, read_back="none")
        mirror.load_path(PATH)
        with pytest.raises(DeadlinePassed, match="writing cells 0 to 6"):
            mirror.load_path(PATH)
        with pytest.raises(SettingsError, match="0:3 is no range of the 0 positions loaded"):
            mirror.run(0, 3, 10.0)


def test_an_unacknowledged_motion_freezes():
    """The motion goes once, later ones send no byte; looking and halting still work."""
    late = Late(1.02, bytes.fromhex(DONE))
    script = [*CONNECT, WELL, (bytes.fromhex(GOTO), [late]), WELL, HALT]
    with scripted(script) as transport:
        mirror = connected(transport)
        with pytest.raises(StateUnknown, match=r"going to 0.5; -0.25 was sent to scripted and may have happened"):
            mirror.goto(0.5, -0.25)
        for call in (mirror.park, lambda: mirror.goto(0, 0)):
            with pytest.raises(StateUnknown, match="going to 0; 0 is refused"):
                call()
        assert mirror.status() == Status(0)
        mirror.halt()


def test_a_frozen_mirror_plays_no_path():
    """Running is a motion, too: it is refused before anything is set up."""
    with scripted([*CONNECT, IDLE, LOAD, WELL, (bytes.fromhex(GOTO), b"")]) as transport:
        mirror = connected(transport, read_back="none")
        mirror.load_path(PATH)
        with pytest.raises(StateUnknown):
            mirror.goto(0.5, -0.25)
        with pytest.raises(StateUnknown, match="running a path is refused"):
            mirror.run(0, 3, 10.0)


def test_a_run_without_acknowledgement_is_sent_once():
    """Whether the path plays is not known then."""
    script = [*CONNECT, IDLE, LOAD, HALT, SET_X, SET_Y, WELL, (bytes.fromhex(RUN), b"")]
    with scripted(script) as transport:
        mirror = connected(transport, read_back="none")
        mirror.load_path(PATH)
        with pytest.raises(StateUnknown, match="running positions 1:3 was sent"):
            mirror.run(1, 3, 10.0, cycles=2, trigger=Trigger.RISING_EDGE)


def test_a_cable_pulled_in_a_motion_freezes():
    """The port went away while the acknowledgement was due."""
    script = [*CONNECT, WELL, (bytes.fromhex(GOTO), [DeviceGone("scripted went away")])]
    with scripted(script) as transport, pytest.raises(StateUnknown, match="went away"):
        connected(transport).goto(0.5, -0.25)


def test_settling_waits_for_rest():
    """Polled until the bit is gone."""
    with scripted([*CONNECT, UNREST, UNREST, WELL]) as transport:
        connected(transport).settle(1.0)
        assert transport.clock.now() == pytest.approx(0.02)


def test_a_mirror_that_never_rests_is_said():
    """The time that it was given, and the status in words."""
    with scripted([*CONNECT, *[UNREST] * 6]) as transport, pytest.raises(RigError, match=r"not at rest after 0.05 s"):
        connected(transport).settle(0.05)


def test_a_trimmed_target_is_said():
    """A device that trims a target within the disk does not stand where it was sent."""
    with scripted([*CONNECT, TRIMMED]) as transport, pytest.raises(RigError, match=r"not where it was sent; .*trimmed"):
        connected(transport).settle(1.0)


def test_temperature_is_asked_in_simple_mode_and_back():
    """The mode is changed and changed back; nothing moves."""
    script = [*CONNECT, IDLE, LEAVE, GREET, (b"GETTEMP\r\n", b"31.5\r\n"), ENTER, WELL]
    with scripted(script) as transport:
        assert connected(transport).temperature() == 31.5


def test_pro_mode_is_entered_again_after_a_refusal():
    """Firmware that does not tell its temperature leaves the mode as it was."""
    script = [*CONNECT, IDLE, LEAVE, GREET, (b"GETTEMP\r\n", b"NO\r\n"), ENTER, WELL, WELL]
    with scripted(script) as transport:
        mirror = connected(transport)
        with pytest.raises(DeviceRefused, match="answered NO to GETTEMP"):
            mirror.temperature()
        assert mirror.status() == Status(0)


def test_the_place_in_the_path_is_the_cell_of_x():
    """Index register of the first unit."""
    asked = pair("7E 00 11 02 68 0A 0B 3B 7E", "7E 00 11 04 00 00 00 02 73 40 7E")
    with scripted([*CONNECT, asked]) as transport:
        assert connected(transport).index() == 2


def test_closing_parks_only_when_asked():
    """By default not a byte is sent at the end."""
    with scripted(CONNECT) as transport:
        with connected(transport):
            pass
        assert transport.closed
    with scripted([*CONNECT, WELL, pair(PARK, DONE)]) as transport:
        connected(transport, park_at_close=True).close()
        assert transport.closed


def test_closing_never_moves_a_frozen_mirror(caplog: pytest.LogCaptureFixture):
    """Where motions are frozen, or parking fails, the port is let go of all the same."""
    with scripted([*CONNECT, WELL, (bytes.fromhex(GOTO), b"")]) as transport:
        mirror = connected(transport, park_at_close=True)
        with pytest.raises(StateUnknown):
            mirror.goto(0.5, -0.25)
        mirror.close()
        assert transport.closed
    with scripted([*CONNECT, WARM]) as transport:
        connected(transport, park_at_close=True).close()
        assert transport.closed
    assert "not parked" in caplog.text
