"""The emulated controller's faults by name, and that each does what its words say, for both devices."""

from __future__ import annotations

import pytest

from pipeline.errors import SettingsError
from pipeline.rig.emulator.fault_names import KINDS, CameraFault, fault_table, make_fault, read_fault, read_faults
from pipeline.rig.emulator.mirror_device import MirrorDevice, Mode, VanishedError
from pipeline.rig.emulator.mirror_faults import LATE_S, SLOW_S, TICK_S
from pipeline.rig.mirror.pro_mode import ErrorCode, Frame, ask_status, encode, float_cell, get_value, refuse, set_vector
from pipeline.rig.mirror.registers import VECTOR_MEMORY, Status, X
from tests.pipeline.rig.in_process import ManualClock
from tests.pipeline.rig.mirror.mirror_bytes import ASK_FIRMWARE, set_value

CODES = {
    "error-frame": ErrorCode.FRAME_INVALID,
    "error-length": ErrorCode.LENGTH_MISMATCH,
    "error-crc": ErrorCode.CRC_WRONG,
    "error-no-register": ErrorCode.NO_REGISTER,
    "error-range": ErrorCode.OUT_OF_RANGE,
    "error-read-only": ErrorCode.READ_ONLY,
    "error-chain": ErrorCode.CHAIN,
    "error-unknown": 0xBEEF,
}


BITS = {
    "never-stable": Status.NOT_STABLE,
    "trimmed": Status.TRIMMED | Status.WAS_TRIMMED,
    "mirror-warm": Status.MIRROR_WARM | Status.WAS_MIRROR_WARM,
    "electronics-warm": Status.ELECTRONICS_WARM | Status.WAS_ELECTRONICS_WARM,
    "disconnected": Status.DISCONNECTED | Status.WAS_DISCONNECTED,
    "eeprom-invalid": Status.EEPROM_INVALID,
}


def device_with(name: str, at: int = 0, seed: int = 0, mode: Mode = Mode.SIMPLE) -> MirrorDevice:
    """A controller with one fault that strikes at a given opportunity."""
    device = MirrorDevice(ManualClock(), [make_fault(name, seed, at)])
    if mode is not Mode.SIMPLE:
        device.set_mode(mode)
    return device


def answer(device: MirrorDevice, data: bytes) -> bytes:
    """All that comes back to some bytes."""
    return b"".join(chunk for _, chunk in device.receive(data))


@pytest.mark.parametrize("name", KINDS)
def test_the_same_seed_strikes_in_the_same_way(name: str) -> None:
    """Two controllers with the same fault and seed answer a long talk with the same bytes."""
    talk = [b"START\r\n", b"GETID\r\n", b"GOPRO\r\n", *[encode(ask_status())] * 60, encode(set_value(X.static_xy, 0.5))]
    for seed in (1, 2):
        said = []
        for _ in range(2):
            device, heard = MirrorDevice(ManualClock(), [read_fault(f"{name}:{seed}")]), []
            try:
                for data in talk:
                    heard.append(device.receive(data))
            except VanishedError:
                heard.append([])
            said.append(heard)
        assert said[0] == said[1]


@pytest.mark.parametrize("name", KINDS)
def test_seeds_strike_early_and_late(name: str) -> None:
    """The opportunities drawn by 200 seeds lie in the kind's span, the first among them, and late ones too."""
    places = [make_fault(name, seed).chance.at for seed in range(200)]
    span = KINDS[name].span
    assert 0 in places
    assert span // 2 <= max(places) < span


def test_a_fault_that_does_not_exist_is_refused_with_those_that_do() -> None:
    """One clear message for each mistake in a fault's name."""
    with pytest.raises(SettingsError, match=r"there is no fault 'lost'; there are .*request-byte-lost"):
        make_fault("lost")
    with pytest.raises(SettingsError, match="name:seed with a whole number, got 'echo:x'"):
        read_fault("echo:x")
    with pytest.raises(SettingsError, match="opportunity 0 or later"):
        make_fault("echo", at=-1)


def test_one_bit_to_the_controller_is_turned() -> None:
    """A frame with a turned bit is refused for its CRC, and not carried out."""
    device = device_with("request-bit-flipped", at=8, mode=Mode.PRO_CRC)
    assert answer(device, encode(set_value(X.static_xy, 0.5))) == encode(refuse(0x10, ErrorCode.CRC_WRONG))
    assert device.state.axes[0].commanded == 0


def test_replies_are_split_merged_slow_and_late() -> None:
    """The bytes are those of a reply, at other times."""
    whole = b"MR-E-2\r\n"
    for name in ("split-replies", "merged-replies", "slow-bytes", "late-reply", "just-late-reply"):
        chunks = device_with(name).receive(b"GETID\r\n")
        assert b"".join(data for _, data in chunks) == whole
        delays = [delay_s for delay_s, _ in chunks]
        assert delays == sorted(delays)
        if name == "split-replies":
            assert 3 <= len(chunks) <= 8
        if name == "merged-replies":
            assert delays == [TICK_S]
        if name == "slow-bytes":
            assert delays[-1] - delays[0] == pytest.approx(7 * SLOW_S)
        if name == "late-reply":
            assert delays[0] >= LATE_S


LINES = {  # where the fault strikes, what is said, what comes back, and where the mirror was sent then
    "request-byte-lost": (2, b"START\r\nSTART\r\n", b"NO\r\nOK\r\n", 0.0),
    "request-byte-doubled": (2, b"START\r\nSTART\r\n", b"NO\r\nOK\r\n", 0.0),
    "no-reply": (0, b"X=0.5\r\nSTART\r\n", b"OK\r\n", 0.5),
    "mute": (0, b"X=0.5\r\nSTART\r\n", b"", 0.5),
    "old-reply-again": (1, b"GETID\r\nSTART\r\n", b"MR-E-2\r\nMR-E-2\r\nOK\r\n", 0.0),
    "answers-no": (0, b"X=0.5\r\nSTART\r\n", b"NO\r\nOK\r\n", 0.0),
    "answers-ol": (0, b"X=0.5\r\nSTART\r\n", b"OL\r\nOK\r\n", 0.0),
    "answers-ou": (0, b"X=0.5\r\nSTART\r\n", b"OU\r\nOK\r\n", 0.0),
    "answers-error": (0, b"X=0.5\r\nSTART\r\n", b"ERROR\r\nOK\r\n", 0.0),
    "echo": (0, b"START\r\n", b"START\r\n", 0.0),
    "modem": (0, b"START\r\nAT\r\n", b"START\r\nAT\r\n\r\nERROR\r\n\r\nOK\r\n", 0.0),
    "wrong-firmware": (0, b"GETID\r\n", b"LENS-DRIVER-4\r\n", 0.0),
}


@pytest.mark.parametrize("name", LINES)
def test_a_fault_of_lines_does_what_it_says(name: str) -> None:
    """One line is garbled, refused or not answered, the others are as ever; what is refused is not carried out."""
    at, said, expected, sent_to = LINES[name]
    device = device_with(name, at)
    assert answer(device, said) == expected
    assert device.state.axes[0].commanded == sent_to


@pytest.mark.parametrize(
    ("name", "size"), [("reply-byte-lost", 7), ("reply-byte-doubled", 9), ("reply-bit-flipped", 8), ("noise", None)]
)
def test_one_reply_is_damaged(name: str, size: int | None) -> None:
    """The reply to the second request is, those around it are not; before noise the reply is whole."""
    device = device_with(name, at=1)
    whole, damaged, next_one = (answer(device, b"GETID\r\n") for _ in range(3))
    assert whole == next_one == b"MR-E-2\r\n" != damaged
    assert len(damaged) == size or damaged.endswith(whole)


@pytest.mark.parametrize("name", CODES)
def test_a_frame_is_refused(name: str) -> None:
    """One frame is answered by the error, and is not carried out."""
    device = device_with(name, mode=Mode.PRO)
    assert answer(device, encode(set_value(X.static_xy, 0.5))) == encode(refuse(0x10, CODES[name]))
    assert answer(device, encode(get_value(X.static_xy))) == encode(Frame(0x11, float_cell(0.0)))


def test_only_cells_strike_a_vectors_error() -> None:
    """A fault of vectors leaves other frames alone."""
    device = device_with("error-vector-index", mode=Mode.PRO)
    assert answer(device, encode(set_value(X.static_xy, 0.5))) == encode(Frame(0x10))
    cells = encode(set_vector(VECTOR_MEMORY, 0, float_cell(0.5)))
    assert answer(device, cells) == encode(refuse(0x14, ErrorCode.VECTOR_INDEX))


def test_a_cell_is_acknowledged_and_not_written() -> None:
    """One of ten cells keeps what it held."""
    device = device_with("cell-lost", mode=Mode.PRO)
    assert answer(device, encode(set_vector(VECTOR_MEMORY, 0, float_cell(0.5) * 10))) == encode(Frame(0x14))
    assert sorted(device.state.memory[:10].tolist()) == [0.0] + [0.5] * 9


@pytest.mark.parametrize("name", BITS)
def test_a_status_bit_is_on(name: str) -> None:
    """From the second request on the bit is there, whatever is acknowledged."""
    device = device_with(name, at=1)
    assert answer(device, b"STATUS\r\n") == b"00000000\r\n"
    assert answer(device, b"ACKNOWLEDGE\r\nSTATUS\r\n") == b"OK\r\n%08X\r\n" % BITS[name]


def test_a_head_that_is_not_there_does_not_move() -> None:
    """A disconnected mirror takes targets and stays where it is."""
    device = device_with("disconnected")
    answer(device, b"X=0.5\r\n")
    device.clock.sleep(1.0)
    assert device.positions(device.clock.now()).tolist() == [0.0, 0.0]


def test_restarts() -> None:
    """A silent restart loses a request, the mode and the memory; one in an upload deafens for a second as well."""
    device = device_with("silent-reset", at=1, mode=Mode.PRO)
    assert answer(device, encode(set_vector(VECTOR_MEMORY, 0, float_cell(0.5)))) == encode(Frame(0x14))
    assert answer(device, encode(ask_status())) == b""
    assert device.mode is Mode.SIMPLE
    assert not device.state.memory.any()
    assert answer(device, b"START\r\n") == b"OK\r\n"
    device = device_with("reset-in-upload", mode=Mode.PRO)
    assert answer(device, encode(ask_status())) == encode(Frame(2, bytes(4)))
    assert answer(device, encode(set_vector(VECTOR_MEMORY, 0, float_cell(0.5)))) == b""
    assert answer(device, b"START\r\n") == b""


def test_another_model_and_an_earlier_session() -> None:
    """The firmware is another model's, too; a controller that was left in pro mode is in either of its forms."""
    other = device_with("wrong-firmware")
    assert answer(other, b"GOPRO\r\n" + encode(ASK_FIRMWARE)).endswith(encode(Frame(1, bytes.fromhex("dead0001"))))
    assert {device_with("pro-at-connect", seed=seed).mode for seed in range(9)} == {Mode.PRO, Mode.PRO_CRC}
    assert device_with("stale-bytes").opened()


def test_devices_that_go() -> None:
    """Before a request it is not carried out, in its middle neither, after it it is; then there is no device."""
    for name, at, acts in (("gone-before", 0, 0), ("gone-within", 3, 0), ("gone-after", 0, 1)):
        device = device_with(name, at)
        try:
            assert device.receive(b"START\r\n") == []
        except VanishedError:
            assert name == "gone-before"
        assert len(device.acts) == acts
        assert device.gone
        with pytest.raises(VanishedError):
            device.receive(b"START\r\n")
    hung = device_with("hangs")
    assert hung.receive(b"START\r\n") == []
    assert hung.hung
    assert not hung.acts


def test_every_fault_of_the_table_can_be_asked_for() -> None:
    """Names are apart, and each builds the fault that it names."""
    names = [name for name, _, _ in fault_table()]
    assert len(set(names)) == len(names) == len(KINDS) + len(CameraFault)
    mirror, camera = read_faults([f"{name}:3" for name in names])
    assert len(mirror) == len(KINDS)
    assert camera.left == dict.fromkeys(CameraFault, 1)


def test_camera_fault_given_twice_strikes_twice() -> None:
    """Each with a seed of its own."""
    assert read_faults(["camera-full:1", "camera-full:2"])[1].left == {CameraFault.FULL: 2}


@pytest.mark.parametrize("word", ["lost", "camera-full:x", "camera-full:-1", "mute:one", "camera"])
def test_words_that_name_no_fault_are_refused(word: str) -> None:
    """With the word that was wrong."""
    with pytest.raises(SettingsError, match=word.partition(":")[0]):
        read_faults([word])


def test_a_name_that_is_nearly_right_is_told() -> None:
    """As keys of the settings are."""
    with pytest.raises(SettingsError, match=r"no fault 'camera-ful'; did you mean camera-full\?"):
        read_faults(["camera-ful"])
